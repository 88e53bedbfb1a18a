"""The training loop every learner runs in: iterate, report, save; and stop cleanly when asked to."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Protocol

from bidex_algos.rollout import VectorWorld


class Learner(Protocol):
    """What the loop needs of a learner."""

    @property
    def env_steps(self) -> int:
        """Environment steps taken so far, over all rows."""
        ...

    def iterate(self) -> dict[str, float]:
        """One rollout and one update; flat metrics."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to continue bit for bit, beside the world's own state."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        ...


class Record(Protocol):
    """Where metrics and checkpoints go."""

    def log(self, metrics: dict[str, float], step: int) -> None:
        """Takes the metrics of one iteration that ended at environment step ``step``."""
        ...

    def save(self, state: dict[str, Any], step: int) -> None:
        """Writes a checkpoint, atomically."""
        ...


def train(
    learner: Learner,
    world: VectorWorld,
    *,
    total_steps: int,
    record: Record,
    checkpoint_seconds: float = 60.0,
) -> bool:
    """Trains until ``total_steps`` environment steps are done, counting those of a resumed run.

    SIGINT or SIGTERM finishes the current iteration, saves and returns; a second one acts at once.

    Args:
        learner: The learner, already made on ``world``.
        world: The world, whose state is saved beside the learner's.
        total_steps: Environment steps in all.
        record: Where metrics and checkpoints go.
        checkpoint_seconds: Least time between two checkpoints; one more is always saved at the end.

    Returns:
        True if a signal ended the training early.
    """
    saved_at = time.monotonic()
    saved_step = learner.env_steps
    with _stop_requests() as stop:
        while learner.env_steps < total_steps and not stop.is_set():
            record.log(learner.iterate(), learner.env_steps)
            if time.monotonic() - saved_at >= checkpoint_seconds:
                record.save(checkpoint(learner, world), learner.env_steps)
                saved_at, saved_step = time.monotonic(), learner.env_steps
        if learner.env_steps != saved_step:
            record.save(checkpoint(learner, world), learner.env_steps)
        return stop.is_set() and learner.env_steps < total_steps


def checkpoint(learner: Learner, world: VectorWorld) -> dict[str, Any]:
    """The state of a run: ``{"learner": ..., "env": ...}``, tensors and plain values only."""
    return {"learner": learner.state_dict(), "env": world.state_dict()}


def resume(learner: Learner, world: VectorWorld, state: dict[str, Any]) -> None:
    """Restores what :func:`checkpoint` gave; training then continues bit for bit (CPU, same number of threads)."""
    world.load_state_dict(state["env"])
    learner.load_state_dict(state["learner"])


@contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """Turns the first SIGINT or SIGTERM into a set event; puts the old handlers back then and on leaving."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        # Python lets only the main thread set handlers; elsewhere signals stay the caller's business.
        yield stop
        return
    # None stands for a handler that was not set from Python and cannot be put back.
    old = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in old.items():
            signal.signal(number, handler)

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()
        restore()

    for number in old:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        restore()
