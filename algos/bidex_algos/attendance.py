"""Which processes of a run are still there: a roll call, for the message after one of them was lost."""

import os
import signal
import threading
import time
from types import FrameType
from typing import Any

_CALL = "roll call"
_SECONDS = 2.0
_PATIENCE = 10.0


class Attendance:
    """Answers roll calls from a thread of its own, since the process itself may be in the middle of a rollout.

    Args:
        store: The store the processes met at. torchrun keeps it, so that it outlives each of them.
        rank: Number of this process.
        count: Number of processes.
    """

    def __init__(self, store: Any, rank: int, count: int):
        # A connection of its own: operations of one wait for each other.
        self._store, self._rank, self._count = store.clone(), rank, count
        self._closed = threading.Event()
        threading.Thread(target=self._answer, name="attendance", daemon=True).start()

    def call(self) -> list[int] | None:
        """Numbers of the processes that do not answer within two seconds; None if the store is gone too."""
        try:
            self._store.set(_CALL, "")
            time.sleep(_SECONDS)
            return [i for i in range(self._count) if not self._store.check([_answer_of(i)])]
        except RuntimeError:
            return None

    def close(self) -> None:
        """No longer answers."""
        self._closed.set()

    def _answer(self) -> None:
        while not self._closed.wait(_SECONDS / 8):
            try:
                if self._store.check([_CALL]):
                    self._store.set(_answer_of(self._rank), "")
                    return
            except RuntimeError:
                return


def end_patiently() -> None:
    """Leaves ten seconds between SIGTERM and the end of the process, where nobody else handles that signal.

    torchrun sends it to all others as soon as one process is gone, which is just when they want to say so.
    """

    def on_signal(number: int, frame: FrameType | None) -> None:
        timer = threading.Timer(_PATIENCE, os._exit, [128 + number])
        timer.daemon = True
        timer.start()

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_signal)


def _answer_of(rank: int) -> str:
    return f"present {rank}"
