"""Every index range of the observation tables: where it stands, and what it holds at a known state."""

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.hands.hand import SIDES
from bidex_meta.tasks import registry
from bidex_meta.world import World
from tests.hands import figures
from tests.tasks.formulas import FORMULAS
from tests.tasks.oracle import Goal, frame
from tests.tasks.tables import EPISODE_STEPS, SIZES, TABLES, block_name
from tests.tasks.worlds import (
    MOVING,
    Lens,
    each_case,
    engine_of,
    mixed_world,
    scene_of,
    task_of,
    world_of,
)

STEPS = 3


@pytest.fixture(scope="module")
def worlds() -> dict[tuple[str, bool], World]:
    """Worlds of three rows, filled as cases are asked for."""
    return {}


def started(worlds: dict[tuple[str, bool], World], name: str, moving: bool) -> World:
    if (name, moving) not in worlds:
        worlds[name, moving] = world_of(name, moving, 3, observation="plain")
    world = worlds[name, moving]
    world.reset(seed=7)
    return world


@each_case
def test_layout_is_the_printed_table(name: str, moving: bool) -> None:
    task, table = registry.get(name, moving), TABLES[name, moving]
    assert [block.name for block, _ in task.layout] == [block_name(what) for *_, what in table]
    for first, last, what in table:
        assert task.layout.range(block_name(what)) == slice(first, last + 1), what
    assert [first for first, *_ in table] == [0, *(last + 1 for _, last, _ in table[:-1])]
    assert (task.observation_size, task.action_size) == SIZES[name, moving] and task.layout.size == table[-1][1] + 1
    assert task.episode_steps == EPISODE_STEPS[name] and repr(task).startswith(name)


@each_case
def test_goal_indices(name: str, moving: bool) -> None:
    printed = [
        i for first, last, what in TABLES[name, moving] if what.startswith("goal") for i in range(first, last + 1)
    ]
    assert registry.get(name, moving).layout.goal_indices() == printed


