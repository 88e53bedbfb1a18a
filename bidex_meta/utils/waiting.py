"""Signs of life of a command: it prints a line on stderr whenever it has printed nothing for a while.

``watched`` runs a thread that checks the clock. Slow code calls ``note`` with its current activity. Nothing is printed
outside a ``watched`` block.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

_LOOK_SECONDS = 1.0
# The time between two checks adds to these limits, so notices come after at most 5 and 15 seconds.
_FIRST_SECONDS = 4.0
_SECONDS = 14.0


class _Watch:
    """State of a command's signs of life: its current activity, when that began, and when a line was last printed."""

    def __init__(self, what: str, clock: Callable[[], float]):
        self.clock = clock
        self.what = what
        self.detail = ""
        self.since = clock()
        self.told_at = clock()
        self.patience = _FIRST_SECONDS

    def look(self) -> None:
        """Print a line if the last line was printed too long ago."""
        now = self.clock()
        if self.what and now - self.told_at >= self.patience:
            if self.detail:
                detail = f", {self.detail}"
            else:
                detail = ""
            tell(f"{self.what}{detail}: {now - self.since:.0f} s so far.")


_watch: _Watch | None = None


def note(what: str, detail: str = "") -> None:
    """Set the command's current activity for the next sign of life; ``""`` stops the signs until the next call."""
    if _watch is None:
        return
    if what != _watch.what:
        _watch.what = what
        _watch.since = _watch.clock()
    _watch.detail = detail


def told() -> None:
    """Record that other code has printed a line, which delays the next sign of life."""
    if _watch is not None:
        _watch.told_at = _watch.clock()
        _watch.patience = _SECONDS


def tell(text: str) -> None:
    """Print a line on stderr."""
    print(text, file=sys.stderr, flush=True)
    told()


@contextlib.contextmanager
def watched(what: str) -> Iterator[None]:
    """Print signs of life while the block runs; ``what`` is its first activity."""
    global _watch
    outer = _watch
    _watch = _Watch(what, time.monotonic)
    ended = threading.Event()
    thread = threading.Thread(target=_look, args=(_watch, ended), name="signs of life", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        _watch = outer


def _look(watch: _Watch, ended: threading.Event) -> None:
    with contextlib.suppress(OSError, ValueError):  # nobody reads stderr any more; the command notices this itself
        while not ended.wait(_LOOK_SECONDS):
            watch.look()
