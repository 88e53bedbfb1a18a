"""NEXT_STEP: the episodes of SAME_STEP, with a step between them that starts the next one."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from bidex_meta.worlds.humanoid import HumanoidWorld
from tests.world.play import suite_world

ROWS, STEPS = 6, 160
Make = Callable[[str], Any]


def hands(mode: str) -> Any:
    return suite_world("MT4", ROWS, mode)


def humanoid(mode: str) -> Any:
    return HumanoidWorld(ROWS, autoreset_mode=mode, threads=1)


def episodes(world: Any) -> list[list[list[torch.Tensor]]]:
    """The observations of each row's episodes under an action that each row holds; ends are as they are returned."""
    next_step = world.metadata["autoreset_mode"].name == "NEXT_STEP"
    action = torch.linspace(-1, 1, ROWS)[:, None].expand(ROWS, world.single_action_space.shape[0])
    obs, _ = world.reset(seed=3)
    found: list[list[list[torch.Tensor]]] = [[[row]] for row in obs]
    waiting = torch.zeros(ROWS, dtype=torch.bool)
    for _ in range(STEPS):
        obs, reward, terminated, truncated, info = world.step(action)
        ended = terminated | truncated
        assert torch.equal(ended, info["_final_obs"])
        assert not reward[waiting].any() and not ended[waiting].any() and not info["success"][waiting].any()
        for row in range(ROWS):
            if waiting[row]:
                found[row].append([obs[row]])
                continue
            found[row][-1].append(info["final_obs"][row])
            if ended[row] and not next_step:
                found[row].append([obs[row]])
        if next_step:
            assert torch.equal(obs[ended], info["final_obs"][ended])
            waiting = ended
    return found


@pytest.mark.parametrize("make", [hands, humanoid])
def test_episodes_are_those_of_same_step(make: Make) -> None:
    worlds = make("SAME_STEP"), make("NEXT_STEP")
    for world in worlds:
        world.stagger = False
    for one, other in zip(*map(episodes, worlds), strict=True):
        assert len(one) > 2 and len(other) > 2
        for a, b in list(zip(one, other, strict=False))[:-1]:
            assert torch.equal(torch.stack(a), torch.stack(b))


def test_gymnasiums_wrapper_counts_its_episodes() -> None:
    envs = RecordEpisodeStatistics(hands("NEXT_STEP").to_numpy())
    envs.reset(seed=0)
    lengths = []
    for _ in range(STEPS):
        info = envs.step(np.zeros(envs.action_space.shape, np.float32))[4]
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) >= ROWS and max(lengths) <= 75
