"""The way of an accelerator: masked resets of full size, and no look at a number in a step. Seen with C MuJoCo."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.world import World, world
from tests.world.play import assert_same, number_of_ends, play, random_actions, suite_world

LOOKS = ("_local_scalar_dense", "is_nonzero", "nonzero", "masked_select", "unique", "equal", "lift_fresh", "item")
"""Operations that wait for a value, have a shape that depends on one, or bring numbers from the host."""


_at_work: list[bool] = []
"""Not empty while C MuJoCo works, which looks at whatever it likes."""


@contextmanager
def at_work() -> Iterator[None]:
    _at_work.append(True)
    with _disable_current_modes():
        yield
    _at_work.pop()


class MaskedEngine(CpuEngine):
    """C MuJoCo with the resets of an accelerator's engine."""

    avoids_syncs = True

    def reset(self, mask: Tensor, start: Tensor) -> None:
        with at_work():
            super().reset(mask, start[mask])

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        with at_work():
            super().step(substeps, active)

    def unstable(self) -> Tensor:
        with at_work():
            return super().unstable()


class NoLooks(TorchDispatchMode):
    """Raises where a step would make the host wait for a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        indices = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ()
        refused = name == "cumsum" and args[0].is_floating_point()  # by torch, on a GPU in deterministic mode
        if refused or name in LOOKS or any(isinstance(i, Tensor) and i.dtype == torch.bool for i in indices):
            raise AssertionError(f"A step calls {func}.")
        return func(*args, **(kwargs or {}))


@contextmanager
def no_looks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Also forbids what torch does to tensors on the CPU without telling a dispatch mode."""

    def guarded(owner: Any, name: str) -> Any:
        original = getattr(owner, name)

        def method(*args: Any, **kwargs: Any) -> Any:
            if not _at_work and not (name == "as_tensor" and isinstance(args[0], Tensor)):
                raise AssertionError(f"A step calls {name}.")
            return original(*args, **kwargs)

        return method

    with NoLooks(), monkeypatch.context() as patch:
        for name in ("tolist", "cpu", "numpy", "item", "__bool__", "__int__", "__float__"):
            patch.setattr(torch.Tensor, name, guarded(torch.Tensor, name))
        for name in ("tensor", "as_tensor", "from_numpy"):
            patch.setattr(torch, name, guarded(torch, name))
        yield


@pytest.fixture
def masked(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Worlds made in this test have the accelerators' kind of engine."""
    with monkeypatch.context() as patch:
        maker = lambda models, rows, room: MaskedEngine(models, rows, threads=1)  # noqa: E731
        patch.setattr(world, "choose_engine", lambda *_: (torch.device("cpu"), maker))
        yield


@pytest.mark.parametrize(("mode", "tasks"), [("SAME_STEP", None), ("DISABLED", None), ("SAME_STEP", 0)])
def test_masked_resets_give_the_same_episodes(mode: str, tasks: int | None, request: pytest.FixtureRequest) -> None:
    one = suite_world("MT4", 9, mode, tasks_per_class=tasks)
    request.getfixturevalue("masked")
    other = suite_world("MT4", 9, mode, tasks_per_class=tasks)
    assert_same([{"obs": one.reset(seed=3)[0]}], [{"obs": other.reset(seed=3)[0]}])
    actions = random_actions(one, 80)
    a, b = play(one, actions), play(other, actions)
    assert_same(a, b)
    assert number_of_ends(a) >= 9
    if mode == "DISABLED":
        mask = torch.arange(9) % 2 == 0
        assert_same(*([{"obs": w.reset(options={"reset_mask": mask})[0]}] for w in (one, other)))
        assert_same(play(one, actions[:5]), play(other, actions[:5]))


@pytest.mark.parametrize(
    ("name", "tasks"), [("MT4", None), ("ML4", None), ("MT20", None), ("MT20-v2", 0), ("MT1-objects", None)]
)
def test_no_step_of_a_suite_looks_at_a_number(
    name: str, tasks: int | None, masked: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_steps_look_at_nothing(suite_world(name, 20, tasks_per_class=tasks), monkeypatch)


def assert_steps_look_at_nothing(rows: World, monkeypatch: pytest.MonkeyPatch) -> None:
    rows.reset(seed=0)
    actions = random_actions(rows, 10)
    rows.step(actions[0])  # constants are brought to the device once
    with no_looks(monkeypatch):
        for action in actions[1:]:
            rows.step(action)


def test_the_mode_forbids_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.arange(4.0)
    numbers = x.numpy()
    looks = (
        lambda: x[x > 1.0], lambda: x.nonzero(), lambda: x.sum().item(), lambda: bool(x.any()), lambda: x.cpu(),
        lambda: x.cumsum(0), lambda: torch.from_numpy(numbers), lambda: torch.as_tensor(numbers),
        lambda: x.new_tensor((1.0, 2.0)), lambda: x.tolist(), lambda: x.masked_fill_(x > 1.0, 0.0)[x > 2.0],
    )  # fmt: skip
    for look in looks:
        with no_looks(monkeypatch), pytest.raises(AssertionError, match="A step"):
            look()
