"""Gymnasium's keys of a step: there where something ended, as its own vector environments have them."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bidex_meta.metaworld.batched import MetaWorldWorld
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.episodes import Episodes
from tests.points import PointWorld, ring
from tests.world.play import ENDS, random_actions, suite_world


class Countdown(gymnasium.Env):
    """Ends after a number of steps; what Gymnasium makes of several is the oracle."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.left = self.steps
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.left -= 1
        return np.zeros(1, np.float32), 1.0, False, self.left == 0, {"success": True}


def test_keys_and_masks_are_where_gymnasium_has_them() -> None:
    """Rows of 2, 3 and 3 steps: the keys, their masks and the zeros outside these, step by step."""
    envs = [gymnasium.wrappers.RecordEpisodeStatistics(Countdown(steps)) for steps in (2, 3, 3)]
    oracle = SyncVectorEnv([lambda env=env: env for env in envs], autoreset_mode=AutoresetMode.SAME_STEP)
    world = PointWorld(3, {"Near": ring(2), "Far": ring(3)}, (2, 3), mode="SAME_STEP")
    world.max_episode_steps = torch.tensor([2, 3, 3])
    oracle.reset()
    world.reset(seed=0)
    world.episodes.begin(torch.ones(3, dtype=torch.bool), torch.zeros(3, dtype=torch.int64))
    for _ in range(7):
        theirs = oracle.step(oracle.action_space.sample())[-1]
        ours = world.step(torch.zeros(3, 2))[-1]
        assert ("final_info" in ours) == ("final_info" in theirs) == ("episode" in ours)
        if "final_info" in theirs:
            assert ours["_final_info"].tolist() == theirs["_final_info"].tolist() == ours["_episode"].tolist()
            expected, found = theirs["final_info"], ours["final_info"]
            assert {"success", "_success", "episode", "_episode"} <= expected.keys() & found.keys()
            assert found["_episode"].tolist() == expected["_episode"].tolist() == found["_success"].tolist()
            for episode in (ours["episode"], found["episode"]):
                assert episode["l"].tolist() == expected["episode"]["l"].tolist()
                assert ((episode["t"] > 0) == ours["_episode"]).all() and (episode["r"] == 0)[~ours["_episode"]].all()


MADE: dict[str, Callable[[], Any]] = {
    "SAME_STEP": lambda: suite_world("MT4", 8),
    "DISABLED": lambda: suite_world("MT4", 8, "DISABLED"),
    "Meta-World": lambda: MetaWorldWorld("metaworld/MT3", 3),
    "warp": lambda: World(suite_world("MT4", 8).slots[:1], WorldConfig(3, engine="warp", threads=1)),
}


@pytest.mark.parametrize("kind", MADE)
def test_they_repeat_the_contracts_keys(kind: str) -> None:
    """The numbers of rows that ended, zero in the others; on the warp engine in every step."""
    world = MADE[kind]()
    world.reset(seed=0)
    if kind == "Meta-World":
        world.episodes.elapsed += 490 - world.episodes.elapsed
    seen = 0
    generator = torch.Generator().manual_seed(0)
    for _ in range(80 if kind != "Meta-World" else 12):
        info = world.step(2 * torch.rand(world.action_space.shape, generator=generator) - 1)[-1]
        ended = info["_final_obs"]
        assert all((key in info) == (bool(ended.any()) or kind == "warp") for key in ENDS)
        if "episode" not in info:
            continue
        seen += int(ended.sum())
        assert torch.equal(info["_final_info"], ended) and torch.equal(info["_episode"], info["episode_mask"])
        final = info["final_info"]
        for name, mask, of in [("success", ended, info), ("unstable", ended, info), ("reward_unscaled", ended, info)]:
            assert torch.equal(final[name], of[name] * mask) and final[name].dtype == of[name].dtype
        for name, value in info["running"].items():
            for episode in (info["episode"], final["episode"]):
                assert torch.equal(episode[name], value * info["episode_mask"]) and episode[name].dtype == value.dtype
    assert seen > 0


def test_without_stagger_first_episodes_are_whole() -> None:
    world = suite_world("MT4", 8)
    whole = World(world.slots, WorldConfig(8, stagger=False, threads=1))
    world.stagger = False
    staggered, _ = suite_world("MT4", 8).reset(seed=0)
    assert torch.equal(world.reset(seed=0)[0], staggered), "staggering leaves the start itself alone"
    for other in (whole, world, copy.deepcopy(world)):
        other.reset(seed=0)
        assert torch.equal(other.episodes.elapsed, whole.episodes.elapsed)
    assert (whole.episodes.elapsed == 0).all() and whole.episodes.counts.all()
    ended = torch.zeros(8, dtype=torch.bool)
    for action in random_actions(whole, 75):
        info = whole.step(action)[-1]
        assert torch.equal(info["episode_mask"], info["_final_obs"])
        ended |= info["_final_obs"]
    assert ended.any()


@pytest.mark.parametrize("at_end", [False, True])
def test_an_episode_whose_physics_broke_is_no_success(at_end: bool) -> None:
    """Evaluations leave out such episodes, so that training figures and viewers must not count their success."""
    episodes = Episodes.fresh(2, torch.device("cpu"))
    yes = torch.ones(2, dtype=torch.bool)
    one = torch.ones(2)
    for _ in range(15):
        episodes.add(yes, one, one, yes, ~yes)
    assert episodes.statistics(at_end)["success"].tolist() == [True, True]
    breaks = torch.tensor([True, False])
    episodes.add(yes, one, one, ~breaks, breaks)
    assert episodes.statistics(at_end)["success"].tolist() == [False, True]
    episodes.add(~breaks, one, one, yes, ~yes)  # the broken episode is over
    assert episodes.statistics(at_end)["success"].tolist() == [False, True]
