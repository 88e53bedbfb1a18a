"""Actions: position targets, and forces and torques on the bases (docs/figures.md, control, base)."""

import numpy as np
import torch

from bidex_meta.hands.hand import SIDES
from tests.hands import figures
from tests.tasks.worlds import MOVING, mixed_world


def check_controls(name: str, ctrl: np.ndarray, wrench: np.ndarray, action: np.ndarray, model) -> None:
    low, high = figures.LOW[figures.ACTUATED], figures.HIGH[figures.ACTUATED]
    share = action.shape[1] // 2
    expected = np.zeros_like(wrench)
    for i, side in enumerate(SIDES):
        hand = action[:, i * share : (i + 1) * share]
        names = [model.actuator(k).name for k in range(20 * i, 20 * i + 20)]
        assert names == [f"{side}/A_{figures.NAMES[k]}" for k in figures.ACTUATED]
        np.testing.assert_allclose(
            ctrl[:, 20 * i : 20 * i + 20], low + (hand[:, :20] + 1) / 2 * (high - low), atol=1e-12
        )
        if share == 26:
            transition, orientation = figures.SCALES[name]
            body = model.body(f"{side}/base").id
            expected[:, body, :3] = hand[:, 20:23] * 100_000 / 60 * transition
            expected[:, body, 3:] = hand[:, 23:26] * 1_000 / 60 * orientation
    np.testing.assert_allclose(wrench, expected, rtol=1e-12, atol=1e-12)


def test_every_class_of_a_mixed_world_has_its_own_scales() -> None:
    world = mixed_world(2)
    world.reset(seed=0)
    action = torch.rand(world.num_envs, 52, generator=torch.Generator().manual_seed(2)) * 2 - 1
    world.step(action)
    for part in world.parts:
        engine = part.group.engine
        for member in part.group.members:
            rows = member.engine_rows
            played = action[member.env_ids].double().numpy()
            ctrl, wrench = engine.ctrl[rows].numpy(), engine.xfrc_applied[rows].numpy()
            check_controls(member.scene.task.name, ctrl, wrench, played, member.scene.model)
    covered = [member.scene.task.name for part in world.parts for member in part.group.members]
    assert sorted(covered) == sorted(MOVING)
