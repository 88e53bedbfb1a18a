"""Observations with point clouds: nothing of an object that is out of sight, and the same by either kind of row."""

import mujoco
import pytest
import torch
from torch import Tensor

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.contract import ObservationGroup
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.surfaces import FIXTURE, OBJECT, body_kinds, sample

COUNT = 64


def group(world: World, name: str) -> ObservationGroup:
    return next(each for each in world.observation_groups if each.name == name)


def cloud(world: World, obs: Tensor) -> Tensor:
    (where,) = group(world, "points").where
    return obs[:, where].view(len(obs), -1, 3)


def banish(world: World, shift: float) -> None:
    """Puts all that moves and is of no hand behind the camera: free and fixed alike, and gives it another motion."""
    for part in world.parts:
        engine, scene = part.group.engine, part.group.members[0].scene
        model = scene.model
        kinds = body_kinds(model)
        start = engine.placement()
        for joint in range(model.njnt):
            if kinds[model.jnt_bodyid[joint]] != OBJECT:
                continue
            address, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                start[:, address] += 50.0 + shift
                start[:, address + 3 : address + 7] = (
                    torch.tensor([0.6, 0.8, 0.0, 0.0]) if shift else start.new_tensor([1.0, 0.0, 0.0, 0.0])
                )
            else:  # a drop of water moves freely by three slides
                start[:, address] += 50.0 + shift if model.joint(joint).name.endswith("/x") else 0.01 * shift
        for fixture in range(model.nmocap):
            start[:, model.nq + 7 * fixture] += 50.0 + shift
        engine.reset(torch.ones(engine.num, dtype=torch.bool), start)
        for joint in range(model.njnt):
            if kinds[model.jnt_bodyid[joint]] == OBJECT:
                dof = model.jnt_dofadr[joint]
                engine.qvel[:, dof] = shift


def observed(world: World) -> Tensor:
    world._refresh(torch.ones(world.num_envs, dtype=torch.bool))
    return world._obs.clone()


@pytest.mark.parametrize("name", registry.names())
def test_an_object_out_of_sight_changes_no_bit(name: str) -> None:
    world = make_task_world(name, 1, "cpu", autoreset_mode="DISABLED", threads=1, points=COUNT)
    seen, _ = world.reset(seed=0)
    banish(world, 0.0)
    first = observed(world)
    banish(world, 7.0)
    assert torch.equal(observed(world), first)
    assert not torch.equal(cloud(world, seen), cloud(world, first)), "the object was in sight before"
    # Without the rule the same two states differ, so that the test above can fail.
    plain = make_task_world(name, 1, "cpu", autoreset_mode="DISABLED", threads=1)
    plain.reset(seed=0)
    banish(plain, 0.0)
    first = observed(plain)
    banish(plain, 7.0)
    assert not torch.equal(observed(plain), first)


def test_hands_goal_and_task_id_stay() -> None:
    worlds = [_mt4(points) for points in (None, PointsRule(COUNT))]
    state, points = (world.reset(seed=3)[0] for world in worlds)
    for name in ("right_hand", "left_hand", "task_id"):
        before, after = (group(world, name).where for world in worlds)
        assert torch.equal(state[:, before[0]], points[:, after[0]])
    layout = worlds[1].slots[0].task_class.layout
    assert torch.equal(state[:, layout.range("goal_pose")], points[:, layout.range("goal_pose")])
    assert (points[:, layout.range("goal_rotation_difference")] == 0).all()
    assert (points[:, layout.range("object_pose")] == 0).all() and (state[:, layout.range("object_pose")] != 0).any()
    assert worlds[1].single_observation_space.shape == (446 + 3 * COUNT + 4,)


def _mt4(points: PointsRule | None, rows: int = 8) -> World:
    suite = Benchmark("MT4")
    return World(
        suite._slots("train"),
        WorldConfig(rows, observation="one-hot", pad_to=suite.padded_size, points=points, threads=1),
    )


def test_a_row_sees_the_same_in_any_company_and_a_step_gives_what_a_refresh_gives() -> None:
    world = _mt4(PointsRule(COUNT))
    world.reset(seed=0)
    obs, *_ = world.step(torch.zeros(8, 52))
    assert torch.equal(observed(world)[:, group(world, "points").where[0]], obs[:, group(world, "points").where[0]])
    before = world._obs.clone()
    world._refresh(torch.arange(8) == int(world.parts[0].group.env_ids[-1]))
    assert torch.equal(world._obs, before)


def test_kinds_are_a_fourth_number_and_a_broken_row_is_no_harm() -> None:
    world = _mt4(PointsRule(COUNT, kinds=True))
    world.reset(seed=0)
    (where,) = group(world, "kind_points").where
    action = torch.zeros(8, 52)
    action[0] = torch.nan
    obs, _, _, _, info = world.step(action)
    kinds = obs[:, where].view(8, COUNT, 4)[..., 3]
    assert info["unstable"].tolist() == [True, *[False] * 7] and obs.isfinite().all()
    assert set(kinds.unique().tolist()) <= {0.0, 1.0} and (kinds == 1).any(1).all() and (kinds == 0).any(1).all()


DOORS = ("DoorOpenOutward", "DoorOpenInward", "DoorCloseOutward", "DoorCloseInward")
HELD_FAST = {name: {"object/object"} for name in DOORS} | {"Switch": {"switch1/object", "switch2/object"}}
"""Door frames and switch housings: a task says where they stand, and nothing moves them in an episode."""


@pytest.mark.parametrize("name", registry.names())
def test_what_no_joint_moves_is_the_scene(name: str) -> None:
    model = compile_scene(registry.get(name)).model
    of_body = body_kinds(model)
    fast = {model.body(i).name for i, kind in enumerate(of_body) if kind == FIXTURE}
    assert fast == {"world"} | HELD_FAST.get(name, set())
    # Objects are bodies that physics moves: they have a joint, or their parent has one.
    for body in (i for i, kind in enumerate(of_body) if kind == OBJECT):
        carriers = [body]
        while carriers[-1]:
            carriers.append(int(model.body_parentid[carriers[-1]]))
        assert any(model.body_dofnum[each] for each in carriers)
    seen = sample(model, 400)
    assert [of_body[body] for body in model.geom_bodyid[seen.geoms]] == seen.kinds.tolist()


@pytest.mark.parametrize("count", [-1, 1.5, 100_000, True])
def test_no_number_of_points_is_one_line(count: object) -> None:
    with pytest.raises(BidexError, match="points"):
        PointsRule(count)  # type: ignore[arg-type]
