"""Data of toy worlds: what a plain loop sees of them, as the learners take it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data import Episode
from bidex_meta.data.joined import Joined, gathered


def played(world: Any, policy: Callable[[Tensor], Tensor], steps: int) -> list[Episode]:
    obs, _ = world.reset(seed=7)
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(world.num_envs)]
    found = []
    for _ in range(steps):
        action = policy(obs).clamp(-1, 1)
        after, reward, terminated, truncated, info = world.step(action)
        for row, told in enumerate(rows):
            told.append((obs[row], action[row], reward[row], terminated[row], truncated[row], info["final_obs"][row]))
            if terminated[row] or truncated[row]:
                columns = [torch.stack(column).numpy() for column in zip(*told, strict=True)]
                states = np.concatenate([columns[0], columns[5][-1:]])
                slot = int(world.task_id[row])
                found.append(Episode(states, *columns[1:5], task=slot, task_name=world.task_names[slot], row=row))
                told.clear()
        obs = after
    return found


def as_data(episodes: list[Episode]) -> Joined:
    taken = ((episode, episode.task, episode.observations) for episode in episodes)
    sizes = episodes[0].observations.shape[1], episodes[0].actions.shape[1]
    return gathered(taken, sum(map(len, episodes)), len(episodes), *sizes)


def noisy(best: Callable[[Tensor], Tensor], std: float, shift: float = 0.0) -> Callable[[Tensor], Tensor]:
    generator = torch.Generator().manual_seed(3)

    def act(obs: Tensor) -> Tensor:
        action = best(obs)
        return action + shift + std * torch.randn(action.shape, generator=generator)

    return act
