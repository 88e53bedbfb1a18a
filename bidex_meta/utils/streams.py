"""Handling of the standard streams: closed streams, unusual encodings and widths, streams without a reader."""

import contextlib
import io
import os
import select
import shutil
import sys
from typing import IO

_WIDTHS = (40, 1000)  # range of columns in which tables and help texts can be laid out


def open_missing() -> None:
    """Open the null device for each standard stream that this process was started without (``2>&-``).

    Otherwise the next opened file would get the stream's number, and a library's messages would be written into a
    checkpoint.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    for name in ("stdout", "stderr"):
        if vars(sys)[name] is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def print_anything() -> None:
    """Make stdout and stderr replace letters that their encoding does not have, instead of raising an error.

    Otherwise, if the encoding is not UTF-8, a dash in a table would end hours of training with a traceback.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def bound_width() -> None:
    """Set COLUMNS to a usable width if COLUMNS or the terminal has a width outside 40 to 1,000 columns.

    Every library that wraps lines reads COLUMNS first. With one column the help of ``run`` would take minutes.
    """
    width = shutil.get_terminal_size().columns
    bounded = min(max(width, _WIDTHS[0]), _WIDTHS[1])
    if bounded != width or "COLUMNS" in os.environ:
        os.environ["COLUMNS"] = str(bounded)


def output_width(unknown: int) -> int:
    """Return the width of stdout in columns: COLUMNS if set, otherwise that of the terminal, otherwise ``unknown``."""
    if "COLUMNS" in os.environ or sys.stdout.isatty():
        return shutil.get_terminal_size().columns
    return unknown


def silence(stream: IO[str]) -> None:
    """Send later output, and output that could not be written before, to the null device."""
    with contextlib.suppress(OSError, ValueError):  # a stream within Python has no file number
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def unread(stream: IO[str]) -> bool:
    """Return whether a stream's reader has ended (``| head``)."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # Windows has no poll
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return any(found & select.POLLERR for _, found in poll.poll(0))
    return False
