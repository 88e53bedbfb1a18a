"""Recorded stretches of a step: a tape of operations in fixed memory, as a CUDA graph is one, against plain runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from bidex_meta import Benchmark
from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.world import World, world
from bidex_meta.world.graphs import CapturedStepper, EagerStepper, SideBySide, cuda_graphs, fresh
from tests.world.play import assert_same, number_of_ends, play, random_actions, suite_world
from tests.world.test_masked import MaskedEngine, at_work


class Tape(TorchDispatchMode):
    """Remembers operations with the very tensors that they read and made."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.done.append((func, args, kwargs or {}, result))
        return result

    def replay(self) -> None:
        for func, args, kwargs, result in self.done:
            for old, new in zip(tree_leaves(result), tree_leaves(func(*args, **kwargs)), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class StillEngine(MaskedEngine):
    """As an accelerator's engine: trouble is told in a tensor of fixed place."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._told = torch.zeros(self.num, dtype=torch.bool)

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        super().step(substeps, active)
        self._tell()

    def reset(self, mask: Tensor, start: Tensor) -> None:
        super().reset(mask, start)
        self._tell()

    def _tell(self) -> None:
        with at_work():
            self._told.copy_(CpuEngine.unstable(self))

    def unstable(self) -> Tensor:
        return self._told.clone()


def taped(
    recorder: list[CapturedStepper], count: list[int]
) -> Callable[[Callable[[], Any]], tuple[Callable[[], None], Any]]:
    """Records as CUDA does: the work is written down and not done."""

    def record(work: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
        state = recorder[0]._graphs._state
        before = fresh(state)
        with Tape() as tape:
            result = work()
        for name, value in before.items():
            state[name].copy_(value)
        count.append(1)
        return tape.replay, result

    return record


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., tuple[World, list[int]]]]:
    def make(suite: str, rows: int, tasks: int | None = None, mode: str = "SAME_STEP") -> tuple[World, list[int]]:
        with monkeypatch.context() as patch:
            maker = lambda models, of, room: StillEngine(models, of, threads=1)  # noqa: E731
            patch.setattr(world, "choose_engine", lambda *_: (torch.device("cpu"), maker))
            made = suite_world(suite, rows, mode, tasks_per_class=tasks)
        holder: list[CapturedStepper] = []
        count: list[int] = []
        made._stepper = CapturedStepper(made._state, made._put_state, taped(holder, count))
        holder.append(made._stepper)
        return made, count

    yield make


@pytest.mark.parametrize(("suite", "tasks"), [("MT4", None), ("ML4", None), ("MT4-v2", 0)])
def test_replayed_steps_are_plain_steps(
    suite: str, tasks: int | None, recorded: Callable[..., tuple[World, list[int]]]
) -> None:
    plain = suite_world(suite, 9, tasks_per_class=tasks)
    taped_world, count = recorded(suite, 9, tasks)
    actions = random_actions(plain, 75)
    actions[40, 3] = torch.nan
    for one in (plain, taped_world):
        one.reset(seed=3)
    a, b = play(plain, actions), play(taped_world, actions)
    assert_same(a, b)
    assert number_of_ends(a) >= 9 and a[40]["info/unstable"][3]
    assert all(np.array_equal(*pools) for pools in zip(plain.pools, taped_world.pools, strict=True))
    assert len(count) == 5  # controls, transitions, starts drawn ahead and taken, first observations


def told(world: World) -> list[dict[str, Tensor]]:
    """Return what a world tells of hidden parts in six steps, for one and for three goals."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for action in random_actions(world, 6, seed=1):
        goals = 2.0 * torch.rand(3, world.num_envs, world.hidden_size, generator=generator) - 1.0
        obs = world.step(action)[0]
        told = {"one": world.rewards_if(goals[0]), "three": world.rewards_if(goals)}
        found.append(told | {"own": world.with_goals(obs), "other": world.with_goals(obs, goals[1])})
    return found


@pytest.mark.parametrize(("suite", "mode"), [("ML1-v2", "DISABLED"), ("ML4", "DISABLED"), ("MT4", "NEXT_STEP")])
def test_replayed_trials_are_plain_trials(
    suite: str, mode: str, recorded: Callable[..., tuple[World, list[int]]]
) -> None:
    """Episodes of evaluations and trials begin together, with other tasks in each trial."""
    plain = suite_world(suite, 9, mode)
    taped_world, count = recorded(suite, 9, mode=mode)
    actions = random_actions(plain, 90)
    actions[40, 3] = torch.nan
    for trial in range(2):
        for one in (plain, taped_world):
            names = one.task_names
            one.set_tasks({name: pool[3 * trial :] for name, pool in zip(names, one.pools, strict=True)})
            one.reset()
        for begin in range(0, len(actions), 45):
            a, b = (play(one, actions[begin : begin + 45]) for one in (plain, taped_world))
            assert_same(a, b)
            if plain.hides_goals:
                assert_same(*(told(one) for one in (plain, taped_world)))
            if mode == "DISABLED":
                mask = torch.arange(9) % 2 == begin % 2
                first, second = (one.reset(options={"reset_mask": mask})[0] for one in (plain, taped_world))
                assert torch.equal(first, second)
    assert a[-1]["info/running/l"].unique().numel() > 1  # some episodes have ended before others
    # Controls and transitions are recorded, and what is told of hidden parts; again with the second trial's tasks.
    assert len(count) >= 2 * (6 if plain.hides_goals else 2)


def test_a_reset_other_tasks_and_a_loaded_state_are_seen(recorded: Callable[..., tuple[World, list[int]]]) -> None:
    plain, (made, count) = suite_world("MT4", 8), recorded("MT4", 8)
    actions = random_actions(plain, 40)
    for one in (plain, made):
        one.reset(seed=0)
        play(one, actions[:10])
    saved = plain.state_dict()
    for one in (plain, made):
        one.reset(options={"reset_mask": torch.arange(8) % 2 == 0})
    assert_same(play(plain, actions[10:20]), play(made, actions[10:20]))
    before = len(count)
    for one in (plain, made):
        one.set_tasks({"CatchUnderarm": one.pools[one.task_names.index("CatchUnderarm")][5:7]})
        one.reset()
    assert_same(play(plain, actions[20:30]), play(made, actions[20:30]))
    assert len(count) == 2 * before
    for one in (plain, made):
        one.load_state_dict(saved)
    assert_same(play(plain, actions[30:]), play(made, actions[30:]))


class FakeStream:
    """Writes down what is asked of it."""

    def __init__(self, log: list[tuple[str, str, object]], name: str) -> None:
        self._log, self.name = log, name

    def record_event(self) -> str:
        self._log.append((self.name, "records", None))
        return f"event of {self.name}"

    def wait_event(self, event: str) -> None:
        self._log.append((self.name, "waits", event))


def test_nothing_of_the_caller_stands_between_jobs_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """An event in CUDA's legacy stream could wait for the jobs before it: there is one, before all jobs."""
    log: list[tuple[str, str, object]] = []
    names = iter("ab")
    callers = {torch.device("cuda:1"): FakeStream(log, "caller")}
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: FakeStream(log, next(names)))
    monkeypatch.setattr(torch.cuda, "current_stream", callers.__getitem__)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    SideBySide(2, torch.device("cuda:1")).run([lambda i=i: log.append(("job", "runs", i)) for i in range(2)])
    assert log == [
        ("caller", "records", None),
        ("a", "waits", "event of caller"), ("job", "runs", 0),
        ("b", "waits", "event of caller"), ("job", "runs", 1),
        ("a", "records", None), ("caller", "waits", "event of a"),
        ("b", "records", None), ("caller", "waits", "event of b"),
    ]  # fmt: skip


