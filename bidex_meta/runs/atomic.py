"""Atomic writes: a crash leaves either the old or the new content of a file, never a torn file."""

import contextlib
import errno
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from bidex_meta.errors import BidexError, one_line
from bidex_meta.utils.files import exists

TEMPORARY_SUFFIX = ".tmp"
_CHUNK = 2**20  # bytes per write
Json = dict[str, Any]  # a JSON object


def write_atomic(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call ``write`` on a temporary file next to ``path``, force it to the disk and rename it over ``path``."""
    temporary = temporary_name(path)
    try:
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        # torch.save reports system errors, such as a full disk, as errors of its own class.
        if isinstance(error, RuntimeError) and isinstance(why := error.__context__, OSError):
            raise OSError(why.errno, why.strerror, str(path)) from None
        raise
    sync_folder(path.parent)


def temporary_name(path: Path) -> Path:
    """Return an unused name in the folder of ``path``, because a rename is atomic only within one file system.

    ``open`` creates the file with the umask's mode; ``tempfile`` would ignore the umask and use mode 0600.
    """
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}{TEMPORARY_SUFFIX}")


@contextlib.contextmanager
def room_for(folder: Path, size: int, count: int) -> Iterator[None]:
    """Reserve disk space in a folder for ``count`` files of ``size`` bytes, until ``remove_leftovers`` is called there.

    Raises BidexError if the disk, a quota or a limit of the process does not grant this space.
    """
    remove_leftovers(folder)
    free = shutil.disk_usage(folder).free
    try:
        if count * size > free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        for number in range(count):
            _fill(folder / f".room-{number}{TEMPORARY_SUFFIX}", size)
    except OSError as error:
        remove_leftovers(folder)
        raise BidexError(
            f"Expected room for {count} files of {size / 1e6:,.1f} MB in {folder}, got {error.strerror} "
            f"({free / 1e6:,.1f} MB are free on its disk). Make room there, or name another folder."
        ) from None
    try:
        yield
    finally:
        remove_leftovers(folder)


def _fill(path: Path, size: int) -> None:
    with path.open("xb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, max(size, 1))
            return
        for _ in range(size // _CHUNK + 1):
            file.write(bytes(_CHUNK))


def write_json(path: Path, content: object) -> None:
    """Write ``content`` as indented JSON, atomically."""
    write_atomic(path, lambda file: file.write((json.dumps(content, indent=2) + "\n").encode()))


def remove_leftovers(folder: Path) -> None:
    """Delete the temporary files that a killed process left in ``folder``."""
    for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def refuse_links(*paths: Path) -> None:
    """Raise BidexError for links among a run's own files, because writing through a link would change other files."""
    for path in (path for path in paths if path.is_symlink()):
        raise BidexError(f"{path} is a link, and what a run writes stays in its folder. Put a folder or file there.")


def check_writable(path: Path) -> None:
    """Raise BidexError, before long work, if ``path`` exists but is not a file, or cannot be written.

    Reasons are a long name, missing permission or a full disk. Missing parent folders are allowed and not created.
    """
    if exists(path) and not path.is_file():
        raise BidexError(f"Expected a file to write at {path}, but there is something else. Name another.")
    created: list[Path] = []
    try:
        for folder in reversed([folder for folder in path.parents if not exists(folder)]):
            folder.mkdir()
            created.append(folder)
        # The temporary name is as long as the one under which the file will be written, so too long a name fails now.
        temporary = temporary_name(path)
        try:
            with temporary.open("xb") as file:
                file.write(bytes(4096))
        finally:
            temporary.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or one_line(error)
        raise BidexError(f"{path} cannot be written: {reason}. Name another place, or make room.") from None
    finally:
        for folder in reversed(created):
            folder.rmdir()


def sync_folder(folder: Path) -> None:
    """Force a folder's list of files to the disk; without this a power cut may lose a rename."""
    # Windows cannot open folders, and needs no such call.
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
