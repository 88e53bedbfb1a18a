"""Task variables that affect reward or success but are hidden in ML suites (only masked entries show them).

They are computed: each frozen number of a task is replaced by NaN in turn, and what becomes NaN depends on it. So no
state near a goal is needed, and a class cannot declare one thing and do another.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene, compile_scene
from bidex_meta.tasks.state import TaskState

_COMPARISONS = {"lt", "le", "gt", "ge", "__lt__", "__le__", "__gt__", "__ge__"}
Frozen = dict[str, Tensor]


@dataclass(frozen=True)
class Hidden:
    """Components of a variation that only masked entries show, in the order of the variation space."""

    reward: tuple[str, ...]
    """Those that affect the reward of a given state."""
    success: tuple[str, ...]
    """Those that affect its success alone."""


def hidden(task: TaskClass) -> Hidden:
    """The task variables that meta suites hide; a fixture's pose is not among them, since other entries show it."""
    scene = compile_scene(task)
    sensors = _sensors(scene)
    names, variations = task.variation_space.names, _one_changed_at_a_time(task)
    frozen = task.freeze(variations)
    goal = [block.name for block in task.layout.blocks if block.goal]

    def moved(judge: Callable[[TaskState], Iterable[Tensor]]) -> set[str]:
        """Components that change a frozen number on which a function's values depend."""
        found = set()
        for key, column in _used(judge, sensors, scene, {key: values[:1] for key, values in frozen.items()}):
            values = frozen[key][:, column]
            found |= {name for name, other in zip(names, values[1:].tolist(), strict=True) if other != values[0]}
        return found

    shown = moved(lambda state: [task.observe(state)[name] for name in goal]) - _fixtures(task, scene, frozen)
    of_reward = moved(lambda state: task.reward_terms(state).values()) & shown
    of_success = (moved(lambda state: _compared(task, state)) & shown) - of_reward
    return Hidden(*(tuple(name for name in names if name in chosen) for chosen in (of_reward, of_success)))


def _one_changed_at_a_time(task: TaskClass) -> Tensor:
    """A variation, and for each of its components one that differs in this alone, (1 + size, size)."""
    low, high = (
        torch.tensor(ends, dtype=torch.float64) for ends in (task.variation_space.low, task.variation_space.high)
    )
    return torch.cat(((low + 0.2 * (high - low))[None], low + 0.2 * (high - low) + 0.35 * torch.diag(high - low)))


def _sensors(scene: Scene) -> Tensor:
    """Sensor values at the nominal start, (1, nsensordata)."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.start_qpos[: scene.model.nq]
    mujoco.mj_forward(scene.model, data)
    return torch.from_numpy(data.sensordata.copy())[None]


def _used(
    judge: Callable[[TaskState], Iterable[Tensor]], sensors: Tensor, scene: Scene, frozen: Frozen
) -> list[tuple[str, int]]:
    """Frozen numbers, by key and column, without which a function gives NaN."""
    found = []
    for key, values in frozen.items():
        for column in range(values.shape[1]):
            tainted = values.clone()
            tainted[:, column] = torch.nan
            given = judge(TaskState(sensors, scene.sensors, {**frozen, key: tainted}))
            if any(bool(value.isnan().any()) for value in given):
                found.append((key, column))
    return found


class _Comparisons(TorchFunctionMode):
    """Collects all tensors that are compared: a comparison with NaN is False, and would not show it."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Tensor] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__name__", "") in _COMPARISONS:
            self.seen += [each for each in args if isinstance(each, Tensor)]
        return func(*args, **(kwargs or {}))


def _compared(task: TaskClass, state: TaskState) -> list[Tensor]:
    """All tensors that success compares."""
    with _Comparisons() as comparisons:
        task.success(state)
    return comparisons.seen


def _fixtures(task: TaskClass, scene: Scene, frozen: Frozen) -> set[str]:
    """Components that move a fixture."""
    names = task.variation_space.names
    starts = torch.from_numpy(np.tile(scene.start_qpos, (1 + len(names), 1)))
    parts = {part: starts[:, where] for part, where in scene.qpos.items()}
    task.start(torch.zeros(len(starts), task.start_draws, dtype=starts.dtype), frozen, parts)
    movable = starts[:, scene.model.nq :]
    return {name for name, row in zip(names, movable[1:], strict=True) if not torch.equal(row, movable[0])}
