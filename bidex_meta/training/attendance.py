"""Watch which processes of a run are alive, for the message that reports a lost process."""

import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from typing_extensions import override

from bidex_meta.training.launch import notices

_BEAT_SECONDS = 0.5
_LISTEN_SECONDS = 3.0
# torchrun kills a process 30 s after it asked it to stop.
_STOP_SECONDS = 12.0
_END_SECONDS = 10.0
# A heartbeat and a check of the others take three seconds; more only if the store no longer answers.
_JOIN_SECONDS = 10.0


class Attendance(threading.Thread):
    """Thread that tells the other processes of a run that this process is alive.

    Twice a second it increases this process's counter in torchrun's store. ``count`` is the number of processes. A
    process may hang in a collective operation that waits for a lost process. The thread therefore ends this process,
    after a call of ``on_loss``, if a signal asked it to end, 12 seconds have passed, and another process is missing.
    """

    def __init__(self, store: Any, rank: int, count: int):
        super().__init__(name="attendance", daemon=True)
        # The thread has its own connection, because operations on one connection wait for each other.
        self._store = store.clone()
        self._rank = rank
        self._count = count
        self._closed = threading.Event()
        self.on_loss: Callable[[], None] = lambda: None
        self._signals, sent = os.pipe()
        for end in (self._signals, sent):
            os.set_blocking(end, False)
        if threading.current_thread() is threading.main_thread():
            # A signal handler in Python would wait for the running operation to return; writing this byte does not.
            signal.set_wakeup_fd(sent, warn_on_full_buffer=False)
        self.start()

    def report(self) -> list[int] | None:
        """Tell the other processes that this process ends, so that they do not count it as lost.

        The first process that calls this method returns the ranks of the lost processes. The others return None,
        because the first one reports the loss. The list is empty if torchrun's store is lost too.
        """
        self._closed.set()
        try:
            self._store.set(f"reported {self._rank}", "")
            if self._store.add("reports", 1) == 1:
                return self._missing()
            return None
        except RuntimeError:
            return []  # the store is gone too

    def close(self) -> None:
        """End the thread; return when it has ended, or after 10 seconds if the store no longer answers."""
        self._closed.set()
        self.join(_JOIN_SECONDS)
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(-1)

    @override
    def run(self) -> None:
        asked_at = None
        while not self._closed.wait(_BEAT_SECONDS):
            try:
                self._store.add(f"beats {self._rank}", 1)
                if asked_at is None and self._was_asked_to_end():
                    asked_at = time.monotonic()
                # If all other processes are alive, the iteration only takes long.
                late = asked_at is not None and time.monotonic() - asked_at > _STOP_SECONDS
                lost = late and self._missing()
            except RuntimeError:
                return
            if lost and not self._closed.is_set():
                self.on_loss()
                os._exit(1)

    def _missing(self) -> list[int]:
        """Return the ranks of the processes whose counter has stopped, and that have not reported that they end."""
        before = self._beats()
        time.sleep(_LISTEN_SECONDS)
        silent = [i for i, (a, b) in enumerate(zip(before, self._beats(), strict=True)) if a == b and i != self._rank]
        return [i for i in silent if not self._store.check([f"reported {i}"])]

    def _beats(self) -> list[int]:
        return [self._store.add(f"beats {i}", 0) for i in range(self._count)]

    def _was_asked_to_end(self) -> bool:
        try:
            return bool(set(os.read(self._signals, 64)) & {signal.SIGINT, signal.SIGTERM, *notices()})
        except BlockingIOError:
            return False


def end_patiently() -> None:
    """Install a handler that lets this process run for ten more seconds after SIGTERM.

    When one process of a run dies, torchrun sends SIGTERM to all others. They need this time to report that a process
    was lost. A handler that is installed later replaces this one.
    """

    def on_signal(number: int, frame: FrameType | None) -> None:
        timer = threading.Timer(_END_SECONDS, os._exit, [128 + number])
        timer.daemon = True
        timer.start()

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_signal)
