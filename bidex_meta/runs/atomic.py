"""Write a file so that a crash leaves either the old content or the new one, never a torn one."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from bidex_meta.errors import BidexError, one_line
from bidex_meta.utils.files import exists

TEMPORARY_SUFFIX = ".tmp"
Json = dict[str, Any]  # an object of JSON


def write_atomic(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call ``write`` on a temporary file beside ``path``, force it to the disk and rename it over ``path``."""
    # Same folder, since a rename is atomic only within one file system.
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=TEMPORARY_SUFFIX, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp's 0600 would lock colleagues out of a shared run folder
        os.replace(name, path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        # torch.save tells of what the system refuses, such as a full disk, as of an error of its own.
        if isinstance(error, RuntimeError) and isinstance(why := error.__context__, OSError):
            raise OSError(why.errno, why.strerror, str(path)) from None
        raise
    sync_folder(path.parent)


def write_json(path: Path, content: object) -> None:
    """Write ``content`` as indented JSON, atomically."""
    write_atomic(path, lambda file: file.write((json.dumps(content, indent=2) + "\n").encode()))


def remove_leftovers(folder: Path) -> None:
    """Delete the temporary files that a killed process left in ``folder``."""
    for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def refuse_links(*paths: Path) -> None:
    """Raises BidexError for links among a run's own files: what is written or deleted there would be another's."""
    for path in (path for path in paths if path.is_symlink()):
        raise BidexError(f"{path} is a link, and what a run writes stays in its folder. Put a folder or file there.")


def check_writable(path: Path) -> None:
    """Raises BidexError, before long work, where ``path`` is no file or cannot be written at the end of it.

    The name may be too long, the folder not ours, the disk full; folders above it may be missing, and stay so.
    """
    if exists(path) and not path.is_file():
        raise BidexError(f"Expected a file to write at {path}, but there is something else. Name another.")
    created: list[Path] = []
    try:
        for folder in reversed([folder for folder in path.parents if not exists(folder)]):
            folder.mkdir()
            created.append(folder)
        # As long a name as the file's own will have while it is written.
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=TEMPORARY_SUFFIX, dir=path.parent)
        try:
            os.write(handle, bytes(4096))
        finally:
            os.close(handle)
            os.unlink(name)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or one_line(error)
        raise BidexError(f"{path} cannot be written: {reason}. Name another place, or make room.") from None
    finally:
        for folder in reversed(created):
            folder.rmdir()


def sync_folder(folder: Path) -> None:
    """Forces a folder's names to the disk: without this a power cut may lose a rename."""
    # Windows cannot open folders, and needs no such call.
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
