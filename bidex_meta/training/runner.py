"""The training loop of every learner: it iterates, logs and saves, and stops cleanly at a signal.

Several processes (:mod:`bidex_meta.training.distributed`) do the same iterations and stop together. Only process 0
writes files.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

from gymnasium.spaces import Box

from bidex_meta.errors import BidexError
from bidex_meta.runs.recorder import Recorder
from bidex_meta.training.distributed import any_process, gather, is_main, rank, world_size
from bidex_meta.training.launch import notices
from bidex_meta.training.learner import Learner, State
from bidex_meta.utils.waiting import note
from bidex_meta.world.contract import VectorWorld

# This is the maximum share of a run's time that checkpoints may take.
_SAVING_SHARE = 0.02
_ADAM_COPIES = 3
_BYTES_PER_ENTRY = 1024  # bytes of an archive's entry: name, place and alignment
_EXTRA_NUMBERS_PER_STEP = 8  # numbers of a step that a replay stores in addition to observation and action


def train(
    learner: Learner,
    world: VectorWorld,
    *,
    total_steps: int,
    record: Recorder | None,
    total_seconds: float = math.inf,
    spent_seconds: float = 0.0,
    checkpoint_seconds: float = 60.0,
    watch: Callable[[], dict[str, float]] | None = None,
    should_stop: Callable[[Mapping[str, float]], bool] | None = None,
    last: Mapping[str, float] | None = None,
) -> int:
    """Train until ``total_steps`` environment steps are done or ``total_seconds`` are up, whichever comes first.

    Both limits include the steps and the seconds (``spent_seconds``) of a run that is resumed. Time counts from the
    first world step to the end of an iteration, including checkpoints; metrics contain it as ``Perf/training_time``.
    There is no iteration if a limit is reached before the first one. If any process receives SIGINT, SIGTERM, SIGHUP,
    SIGUSR1 or SIGUSR2 (unless ignored), all processes finish the iteration, save and return. A BrokenPipeError of
    ``record``, ``watch`` or ``should_stop`` has the same effect. After SIGINT or SIGTERM, another SIGINT or SIGTERM
    acts at once.

    Args:
        learner: Learner that trains on ``world``.
        world: World whose state is saved together with the learner's.
        total_steps: Total number of environment steps.
        record: Receives metrics and checkpoints. Only process 0 passes ``record``, ``watch`` and ``last``.
        total_seconds: Total training time, s.
        spent_seconds: Training time that a resumed run has had so far, s.
        checkpoint_seconds: Shortest time between two checkpoints, s. It is lengthened to 50 times the duration of the
            last save, because a replay makes checkpoints large. 0 saves after every iteration. A last checkpoint is
            always saved at the end.
        watch: Evaluates the learner after each iteration without changing it, and returns metrics. Its time does not
            count as training time.
        should_stop: Returns whether the metrics of an iteration end training; process 0 decides. It is None in all
            processes or in none.
        last: Metrics of the last iteration of the run that is resumed. If ``should_stop`` accepts them, nothing is
            trained.

    Returns the number of the signal that ended training early, else 0. The number is that of SIGPIPE if nobody reads
    the output, and that of SIGTERM if another process received the signal. Raises LostProcess if another process is
    gone; existing checkpoints are kept.
    """
    if should_stop is not None and any_process(is_main() and last is not None and should_stop(last)):
        return 0  # the run was stopped between its last iteration and the end of its evaluation
    # With several processes, one may be lost at any time, after which nothing can be saved. So the first iteration is
    # saved.
    if world_size() == 1:
        saved_at = time.monotonic()
    else:
        saved_at = -math.inf
    saved_step = learner.env_steps
    pause = checkpoint_seconds
    began_at = time.monotonic() - spent_seconds
    stopped = False

    def over() -> bool:
        if learner.env_steps == 0 or total_seconds == math.inf:
            return learner.env_steps >= total_steps
        # Clocks differ, so the clock of process 0 decides.
        late = any_process(is_main() and time.monotonic() - began_at >= total_seconds)
        return late or learner.env_steps >= total_steps

    iterations = 0
    with _stop_requests() as stop:
        while not over() and not (stopped := any_process(stop.is_set())):
            iterations += 1
            note(f"Iteration {iterations} of this start")
            metrics = learner.iterate()
            metrics["Perf/training_time"] = time.monotonic() - began_at
            reached = False
            try:
                note("Logging and evaluating")
                if watch is not None:
                    paused_at = time.monotonic()
                    metrics |= watch()
                    began_at += time.monotonic() - paused_at
                if record is not None:
                    record.log(metrics, learner.env_steps)
                reached = should_stop is not None and is_main() and should_stop(metrics)
            except BrokenPipeError:
                stop.ask(signal.SIGPIPE if os.name == "posix" else signal.SIGTERM)
            if should_stop is not None and any_process(reached):
                break
            if any_process(is_main() and time.monotonic() - saved_at >= pause):
                began = time.monotonic()
                _save(learner, world, record)
                saved_at = time.monotonic()
                saved_step = learner.env_steps
                if checkpoint_seconds > 0.0:
                    pause = max(checkpoint_seconds, (saved_at - began) / _SAVING_SHARE)
        if learner.env_steps != saved_step:
            _save(learner, world, record)
        return stop.number if stopped else 0


def _save(learner: Learner, world: VectorWorld, record: Recorder | None) -> None:
    note("Saving")
    state = checkpoint(learner, world)
    if record is not None and state is not None:
        record.save(state, learner.env_steps)


def checkpoint(learner: Learner, world: VectorWorld) -> State | None:
    """Return the state of the learner and the world, as a checkpoint stores it; all processes must call this.

    Process 0 gets ``{"learner": ..., "env": ...}``. If there are several processes, the dict also has ``others``, a
    list with the state of each other process, without the entries that are equal in all processes. The other processes
    get None.
    """
    state = {"learner": learner.state_dict(), "env": world.state_dict()}
    if world_size() == 1:
        return state
    own = {"learner": {name: state["learner"][name] for name in learner.per_process}, "env": state["env"]}
    parts = gather(own)
    if parts is None:
        return None
    return {**state, "others": parts[1:]}


def checkpoint_bytes(learner: Learner, world: VectorWorld, config: object, steps: int) -> int:
    """Return the maximum size of a run's checkpoint, bytes, after ``steps`` environment steps.

    ``config`` is the learner's config. Optimisers begin empty, but Adam later stores two moments for each weight, so
    the learner's tensors count three times.
    """
    width = _numbers(world.single_observation_space) + _numbers(world.single_action_space) + _EXTRA_NUMBERS_PER_STEP
    own = _ADAM_COPIES * _tensor_bytes(learner.state_dict()) + _tensor_bytes(world.state_dict())
    stored = min(learner.bytes_stored(config, world.num_envs, width), 4 * width * steps)
    return world_size() * (own + stored)


def _numbers(space: Box) -> int:
    return math.prod(space.shape or (0,))


def _tensor_bytes(state: object) -> int:
    if isinstance(state, dict):
        return sum(_tensor_bytes(part) for part in state.values())
    if isinstance(state, list | tuple):
        return sum(_tensor_bytes(part) for part in state)
    return getattr(state, "nbytes", 0) + _BYTES_PER_ENTRY


def resume(learner: Learner, world: VectorWorld, state: State) -> None:
    """Restore a :func:`checkpoint` written by the same number of processes.

    On the CPU, with the same number of threads, training continues bit for bit. Raises BidexError for another number of
    processes.
    """
    parts = [state, *state.get("others", [])]
    if len(parts) != world_size():
        raise BidexError(
            f"The checkpoint has {len(parts)} processes, but this run has {world_size()}. Start the same "
            "number of processes."
        )
    mine = parts[rank()]
    world.load_state_dict(mine["env"])
    learner.load_state_dict({**state["learner"], **mine["learner"]})


class _Stop(threading.Event):
    """A request to stop, and the first signal that requested it."""

    number: int = signal.SIGTERM

    def ask(self, number: int) -> None:
        if not self.is_set():
            self.number = number
            self.set()


@contextmanager
def _stop_requests() -> Iterator["_Stop"]:
    """Yield an event that is set when a signal asks the process to end.

    After the first SIGINT or SIGTERM, the old handlers of these two signals are restored, so that another SIGINT or
    SIGTERM acts at once. The other signals never break off an iteration: a single cause may send the same signal twice,
    or send SIGTERM after this signal.
    """
    stop = _Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # Python lets only the main thread set handlers
        return
    asking = (signal.SIGINT, signal.SIGTERM)
    numbers = (*asking, *notices())
    # None stands for a handler that was not set from Python and cannot be restored.
    old = {number: signal.getsignal(number) or signal.SIG_DFL for number in numbers}

    def restore(numbers: Iterable[signal.Signals]) -> None:
        for number in numbers:
            signal.signal(number, old[number])

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.ask(number)
        if number in asking:
            restore(asking)

    for number in numbers:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        restore(numbers)