def replay(world: World, row: int, actions: torch.Tensor) -> tuple[mujoco.MjData, mujoco.MjData]:
    """The row's episode in plain C MuJoCo: data forwarded at the end, and data as the last substep left it."""
    scene, model = scene_of(world), scene_of(world).model
    data = Lens(model).look(engine_of(world).placement()[row])
    low, high = figures.LOW[figures.ACTUATED], figures.HIGH[figures.ACTUATED]
    transition, orientation = figures.SCALES[scene.task.name]
    for action in actions[:, row].double().numpy():
        for i, side in enumerate(SIDES):
            mine = action[i * len(action) // 2 : (i + 1) * len(action) // 2]
            data.ctrl[20 * i : 20 * i + 20] = low + (mine[:20] + 1) / 2 * (high - low)
            wrench = np.concatenate((mine[20:23] * 1e5 / 60 * transition, mine[23:26] * 1e3 / 60 * orientation))
            data.body(f"{side}/base").xfrc_applied = wrench if len(wrench) else 0.0
        for _ in range(round(1 / 60 / model.opt.timestep)):
            mujoco.mj_step(model, data)
    last = mujoco.MjData(model)
    mujoco.mj_copyData(last, model, data)
    mujoco.mj_forward(model, data)
    return data, last


RECORDED = {"switch1": "switch1/rocker"}
"""Bodies whose pose and velocities the tables' words mean, where it is not the object's root: a housing never moves."""
QUATERNIONS = {"pose": slice(3, 7), "quaternion": slice(4), "link quaternion": slice(4)}
"""Which of a range's entries are a quaternion, by the last words of its row."""


def pose(goal: Goal) -> np.ndarray:
    """Position and quaternion (x, y, z, w)."""
    return np.concatenate((goal[0], goal[1].as_quat()))


def motion(
    model: mujoco.MjModel, data: mujoco.MjData, body: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origin, quaternion (x, y, z, w), linear and angular velocity of a body's frame, in world axes."""
    twist = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, twist, 0)
    return data.body(body).xpos, np.roll(data.body(body).xquat, -1), twist[3:], twist[:3]


def expected(
    world: World, row: int, what: str, data: mujoco.MjData, last: mujoco.MjData, action: np.ndarray
) -> np.ndarray:
    """What the table's words ask for, scaled (docs/figures.md, observation)."""
    scene, model = scene_of(world), scene_of(world).model
    subject, _, rest = what.partition(" ")
    joints = [model.joint(f"{subject}/{j}") for j in figures.NAMES] if subject in SIDES else []
    dofs = [joint.dofadr[0] for joint in joints]
    tips = [f"{subject}/{tip}" for tip in figures.TIPS]
    oracle = FORMULAS[scene.task.name]
    goal, points = oracle.goals(data, task_of(world, row)), oracle.points(data)
    body = RECORDED.get(subject, f"{subject}/object")
    if what in points:
        return points[what]
    match rest:
        case "dof position":
            return (2 * data.qpos[[j.qposadr[0] for j in joints]] - figures.HIGH - figures.LOW) / (
                figures.HIGH - figures.LOW
            )
        case "dof velocity":
            return 0.2 * data.qvel[dofs]
        case "dof force":
            return 10 * last.qfrc_actuator[dofs]
        case "fingertip pose, linear velocity, angle velocity":
            return np.concatenate([np.concatenate(motion(model, data, tip)) for tip in tips])
        case "fingertip force, torque":
            sensed = [last.sensor(f"{tip}_{kind}").data for tip in tips for kind in ("force", "torque")]
            return 10 * np.concatenate(sensed)
        case "base position":
            return data.body(f"{subject}/mount").xpos
        case "base rotation":
            begin = mujoco.MjData(model)
            mujoco.mj_kinematics(model, begin)
            now, then = (figures.rotation(d.body(f"{subject}/mount").xquat) for d in (data, begin))
            return (now * then.inv()).as_euler("xyz")
        case "actions":
            return np.split(action, 2)[SIDES.index(subject)]
        case "pose" if subject in goal:
            return pose(goal[subject])
        case "pose":
            return pose(frame(data, body))
        case "quaternion" | "link quaternion":
            return frame(data, body)[1].as_quat()
        case "linear velocity":
            return motion(model, data, body)[2]
        case "angle velocity":
            return 0.2 * motion(model, data, body)[3]
    return (frame(data, oracle.body_of_goal[subject])[1] * goal[subject][1].inv()).as_quat()


@each_case
def test_version_2_shows_the_same_but_goals_and_signs(name: str, moving: bool) -> None:
    """In the same state: quaternions but the hands' have w >= 0; classes without a goal block get one at the end."""
    one, two = (world_of(name + version, moving, 8, tasks=8, observation="plain") for version in ("", "-v2"))
    one.reset(seed=0)
    two.reset(seed=0)
    engine_of(two).reset(torch.ones(8, dtype=torch.bool), engine_of(one).placement())
    action = torch.rand(8, one.action_size, generator=torch.Generator().manual_seed(5)) * 2 - 1
    before, after = one.step(action)[0], two.step(action)[0]
    layout, size = two.slots[0].task_class.layout, one.observation_size
    if name in ("BottleCap", "PushBlock", "GraspAndPlace"):
        assert layout.goal_indices() == list(range(size, size + 11)) and after[:, size:].any()
    else:
        assert layout.size == size and layout.goal_indices() == one.slots[0].task_class.layout.goal_indices()
    before = torch.nn.functional.pad(before, (0, layout.size - size))
    free = [i for i in range(size) if i not in layout.goal_indices()]
    last = [
        stop for _, stop, what in TABLES[name, moving] if what.endswith(("pose", "quaternion")) or " rot - " in what
    ]
    turned = torch.zeros_like(before, dtype=torch.bool)
    for at in last:
        turned[:, at - 3 : at + 1] = before[:, at : at + 1] < 0
    assert (after[:, last] >= 0).all()
    assert torch.equal(torch.where(turned, -before, before)[:, free], after[:, free])


@each_case
def test_every_range_equals_plain_mujoco(worlds: dict[tuple[str, bool], World], name: str, moving: bool) -> None:
    world = started(worlds, name, moving)
    generator = torch.Generator().manual_seed(11)
    actions = torch.rand(STEPS, 3, world.action_size, generator=generator) * 2 - 1
    replays = [replay(world, row, actions) for row in range(3)]
    for action in actions:
        obs, *_ = world.step(action)
    for row, (data, last) in enumerate(replays):
        for first, stop, what in TABLES[name, moving]:
            wanted = np.clip(expected(world, row, what, data, last, actions[-1, row].numpy()), -5.0, 5.0)
            found = obs[row, first : stop + 1].numpy()
            quaternion = QUATERNIONS.get(what.partition(" ")[2], slice(4 if " rot - " in what else 0))
            if (found[quaternion] @ wanted[quaternion]) < 0:  # both signs are the same rotation
                wanted[quaternion] *= -1
            np.testing.assert_allclose(found, wanted, atol=2e-5, rtol=1e-5, err_msg=f"{what}, row {row}")


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
