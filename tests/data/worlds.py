"""A world that does all that a recorder must bear, and a plain loop that says what it did."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data import Episode
from tests.fake_world import FakeWorld
from tests.points import PointWorld, ring


class Rough(PointWorld):
    """Points whose episodes end early or by time, break at given steps, and may begin within.

    Args:
        breaks_at: (step, row) pairs, steps of the world counted from its making.
        brittle: Whether steps break that follow from the seed, the row, its episode and the step, about one in 23: the
            same in whatever process they are played.
        late: Elapsed step at which the first episode of each row begins in SAME_STEP mode.
        given: As ``PointWorld``.
    """

    def __init__(
        self,
        *given: Any,
        breaks_at: tuple[tuple[int, int], ...] = (),
        brittle: bool = False,
        late: tuple[int, ...] = (),
        **more: Any,
    ):
        super().__init__(*given, **more)
        self.unstable, self._brittle, self._late = breaks_at, brittle, late

    def _broken(self) -> Tensor:
        drawn = self.seed % 97 + 7 * torch.arange(self.num_envs) + 3 * self.episodes.number + 5 * self.episodes.elapsed
        return FakeWorld._broken(self) | (self._brittle & (drawn % 23 == 0))

    def _first_elapsed(self) -> Tensor:
        return torch.tensor([*self._late, *[0] * self.num_envs][: self.num_envs])


def rough(num_envs: int = 5, mode: str = "SAME_STEP", **more: Any) -> Rough:
    """Two slots, of three and two tasks."""
    return Rough(num_envs, {"Near": 0.5 * ring(3), "Far": ring(2)}, (5, 8), ends=True, noise=0.4, mode=mode, **more)


@dataclass
class Plain:
    """What a plain loop sees of a world: each row's running episode as lists, and those that were whole.

    It asks the world for nothing but what ``reset`` and ``step`` return, and ``task_index`` and ``pools``.
    """

    world: Any
    whole: list[Episode] = field(default_factory=list)
    broken: int = 0

    def __post_init__(self) -> None:
        self.running: list[dict[str, Any] | None] = [None] * self.world.num_envs

    def reset(self, **keywords: Any) -> Tensor:
        obs, _ = self.world.reset(**keywords)
        mask = (keywords.get("options") or {}).get("reset_mask", torch.ones(self.world.num_envs, dtype=torch.bool))
        for row in mask.nonzero().squeeze(1).tolist():
            self._start(row, obs)
        return obs

    def step(self, action: Tensor) -> Tensor:
        obs, reward, terminated, truncated, info = self.world.step(action)
        for row, now in enumerate(self.running):
            if now is None:
                continue
            if info["unstable"][row]:
                self.broken += 1
            else:
                now["observations"].append(info["final_obs"][row].numpy().copy())
                now["actions"].append(action[row].clamp(-1, 1).numpy().copy())
                now["rewards"].append(float(reward[row]))
                now["unscaled"].append(float(info["reward_unscaled"][row]))
                now["success"] |= bool(info["success"][row])
            if terminated[row] or truncated[row]:
                if info["counted"][row] and now["rewards"]:
                    self.whole.append(self._episode(row, now, bool(terminated[row]), bool(info["unstable"][row])))
                self.running[row] = None
                if self.world.metadata["autoreset_mode"].name == "SAME_STEP":
                    self._start(row, obs)
        return obs

    def _start(self, row: int, obs: Tensor) -> None:
        first = {"observations": [obs[row].numpy().copy()], "task": int(self.world.task_index[row])}
        self.running[row] = {**first, "actions": [], "rewards": [], "unscaled": [], "success": False}

    def _episode(self, row: int, now: dict[str, Any], terminated: bool, unstable: bool) -> Episode:
        slot, last = int(self.world.task_id[row]), [False] * (len(now["rewards"]) - 1)
        return Episode(
            np.stack(now["observations"]),
            np.stack(now["actions"]),
            np.array(now["rewards"], np.float32),
            np.array([*last, terminated]),
            np.array([*last, not terminated]),
            task=slot,
            task_name=self.world.task_names[slot],
            task_index=now["task"],
            variation=self.world.pools[slot][now["task"]],
            success=now["success"],
            broken=unstable,
            return_unscaled=float(np.sum(now["unscaled"])),
            row=row,
        )


def same(a: Episode, b: Episode) -> bool:
    """Whether two episodes are equal, arrays bit for bit."""
    arrays = ("observations", "actions", "rewards", "terminated", "truncated", "variation")
    words = ("task", "task_name", "task_index", "success", "broken", "row", "policy")
    return (
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays)
        and all(getattr(a, name) == getattr(b, name) for name in words)
        and abs(a.return_unscaled - b.return_unscaled) < 1e-4
    )
