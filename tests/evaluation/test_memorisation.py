"""The probe of memorisation: chance where nothing shows a task, near 1 where a start does."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta.benchmark import Benchmark
from bidex_meta.evaluation.memorisation import memorised

TASKS = 40


class Starts:
    """A world of one class whose starts show noise, or the task's value with little noise."""

    task_names = ("Reach",)
    slot_env_ids = (slice(0, TASKS),)
    task_index = torch.arange(TASKS)

    def __init__(self, shown: bool) -> None:
        self.shown = shown
        self.pools = (np.random.default_rng(1).uniform(-1, 1, (TASKS, 1)),)

    def reset(self, seed: int) -> tuple[torch.Tensor, dict[str, Any]]:
        noise = np.random.default_rng(seed).normal(size=(TASKS, 4))
        if self.shown:
            noise = 0.001 * noise + self.pools[0]
        return torch.from_numpy(noise), {}


@pytest.mark.parametrize(
    ("shown", "named", "explained"), [(False, (0.0, 0.08), (-1.0, 0.02)), (True, (0.7, 1.0), (0.9, 1.0))]
)
def test_a_start_that_shows_the_task_is_found(
    shown: bool, named: tuple[float, float], explained: tuple[float, float]
) -> None:
    world: Any = Starts(shown)
    found = memorised(world)["Reach"]
    assert named[0] <= found.named <= named[1]
    assert explained[0] <= found.explained <= explained[1]
    assert found.chance == 1 / TASKS


def test_starts_of_version_2_do_not_name_the_task() -> None:
    world = Benchmark("ML4-v2", seed=5).make_world("train", 90, autoreset_mode="DISABLED", threads=1)
    for name, found in memorised(world, episodes=6).items():
        interval = 3 * np.sqrt(found.chance * (1 - found.chance) / (30 * 6))
        assert found.named <= found.chance + interval, name
        assert found.explained <= 0.02, name
    world.close()


@pytest.mark.parametrize("suite", ["MT1-DoorOpenOutward-shared", "MT4-v2"])
def test_starts_that_show_the_goal_are_found_among_fifty_tasks(suite: str) -> None:
    """The probe can fail: fifty goals along one number differ too little for a regression of labels."""
    world = Benchmark(suite).make_world(
        "train", 50 * (1 if suite.startswith("MT1") else 4), autoreset_mode="DISABLED", threads=1
    )
    for name, found in memorised(world).items():
        assert found.named > 0.9 and found.explained > 0.9, name
    world.close()


def test_what_is_the_same_in_every_episode_counts_for_nothing() -> None:
    world: Any = SimpleNamespace(
        task_names=("Reach",), slot_env_ids=(slice(0, TASKS),), task_index=torch.arange(TASKS),
        pools=(np.zeros((TASKS, 1)),), reset=lambda seed: (torch.ones(TASKS, 3), {}),
    )  # fmt: skip
    assert memorised(world)["Reach"].named == 1 / TASKS


def test_a_class_with_few_tasks_gets_as_many_guesses_as_one_with_many() -> None:
    resets = []
    world: Any = SimpleNamespace(
        task_names=("Reach",), slot_env_ids=(slice(0, 4),), task_index=torch.arange(4), pools=(np.zeros((4, 1)),),
        reset=lambda seed: (torch.ones(4, 3), resets.append(seed)),
    )  # fmt: skip
    memorised(world)
    assert len(resets) == 125
