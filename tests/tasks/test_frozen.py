"""Values that an episode of version 2 draws only affect its start, not rewards, success and failure."""

from dataclasses import replace
from typing import Literal

import pytest
import torch

from bidex_meta.rules import V2
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.tasks.state import TaskState

_ROWS = 5


@pytest.mark.parametrize("reward", ["v2", "paper"])
@pytest.mark.parametrize("name", registry.names())
def test_rewards_do_not_depend_on_what_an_episode_draws(name: str, reward: Literal["v2", "paper"]) -> None:
    task = registry.get(name, True)
    task.adopt(replace(V2, reward=reward))
    scene = compile_scene(task)
    generator = torch.Generator().manual_seed(0)

    def uniform(columns: int) -> torch.Tensor:
        return torch.rand(_ROWS, columns, generator=generator, dtype=torch.float64)

    sensors = 2.0 * uniform(scene.model.nsensordata) - 1.0
    variation = task.varied(uniform(task.variation_space.size))
    found = []
    for draws in (None, 2.0 * uniform(task.draws) - 1.0):
        state = TaskState(sensors, scene.sensors, task.frozen(variation, draws))
        found.append(task.rewards(state) | {"success": task.success(state), "failed": task.failed(state)})
    # The paper's reward of a throw reads the orientation at success, for which version 2 has one nominal value.
    nominal = {"pose", "pose1", "pose2"} if reward == "paper" else set()
    for term in found[0].keys() - nominal:
        assert torch.equal(found[0][term], found[1][term]), term
