"""Actions: position targets, and forces that move a base without turning it (docs/figures.md, control, base)."""

import numpy as np
import torch

from bidex_meta.hands.hand import SIDES
from bidex_meta.world import World
from tests.hands import figures
from tests.tasks.worlds import (
    MOVING,
    each_case,
    each_moving,
    engine_of,
    mixed_world,
    object_joints_of,
    objects_of,
    restart,
    scene_of,
    send_hands_away,
    world_of,
)

FORCE, TORQUE = 1666.67, 16.667
"""Newton and newton metre per unit of scale (docs/figures.md, base)."""
HALF_SECOND = 30


def held() -> np.ndarray:
    """Joint actions whose targets are the start angles, zero. Shape (20,)."""
    low, high = figures.LOW[figures.ACTUATED], figures.HIGH[figures.ACTUATED]
    return -(high + low) / (high - low)


def free_bases(name: str, actions: np.ndarray) -> tuple[World, np.ndarray, np.ndarray]:
    """Drives both bases by actions (n, 6) for half a second, far from all else; their poses (n, 2, 7) before, after."""
    world = world_of(name, True, len(actions))
    world.reset(seed=0)
    engine, scene = engine_of(world), scene_of(world)
    qpos = torch.from_numpy(scene.start_qpos).repeat(len(actions), 1)
    send_hands_away(scene, qpos)
    for i, joint in enumerate(name for name in object_joints_of(scene) if name.startswith("water")):
        qpos[:, scene.qpos[joint]] = -9.0 - i  # drops have three slides each; so no two of them meet
    for i, body in enumerate(objects_of(scene)):
        qpos[:, scene.qpos[body]] = torch.tensor([-9.0 - i, 0.0, 4.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    restart(world, qpos)
    places = [scene.qpos[f"{side}/base"] for side in SIDES]
    before = np.stack([engine.qpos[:, place].numpy().copy() for place in places], axis=1)
    one_hand = np.concatenate((np.tile(held(), (len(actions), 1)), actions), axis=1)
    whole = torch.from_numpy(np.tile(one_hand, (1, 2)))
    for _ in range(HALF_SECOND):
        world.parts[0].step(whole, None)
    assert not engine.unstable().any()
    return world, before, np.stack([engine.qpos[:, place].numpy().copy() for place in places], axis=1)


def turned(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return (
        figures.rotation(after[..., 3:].reshape(-1, 4)) * figures.rotation(before[..., 3:].reshape(-1, 4)).inv()
    ).magnitude()


@each_moving
def test_a_full_force_moves_a_base_and_does_not_turn_it(name: str) -> None:
    axes = np.concatenate((np.eye(6)[:3], -np.eye(6)[:3]))
    world, before, after = free_bases(name, axes)
    assert turned(before, after).max() < 0.05
    force = FORCE * figures.SCALES[name][0]
    engine, scene = engine_of(world), scene_of(world)
    for side in SIDES:
        first = scene.model.joint(f"{side}/free").dofadr[0]
        velocity = engine.qvel[:, first : first + 3].numpy()
        np.testing.assert_allclose(velocity, axes[:, :3] * force / 501.0, atol=0.01 * force / 501.0)
    # A time constant of mass over damping, 0.01 s, is lost at the start.
    moved = after[..., :3] - before[..., :3]
    expected = axes[:, None, :3] * force / 501.0 * (0.5 - 0.01)
    np.testing.assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=0.02 * force / 501.0)


@each_moving
def test_a_held_base_stays(name: str) -> None:
    _, before, after = free_bases(name, np.zeros((1, 6)))
    assert turned(before, after).max() < 1e-3
    assert np.abs(after[..., :3] - before[..., :3]).max() < 1e-4


@each_moving
def test_a_torque_turns_a_base_at_the_rate_of_its_damping(name: str) -> None:
    """Along each of the hand's own axes, as large as the world-frame actions allow: torque / (2.60, 2.65, 1.12)."""
    for i in range(2):
        axes = figures.rotation(figures.CLASS_MOUNTS[name][i][1]).as_matrix().T
        actions = axes / np.abs(axes).max(axis=1, keepdims=True)
        world, before, after = free_bases(name, np.concatenate((np.zeros((3, 3)), actions), axis=1))
        first = scene_of(world).model.joint(f"{SIDES[i]}/free").dofadr[0]
        rate = engine_of(world).qvel[:, first + 3 : first + 6].numpy()
        torque = TORQUE * figures.SCALES[name][1] * np.linalg.norm(actions, axis=1)
        expected = np.diag(torque / np.array(figures.ANGULAR_DAMPING))
        np.testing.assert_allclose(np.diag(rate), np.diag(expected), rtol=0.05)
        off_axis = np.abs(rate - np.diag(np.diag(rate))).max(axis=1)
        assert (off_axis < 0.1 * np.diag(expected)).all(), rate
        # A pure torque leaves the point where it is applied nearly in place.
        assert np.linalg.norm(after[:, i, :3] - before[:, i, :3], axis=1).max() < 0.02


@each_case
def test_actions_become_targets_and_wrenches_exactly(name: str, moving: bool) -> None:
    world = world_of(name, moving, 4)
    world.reset(seed=0)
    engine, model = engine_of(world), scene_of(world).model
    action = torch.rand(4, world.action_size, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    action[0], action[1] = 1.0, -1.0
    world.parts[0].control(action)
    check_controls(name, engine.ctrl.numpy(), engine.xfrc_applied.numpy(), action.numpy(), model)
    np.testing.assert_allclose(engine.ctrl[0].numpy(), np.tile(figures.HIGH[figures.ACTUATED], 2), atol=1e-12)
    np.testing.assert_allclose(engine.ctrl[1].numpy(), np.tile(figures.LOW[figures.ACTUATED], 2), atol=1e-12)


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
            played = action[member.world_rows].double().numpy()
            ctrl, wrench = engine.ctrl[rows].numpy(), engine.xfrc_applied[rows].numpy()
            check_controls(member.scene.task.name, ctrl, wrench, played, member.scene.model)
    covered = [member.scene.task.name for part in world.parts for member in part.group.members]
    assert sorted(covered) == sorted(MOVING)


def test_actions_are_clipped() -> None:
    world = world_of("CatchUnderarm", True, 2)
    world.reset(seed=0)
    world.step(torch.stack((torch.full((52,), 7.0), torch.full((52,), 1.0))))
    engine = engine_of(world)
    np.testing.assert_array_equal(engine.ctrl[0].numpy(), engine.ctrl[1].numpy())
    np.testing.assert_array_equal(engine.xfrc_applied[0].numpy(), engine.xfrc_applied[1].numpy())
