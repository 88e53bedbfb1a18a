"""Reading of files that others may have written or damaged: sizes and contents are checked, errors take one line.

A file that is larger than its kind allows is not read, and no function waits for the writer of a pipe.
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
"""Content of a JSON or TOML file."""
MOST_TEXT = 64_000_000
"""Maximum size of a JSON or TOML file, bytes; far above the largest file of an evaluation."""
_DATA_SETS = ("dataset", "demonstrations", "drawn_from")
"""Names of entries whose values are names or paths of data sets."""
_DEEPEST = 64
_LARGEST = 2**63 - 1
"""Largest whole number in a file: our counts, steps and seeds are smaller, and Python is slow for thousands of
digits."""


def expanded(path: str | Path) -> Path:
    """Replace ``~`` and ``~name`` in a path; raises BidexError if the user is unknown or has no home folder."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise BidexError(f"{shortened(str(path))}: {error}. Write the whole path.") from None


def absolute(path: str | Path) -> Path:
    """Return the absolute path, with ``~`` replaced and links followed; raises BidexError if links form a circle."""
    try:
        return expanded(path).resolve()
    except (RuntimeError, OSError) as error:
        raise BidexError(f"{shortened(str(path))}: {one_line(error)}. Fix the link, or name another path.") from None


def portable(content: Json) -> Json:
    """Return content for publication: absolute paths are cut to their last part, which drops this machine's folders.

    Paths of data sets keep two parts (``CatchUnderarm/random-v0``), because together they are the data set's name.
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
    """Return whether a path is a regular file; return False, without an error, for a path that cannot exist."""
    with suppress(OSError, ValueError):
        return path.is_file()
    return False


def exists(path: Path) -> bool:
    """Return whether a path exists; a link that leads nowhere counts, a path that cannot exist does not."""
    with suppress(OSError, ValueError):
        return os.path.lexists(path)
    return False


def open_regular(path: Path, what: str, most: int | None = None) -> IO[bytes]:
    """Open a regular file of at most ``most`` bytes for reading.

    ``what`` describes the file in error messages, for example ``"a run's config"``. Raises BidexError if the file is
    missing, unreadable or too large, or is not a regular file.
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
    """Return a file's content as text; raises BidexError like :func:`open_regular`, or if the content is not UTF-8."""
    try:
        return read_bytes(path, what).decode()
    except UnicodeDecodeError as error:
        raise BidexError(f"{path}: expected {what} in UTF-8, but {error.reason} at byte {error.start}.") from None


def read_json(path: Path, what: str) -> Json:
    """Return the content of a JSON file.

    Raises BidexError like :func:`read_text`, or if the content is not JSON, is nested too deeply or has a number beyond
    64 bits.
    """
    return _parsed(path, what, "JSON", json.loads)


def read_toml(path: Path, what: str) -> JsonObject:
    """Return the content of a TOML file; raises BidexError like :func:`read_json`."""
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
