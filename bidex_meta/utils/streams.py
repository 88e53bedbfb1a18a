"""The standard streams of the command line: closed ones, and ones without a reader."""

import contextlib
import os
import select
import sys
from typing import IO


def open_missing() -> None:
    """Opens the null device for each standard stream that this process was started without (``2>&-``).

    The next file that is opened would get its number, and a library's messages would be written into a checkpoint.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    for name in ("stdout", "stderr"):
        if vars(sys)[name] is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def silence(stream: IO[str]) -> None:
    """Sends later output, and what could not be written before, to the null device."""
    with contextlib.suppress(OSError, ValueError):  # a stream within Python has no number
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def unread(stream: IO[str]) -> bool:
    """Whether a stream's reader has ended (``| head``)."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # Windows has no poll
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return any(found & select.POLLERR for _, found in poll.poll(0))
    return False
