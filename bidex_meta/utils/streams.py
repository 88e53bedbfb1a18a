"""The standard streams of the command line: ones that are closed, and ones that nobody reads any more."""

import contextlib
import os
import select
import sys
from typing import IO, Any


def open_missing() -> None:
    """Opens the null device for each standard stream that this process was started without (``2>&-``).

    Python leaves None in its place, and the next file that is opened would get its number: what a library prints to
    stderr would then be written into a checkpoint.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def silence(stream: IO[Any]) -> None:
    """Sends to the null device what is printed from now on, and what could not be written before."""
    with contextlib.suppress(OSError, ValueError):  # a stream within Python has no number
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def unread(stream: IO[Any]) -> bool:
    """Whether whatever read a stream has ended (``| head``)."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # Windows has no poll
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return any(found & select.POLLERR for _, found in poll.poll(0))
    return False
