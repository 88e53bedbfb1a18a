"""Task variables that affect reward or success but are hidden in ML suites (only masked entries show them).

Each frozen number of a task is replaced by NaN in turn, and what becomes NaN depends on it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene, compile_scene
from bidex_meta.tasks.state import TaskState

_COMPARISONS = {"lt", "le", "gt", "ge", "__lt__", "__le__", "__gt__", "__ge__"}


@dataclass(frozen=True)
class Hidden:
    """Components of a variation that only masked entries show, in the order of the variation space.

    ``reward``: those that affect the reward of a given state; ``success``: those that affect its success alone.
    """

    reward: tuple[str, ...]
    success: tuple[str, ...]


def hidden(task: TaskClass) -> Hidden:
    """The task variables that meta suites hide; a fixture's pose is not among them, since other entries show it."""
    scene, space = compile_scene(task), task.variation_space
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.start_qpos[: scene.model.nq]
    mujoco.mj_forward(scene.model, data)
    sensors, names = torch.from_numpy(data.sensordata.copy())[None], space.names
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in (space.low, space.high))
    # A variation, and for each of its components one that differs in this alone, (1 + size, size).
    base = low + 0.2 * (high - low)
    frozen = task.freeze(torch.cat((base[None], base + 0.35 * torch.diag(high - low))))
    goal = [block.name for block in task.layout.blocks if block.goal]

    def moved(judge: Callable[[TaskState], Iterable[Tensor]]) -> set[str]:
        """Components that change a frozen number without which a function gives NaN."""
        found, first = set(), {key: values[:1] for key, values in frozen.items()}
        for key, columns in frozen.items():
            for column, values in enumerate(columns.unbind(1)):
                tainted = first[key].clone()
                tainted[:, column] = torch.nan
                given = judge(TaskState(sensors, scene.sensors, {**first, key: tainted}))
                if any(bool(value.isnan().any()) for value in given):
                    changed = zip(names, (values[1:] != values[0]).tolist(), strict=True)
                    found |= {name for name, differs in changed if differs}
        return found

    def compared(state: TaskState) -> list[Tensor]:
        with _Comparisons() as comparisons:
            task.success(state)
        return comparisons.operands

    shown = moved(lambda state: [task.observe(state)[name] for name in goal]) - _fixtures(task, scene, frozen)
    of_reward = moved(lambda state: task.reward_terms(state).values()) & shown
    of_success = (moved(compared) & shown) - of_reward
    return Hidden(*(tuple(name for name in names if name in chosen) for chosen in (of_reward, of_success)))


class _Comparisons(TorchFunctionMode):
    """Collects all tensors that are compared: a comparison with NaN is False, and would not show it."""

    def __init__(self) -> None:
        super().__init__()
        self.operands: list[Tensor] = []

    def __torch_function__(
        self, func: Callable[..., object], types: object, args: tuple = (), kwargs: dict[str, object] | None = None
    ) -> object:
        if getattr(func, "__name__", "") in _COMPARISONS:
            self.operands += [each for each in args if isinstance(each, Tensor)]
        return func(*args, **(kwargs or {}))


def _fixtures(task: TaskClass, scene: Scene, frozen: dict[str, Tensor]) -> set[str]:
    """Components that move a fixture."""
    names = task.variation_space.names
    starts = torch.from_numpy(np.tile(scene.start_qpos, (1 + len(names), 1)))
    parts = {part: starts[:, where] for part, where in scene.qpos.items()}
    task.start(torch.zeros(len(starts), task.start_draws, dtype=starts.dtype), frozen, parts)
    movable = starts[:, scene.model.nq :]
    return {name for name, row in zip(names, movable[1:], strict=True) if not torch.equal(row, movable[0])}