def test_a_recording_is_made_on_the_device_of_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """On torch's current device it would be empty, and the world would stand still."""
    current: list[object] = ["cuda:0"]

    @contextmanager
    def on(device: object) -> Iterator[None]:
        current.append(device)
        yield
        current.pop()

    monkeypatch.setattr(torch.cuda, "Stream", lambda device: f"stream of {device}")
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: SimpleNamespace(replay=None))
    monkeypatch.setattr(torch.cuda, "device", on)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream, **_: on(stream))
    device = torch.device("cuda:1")
    _, where = cuda_graphs(device)(lambda: list(current))
    assert where == ["cuda:0", device, "stream of cuda:1"]


@pytest.mark.gpu
@pytest.mark.parametrize(("mode", "recorded"), [("SAME_STEP", 4), ("DISABLED", 2)])
def test_graphs_on_cuda_are_plain_steps(mode: str, recorded: int) -> None:
    """Nearly everywhere: sums are made in any order there, and what touches something grows apart from then on."""
    plain, graphs = (
        Benchmark("MT4").make_world("train", num_envs=64, device="cuda:0", autoreset_mode=mode) for _ in range(2)
    )
    plain._stepper = EagerStepper()
    actions = random_actions(plain, 12)
    for one in (plain, graphs):
        one.reset(seed=0)
    a, b = play(plain, actions.cuda()), play(graphs, actions.cuda())
    for x, y in zip(a, b, strict=True):
        for name in ("obs", "reward", "terminated", "truncated", "info/final_obs", "info/running/l"):
            apart = (x[name].float() - y[name].float()).abs().flatten()
            assert apart.quantile(0.95) < 1e-2, name
    assert isinstance(graphs._stepper, CapturedStepper) and len(graphs._stepper._graphs._recorded) == recorded
