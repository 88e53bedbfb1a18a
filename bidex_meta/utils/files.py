"""Reads files that others may have written or damaged: opened, bounded, parsed and checked, errors on one line.

No file is read that is larger than its kind can be, and no function waits for a writer.
"""

import json
import os
import stat
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePath
from typing import IO, Any

from bidex_meta.errors import BidexError, one_line, shortened

Json = Any
JsonObject = dict[str, Any]
"""Content of a file of JSON or TOML."""
MOST_TEXT = 64_000_000
"""Bytes of a file of JSON or TOML: far above the largest evaluation."""
_DATA_SETS = ("dataset", "demonstrations", "drawn_from")
"""Entries that name data sets."""
_DEEPEST = 64
_LARGEST = 2**63 - 1
"""Larger whole numbers are no count, step or seed of ours, and Python takes long for some thousand digits."""


def expanded(path: str | Path) -> Path:
    """Replace ``~`` and ``~name`` in a path; raises BidexError for an unknown user or without a home folder."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise BidexError(f"{shortened(str(path))}: {error}. Write the whole path.") from None


def absolute(path: str | Path) -> Path:
    """Return a path from the root on, ``~`` replaced and links followed; raises BidexError if links form a circle."""
    try:
        return expanded(path).resolve()
    except (RuntimeError, OSError) as error:
        raise BidexError(f"{shortened(str(path))}: {one_line(error)}. Fix the link, or name another path.") from None


def portable(content: Json) -> Json:
    """Return content for publication: absolute paths are cut to their last part, which drops this machine's folders.

    Data sets keep two parts (``CatchUnderarm/random-v0``), because these are their names.
    """
    return _portable(content, 1)


def _portable(content: Json, parts: int) -> Json:
    if isinstance(content, dict):
        return {name: _portable(value, 2 if name in _DATA_SETS else parts) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_portable(value, parts) for value in content]
    if isinstance(content, str) and (content.startswith("~") or PurePath(content).is_absolute()):
        return "/".join(PurePath(content).parts[1:][-parts:])
    return content


def is_file(path: Path) -> bool:
    """Return whether there is a regular file; False, not an error, for a path that cannot be one."""
    with suppress(OSError, ValueError):
        return path.is_file()
    return False


def exists(path: Path) -> bool:
    """Return whether a path exists; a link that leads nowhere counts, a path that cannot exist does not."""
    with suppress(OSError, ValueError):
        return os.path.lexists(path)
    return False


def open_regular(path: Path, what: str, most: int | None = None) -> IO[bytes]:
    """Open a regular file of at most ``most`` bytes for reading; messages call it ``what``: ``"a run's config"``.

    Raises BidexError if the file is missing, unreadable or too large, or is no regular file.
    """
    try:
        # Opening a pipe would wait until somebody writes to it.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise BidexError(f"Expected {what} at {path}, but {reason}. Fix the path or the file.") from None
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            if stat.S_ISDIR(found.st_mode):
                kind = "a folder"
            else:
                kind = "a pipe or a device"
            raise BidexError(f"Expected {what} at {path}, got {kind}. Name a file.")
        if most is not None and found.st_size > most:
            raise BidexError(f"Expected {what} of at most {most:,} bytes at {path}, got {found.st_size:,}.")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, what: str, most: int = MOST_TEXT) -> bytes:
    """Return a file's content; see :func:`open_regular`."""
    with open_regular(path, what, most) as file:
        try:
            return file.read(most + 1)
        except OSError as error:
            raise BidexError(f"{path}: {what} cannot be read ({error.strerror or error}).") from None


def read_text(path: Path, what: str) -> str:
    """Return a file's content as text; raises BidexError as :func:`open_regular`, or if it is not UTF-8."""
    try:
        return read_bytes(path, what).decode()
    except UnicodeDecodeError as error:
        raise BidexError(f"{path}: expected {what} in UTF-8, but {error.reason} at byte {error.start}.") from None


def read_json(path: Path, what: str) -> Json:
    """Return the content of a JSON file.

    Raises BidexError as :func:`read_text`, or if it is not JSON, is nested too deep or has a number beyond 64 bits.
    """
    return _parsed(path, what, "JSON", json.loads)


def read_toml(path: Path, what: str) -> JsonObject:
    """Return the content of a TOML file; raises BidexError as :func:`read_json`."""
    return _parsed(path, what, "TOML", tomllib.loads)


def _parsed(path: Path, what: str, language: str, parse: Callable[[str], Json]) -> Json:
    text = read_text(path, what)
    try:
        return bounded(parse(text))
    except RecursionError:
        raise BidexError(f"{path}: expected {what}, but it is nested more than {_DEEPEST} deep.") from None
    except ValueError as error:  # both parsers raise ValueError, and so does Python for numbers with too many digits
        raise BidexError(f"{path}: expected {what} in {language}, but {one_line(error)[:200].rstrip('.')}.") from None


def bounded(content: Json) -> Json:
    """Return the same content; raise ValueError if it is nested too deeply, or has an integer beyond 64 bits."""
    level = [content]
    for _ in range(_DEEPEST):
        if not level:
            return content
        for value in level:
            if isinstance(value, int) and abs(value) > _LARGEST:
                raise ValueError(f"a number has more than {len(str(_LARGEST)) - 1} digits")
        inner: list[Json] = []
        for value in level:
            if isinstance(value, dict):
                inner += value.values()
            elif isinstance(value, list):
                inner += value
        level = inner
    raise ValueError(f"it is nested more than {_DEEPEST} deep")
