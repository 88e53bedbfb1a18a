"""Ways to damage a file, drawn by hypothesis: bytes, values within JSON, and things that are no file at all."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bidex_meta.errors import BidexError

ODD = (
    None, True, -1, 0, 1.5, 1e308, 10**18, 10**30, "", "x", "\x1b[2J", "[/x]", "../..", "x" * 5000, [], [1], {},
    {"a": 1},
)  # fmt: skip
"""Values that no field expects."""
TEXTS = (
    b"", b"\0", b"null", b"[]", b"{}", b"1", b'"x"', b"\xff\xfe{\0}\0", b"\x80abc", b"[" * 5000, b'{"a":' * 5000,
    b'{"step": ' + b"9" * 5000 + b"}", b"a = " + b"9" * 5000, b"a = " + b"[" * 5000, b"<html>", b"PK\x03\x04",
    b"\n" * 999, b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x94.",
)  # fmt: skip
"""Whole contents that are something else."""


def of_bytes() -> st.SearchStrategy[Any]:
    """Damages that any file can take; each is a function of the content."""
    place = st.floats(0, 1, exclude_max=True)
    return st.one_of(
        st.builds(lambda at: ("cut", lambda data: data[: int(at * len(data))]), place),
        st.builds(lambda at, bit: ("flip", lambda data: _flipped(data, at, bit)), place, st.integers(0, 7)),
        st.builds(lambda at, n: ("insert", lambda data: _put(data, at, bytes([n]) * 3, 0)), place, st.integers(0, 255)),
        st.builds(lambda at, n: ("zeros", lambda data: _put(data, at, bytes(n), n)), place, st.integers(1, 4000)),
        st.builds(lambda text: ("other", lambda data: text), st.sampled_from(TEXTS)),
        st.builds(lambda text: ("random", lambda data: text), st.binary(max_size=200)),
    )


def _flipped(data: bytes, at: float, bit: int) -> bytes:
    place = int(at * len(data))
    return _put(data, at, bytes([data[place] ^ (1 << bit)]), 1)


def _put(data: bytes, at: float, new: bytes, gone: int) -> bytes:
    place = int(at * len(data))
    return data[:place] + new + data[place + gone :]


def of_values() -> st.SearchStrategy[Any]:
    """Damages of one value somewhere in a JSON content."""
    return st.builds(
        lambda which, value, gone: ("value", lambda data: _changed(data, which, value, gone)),
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(ODD),
        st.booleans(),
    )


def _changed(data: bytes, which: float, value: Any, gone: bool) -> bytes:
    content = json.loads(data)
    places = list(places_in(content))
    inside, key = places[int(which * len(places))]
    if gone and isinstance(inside, dict):
        del inside[key]
    else:
        inside[key] = value
    return json.dumps(content).encode()


def places_in(content: Any):
    """Containers and keys of all that is in a content."""
    for key in content if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list):
            yield from places_in(content[key])


NO_FILES = ("gone", "folder", "pipe", "loop", "dangling", "huge", "device")


def of_files(*more: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Damages of a file for :func:`put`."""
    return st.one_of(of_bytes(), *more, st.sampled_from(NO_FILES))


def put(path: Path, drawn: Any, whole: bytes) -> None:
    """Damages a file whose content was ``whole``."""
    if isinstance(drawn, str):
        replace(path, drawn)
    else:
        remove(path)
        path.write_bytes(drawn[1](whole))


def replace(path: Path, kind: str) -> None:
    """Puts something that is no file, or too large a one, in a file's place."""
    remove(path)
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(10**13)  # sparse


def remove(path: Path) -> None:
    """Takes away whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def draws(count: int, strategy: st.SearchStrategy[Any], check: Callable[[Any], object]) -> None:
    """Checks so many drawn values."""

    @settings(max_examples=count, database=None, suppress_health_check=list(HealthCheck))
    @given(strategy)
    def run(drawn: Any) -> None:
        check(drawn)

    run()


def one_line_or(call: Callable[[], Any]) -> Any:
    """What a call gives, or None where it refuses in one line."""
    try:
        return call()
    except BidexError as error:
        assert str(error).strip() and "\n" not in str(error) and len(str(error)) < 3000
        return None


def listing(*folders: Path) -> dict[str, tuple[int, int]]:
    """Every entry below some folders, with size and time of change."""
    found = {}
    for folder in folders:
        for path in folder.rglob("*"):
            stat = path.lstat()
            found[str(path)] = (stat.st_size, stat.st_mtime_ns) if not path.is_dir() else (0, 0)
    return found
