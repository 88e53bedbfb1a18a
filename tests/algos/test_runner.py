import os
import signal
from typing import Any

import pytest

from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.training import runner
from bidex_meta.training.launch import BATCH_SIGNALS
from bidex_meta.training.runner import train
from tests.algos.toy import ToyWorld, nearness

CONFIG = MTPPOConfig(hidden=(8,), rollout_steps=4, autocast="off")
ITERATION = 4 * 16


class Notes:
    """A record that keeps everything, and may do something after an iteration."""

    def __init__(self, after: Any = lambda iteration: None):
        self.logged: list[int] = []
        self.metrics: list[dict[str, float]] = []
        self.saved: list[tuple[int, dict[str, Any]]] = []
        self.after = after

    def log(self, metrics: dict[str, float], step: int) -> None:
        assert all(isinstance(value, float) for value in metrics.values())
        self.logged.append(step)
        self.metrics.append(metrics)
        self.after(len(self.logged))

    def save(self, state: dict[str, Any], step: int) -> None:
        self.saved.append((step, state))


def make() -> tuple[MTPPO, ToyWorld]:
    world = ToyWorld([nearness(0.5)], rows=16)
    return MTPPO(world, CONFIG, seed=0), world


def run(notes: Notes, iterations: int = 100, **options: Any) -> tuple[int, MTPPO]:
    learner, world = make()
    return train(learner, world, total_steps=iterations * ITERATION, record=notes, **options), learner


def test_training_ends_at_the_budget_and_saves_the_end():
    learner, world = make()
    notes = Notes()
    assert train(learner, world, total_steps=3 * ITERATION - 1, record=notes) == 0
    assert notes.logged == [ITERATION, 2 * ITERATION, 3 * ITERATION]
    assert [step for step, _ in notes.saved] == [3 * ITERATION]
    assert train(learner, world, total_steps=ITERATION, record=notes) == 0
    assert len(notes.logged) == 3 and len(notes.saved) == 1


def test_training_ends_with_the_iteration_in_which_the_time_is_up(monkeypatch: pytest.MonkeyPatch):
    notes = Notes()  # an iteration takes 10 s
    monkeypatch.setattr(runner.time, "monotonic", lambda: 1000.0 + 10.0 * len(notes.logged))
    learner, world = make()
    assert train(learner, world, total_steps=100 * ITERATION, total_seconds=25.0, record=notes) == 0
    assert [step for step, _ in notes.saved] == [3 * ITERATION]
    for steps, seconds in ((100, 25.0), (100, 45.0), (6, 1e9)):  # no iteration, two, one
        train(learner, world, total_steps=steps * ITERATION, total_seconds=seconds, spent_seconds=30.0, record=notes)
    assert [told["Perf/training_time"] for told in notes.metrics] == [0.0, 10.0, 20.0, 30.0, 40.0, 30.0]


def test_checkpoints_come_in_time_and_the_last_is_not_written_twice():
    notes = Notes()
    run(notes, 3, checkpoint_seconds=0.0)
    assert [step for step, _ in notes.saved] == notes.logged


def test_saving_takes_no_more_than_a_fiftieth_of_the_time(monkeypatch: pytest.MonkeyPatch):
    clock = [0.0]
    monkeypatch.setattr(runner.time, "monotonic", lambda: clock[0])
    saved: list[float] = []

    class Slow(Notes):  # an iteration takes 10 s, a checkpoint 4 s
        def log(self, metrics: dict[str, float], step: int) -> None:
            clock[0] += 10.0

        def save(self, state: dict[str, Any], step: int) -> None:
            saved.append(clock[0])
            clock[0] += 4.0

    run(Slow(), 70, checkpoint_seconds=60.0)
    # The first checkpoint comes after 60 s, the next one 200 s after its end, and so on; the last one comes at the end.
    assert saved == [60.0, 264.0, 468.0, 672.0, 716.0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *BATCH_SIGNALS])
def test_a_signal_ends_after_the_iteration_and_saves(number: signal.Signals):
    before = signal.getsignal(number)
    notes = Notes(after=lambda i: os.kill(os.getpid(), number) if i == 2 else None)
    assert run(notes)[0] == number
    assert [step for step, _ in notes.saved] == [2 * ITERATION]
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("where", ["record", "watch", "should_stop"])
def test_the_end_of_what_reads_the_output_ends_after_the_iteration_and_saves(where: str):
    notes, calls = Notes(), []

    def print_something(*_: object) -> Any:
        calls.append(where)
        if len(calls) == 2:
            raise BrokenPipeError
        return False if where == "should_stop" else {}

    if where == "record":
        notes.after = print_something
    others: dict[str, Any] = {} if where == "record" else {where: print_something}
    assert run(notes, **others)[0] == signal.SIGPIPE
    assert [step for step, _ in notes.saved] == [2 * ITERATION]


def test_of_sighup_a_second_one_changes_nothing_and_nohup_ignores_the_first():
    def twice(iteration: int) -> None:
        if iteration == 2:
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGHUP)

    before = signal.getsignal(signal.SIGHUP)
    stopped, learner = run(Notes(after=twice))
    assert (stopped, learner.env_steps) == (signal.SIGHUP, 2 * ITERATION)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        stopped, learner = run(Notes(after=twice), 3)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        assert (stopped, learner.env_steps) == (0, 3 * ITERATION)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_notice_of_a_batch_system_and_sigterm_after_it_are_one_request():
    def as_slurm_does(iteration: int) -> None:
        if iteration == 2:
            for number in (signal.SIGUSR2, signal.SIGUSR2, signal.SIGTERM):
                os.kill(os.getpid(), number)

    notes = Notes(after=as_slurm_does)
    stopped, learner = run(notes)
    assert (stopped, learner.env_steps) == (signal.SIGUSR2, 2 * ITERATION)
    assert [step for step, _ in notes.saved] == [2 * ITERATION]


def test_a_second_signal_acts_at_once():
    with pytest.raises(KeyboardInterrupt):
        run(Notes(after=lambda iteration: [os.kill(os.getpid(), signal.SIGINT) for _ in range(2)]))
