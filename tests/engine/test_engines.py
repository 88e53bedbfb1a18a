"""Both engines' resets, health report, state and per-world fields; the Warp engine on the Warp CPU device."""

import copy
import os
import subprocess
import sys

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import Scene, build_spec, compile_scene
from bidex_meta.utils.memory import usable_cores
from tests.tasks.worlds import Lens, depths

SUBSTEPS, ROWS = 2, 4
ROOM = Capacity(contacts=112, convex=30, rows=208)
NAMES = ("CatchAbreast", "CatchUnderarm", "CatchOver2Underarm", "CatchUnderarm")
VIEWS = ("qpos", "qvel", "ctrl", "xfrc_applied", "sensordata")
# A cold cache compiles for more than a minute, so only one test process should do it (--dist loadgroup).
pytestmark = [pytest.mark.timeout(900), pytest.mark.xdist_group("warp")]
Either = CpuEngine | WarpEngine


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [compile_scene(registry.get(name, True)) for name in NAMES]


@pytest.fixture(scope="module", params=["c", "warp"])
def engines(request: pytest.FixtureRequest, scenes: list[Scene]) -> list[Either]:
    """Two of the same classes; tests restart them and change their arrays alone."""
    models = [scene.model for scene in scenes]
    if request.param == "c":
        return [CpuEngine(models, range(ROWS), 1) for _ in range(2)]
    return [WarpEngine(models, range(ROWS), ROOM) for _ in range(2)]


@pytest.fixture
def engine(engines: list[Either], scenes: list[Scene]) -> Either:
    return reset(engines[0], everyone(), starts(scenes))


@pytest.fixture
def other(engines: list[Either], scenes: list[Scene]) -> Either:
    return reset(engines[1], everyone(), starts(scenes))


def reset(engine: Either, mask: Tensor, start: Tensor) -> Either:
    """At starts of all rows, of which those outside the mask are ignored."""
    engine.reset(mask, start if engine.avoids_syncs else start[mask])
    return engine


def everyone() -> Tensor:
    return torch.ones(ROWS, dtype=torch.bool)


def some(*rows: int) -> Tensor:
    return torch.isin(torch.arange(ROWS), torch.tensor(rows))


def starts(scenes: list[Scene]) -> Tensor:
    return torch.stack([torch.from_numpy(scene.start_qpos) for scene in scenes])


def act(engine: Either, generator: torch.Generator) -> None:
    """Random targets, and random forces on the first base."""
    targets = torch.rand(engine.ctrl.shape, generator=generator, dtype=torch.float64)
    forces = torch.rand(engine.num, 3, generator=generator, dtype=torch.float64)
    engine.ctrl.copy_(0.7 * targets)
    engine.xfrc_applied[:, 1, :3] = (60 * forces - 30).to(engine.ctrl.dtype)


def run(engine: Either, steps: int, seed: int, active: Tensor | None = None) -> list[Tensor]:
    """Random actions, the same for the same seed; the states they led to."""
    generator, states = torch.Generator().manual_seed(seed), []
    for _ in range(steps):
        act(engine, generator)
        engine.step(SUBSTEPS, active)
        states.append(torch.cat((engine.qpos, engine.qvel, engine.sensordata), dim=1).clone())
    return states


def same(a: list[Tensor], b: list[Tensor], rows: list[int] | slice = slice(None)) -> bool:
    return all(torch.equal(x[rows], y[rows]) for x, y in zip(a, b, strict=True))


BREAKAGES = {
    "NaN position": lambda engine: engine.qpos[1].__setitem__(30, torch.nan),
    "infinite velocity": lambda engine: engine.qvel[1].__setitem__(3, torch.inf),
    "huge velocity": lambda engine: engine.qvel[1].__setitem__(7, 1e12),
    "NaN force": lambda engine: engine.xfrc_applied[1, 1].__setitem__(0, torch.nan),
    "infinite control": lambda engine: engine.ctrl[1].__setitem__(0, torch.inf),
    "NaN warm start": lambda engine: engine._state["qacc_warmstart"][1].fill_(torch.nan),
    "infinite time": lambda engine: engine._state["time"].__setitem__(1, torch.inf),
    "velocity of 1e9": lambda engine: engine.qvel[1].__setitem__(7, 1e9),
    "quaternion of length zero": lambda engine: engine.qpos[1, -4:].zero_(),
    "blow-up within the step": lambda engine: engine.qvel[1].fill_(5e5),
}


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_a_broken_row_is_reported_and_its_neighbours_do_not_change_by_a_bit(
    engine: Either, other: Either, scenes: list[Scene], breakage: str
) -> None:
    run(engine, 2, seed=0)
    run(other, 2, seed=0)
    assert not engine.unstable().any()
    BREAKAGES[breakage](engine)
    engine.step(SUBSTEPS)
    other.step(SUBSTEPS)
    assert engine.unstable().tolist() == [False, True, False, False]
    rest = [0, 2, 3]
    assert same(run(engine, 2, seed=1), run(other, 2, seed=1), rest)
    assert engine.unstable().tolist() == [False, True, False, False], "until the reset"
    assert not other.unstable().any()
    # After a reset, the row behaves like a new one.
    reset(engine, some(1), starts(scenes))
    reset(other, everyone(), starts(scenes))
    assert not engine.unstable().any()
    assert torch.equal(engine.sensordata[1], other.sensordata[1])
    for view in ("qvel", "ctrl", "xfrc_applied"):
        assert (getattr(engine, view)[1] == 0).all(), view
    assert same(run(engine, 3, seed=4), run(other, 3, seed=4), [1])


def test_a_reset_touches_only_its_rows(engine: Either, other: Either, scenes: list[Scene]) -> None:
    """Refreshing all sensors changes neither forces nor states of the others."""
    run(engine, 4, seed=7)
    run(other, 4, seed=7)
    given = starts(scenes) + 0.001
    given[[1, 2]] = torch.nan  # rows outside the mask are ignored
    reset(engine, some(0, 3), given)
    assert torch.equal(engine.qpos[[0, 3]], given[[0, 3]].to(engine.qpos))
    for name, value in engine.state_dict().items():
        assert torch.equal(value[[1, 2]], other.state_dict()[name][[1, 2]]), name
    assert torch.equal(engine.sensordata[[1, 2]], other.sensordata[[1, 2]])
    assert same(run(engine, 4, seed=8), run(other, 4, seed=8), [1, 2])


def test_a_start_with_a_bad_number_is_unstable(engine: Either, scenes: list[Scene]) -> None:
    given = starts(scenes)
    given[2, 5] = torch.nan
    reset(engine, some(2), given)
    assert engine.unstable().tolist() == [False, False, True, False]
    assert engine.sensordata.isfinite().all()


def test_force_sensors_are_zero_after_a_reset_and_those_of_the_last_substep_after_a_step(
    engine: Either, scenes: list[Scene]
) -> None:
    force = scenes[0].sensors["right/FFJ3_force"]
    assert (engine.sensordata[:, force] == 0).all()
    run(engine, 1, seed=9)
    assert (engine.sensordata[:, force] != 0).all()


def test_sensors_after_a_step_are_those_of_the_new_state(engine: Either, scenes: list[Scene]) -> None:
    run(engine, 4, seed=15)
    tolerance = 2e-6 if engine.avoids_syncs else 1e-12
    for row, scene in enumerate(scenes):
        data = Lens(scene.model).look(engine.qpos[row], engine.qvel[row])
        mujoco.mj_sensorPos(scene.model, data)
        mujoco.mj_sensorVel(scene.model, data)
        for name in ("object/position", "object/linear_velocity", "right/FFJ1_velocity", "left/thdistal_quaternion"):
            ours, theirs = engine.sensordata[row, scene.sensors[name]], torch.from_numpy(data.sensor(name).data.copy())
            torch.testing.assert_close(ours, theirs.to(ours), atol=tolerance, rtol=tolerance)


def test_inactive_rows_stand_still(engine: Either, other: Either) -> None:
    run(engine, 2, seed=16)
    run(other, 2, seed=16)
    before, sensors = engine.state_dict(), engine.sensordata.clone()
    advanced = run(engine, 4, seed=9, active=some(0, 2))
    for name in ("time", "qpos", "qvel", "qacc_warmstart"):
        assert torch.equal(engine.state_dict()[name][[1, 3]], before[name][[1, 3]]), name
    assert torch.equal(engine.sensordata[[1, 3]], sensors[[1, 3]])
    assert same(advanced, run(other, 4, seed=9), [0, 2])


def test_a_saved_state_continues_bit_for_bit(engine: Either, other: Either) -> None:
    run(engine, 6, seed=11)
    state = engine.state_dict()
    kept = {name: value.clone() for name, value in state.items()}
    future = run(engine, 5, seed=12)
    assert all(torch.equal(state[name], kept[name]) for name in kept), "the saved state is a copy"
    run(other, 2, seed=13)
    other.qpos[2, 3] = torch.nan
    other.step(SUBSTEPS)
    assert other.unstable()[2]
    other.load_state_dict(state)
    assert not other.unstable().any() and torch.equal(other.qpos, state["qpos"])
    assert same(run(other, 5, seed=12), future)


def test_views_stay_the_engines_own_and_graphs_can_be_recorded_anew(
    engine: Either, other: Either, scenes: list[Scene]
) -> None:
    views = {name: getattr(engine, name) for name in VIEWS}
    if isinstance(engine, WarpEngine):
        engine.recapture()
    assert same(run(engine, 2, seed=14), run(other, 2, seed=14))
    reset(engine, everyone(), starts(scenes))
    dtype = torch.float32 if engine.avoids_syncs else torch.float64
    for name, view in views.items():
        assert getattr(engine, name).data_ptr() == view.data_ptr() and view.dtype == dtype
    assert torch.equal(views["qpos"], starts(scenes).to(dtype))


def test_data_and_contact_depth_are_c_mujocos_view(engine: Either, scenes: list[Scene]) -> None:
    given = starts(scenes)
    egg = scenes[0].qpos["object"]
    given[0, egg] = torch.tensor([2.0, 0, 0.02, 1, 0, 0, 0], dtype=torch.float64)  # 2 cm in the floor
    given[1, egg] = torch.tensor([2.0, 0, 1.0, 1, 0, 0, 0], dtype=torch.float64)
    reset(engine, everyone(), given)
    assert engine.contact_depth(0) == pytest.approx(0.02, abs=1e-6)
    assert engine.contact_depth(1) == 0.0
    assert depths(engine.data(0)).max() == pytest.approx(0.02, abs=1e-6)
    np.testing.assert_allclose(engine.data(1).qpos, given[1].numpy(), rtol=1e-6, atol=1e-7)
    for row, scene in enumerate(scenes):
        np.testing.assert_array_equal(engine.model(row).body_pos, scene.model.body_pos)


def test_a_new_batch_and_other_threads_give_the_same_bits(scenes: list[Scene]) -> None:
    """Nothing survives a reset: warm start, controls, applied forces, contacts."""
    used, new, threaded = (CpuEngine([scenes[1].model], [0] * ROWS, threads) for threads in (1, 1, 2))
    start = starts(scenes[1:2]).repeat(ROWS, 1)
    start[:, scenes[1].qpos["object"].start] += 0.001 * torch.arange(ROWS)
    reset(used, everyone(), start)
    run(used, 30, seed=5)
    states = [run(reset(one, everyone(), start), 10, seed=6) for one in (used, new, threaded)]
    assert same(*states[:2]) and same(*states[1:]) and usable_cores() >= 1


AFTER_FORK = """
import os, signal, sys
import torch
from bidex_meta import BidexError, make_task_world

def make():
    world = make_task_world("HandOver", 4, "cpu", threads=int(sys.argv[1]))
    world.reset(seed=0)
    return world

world, action = make(), torch.zeros(4, 40)
saved = world.state_dict()
pid = os.fork()
if pid == 0:
    signal.alarm(20)  # ends a child that waits for threads
    for call in (lambda: world.step(action), world.reset, lambda: world.load_state_dict(saved)):
        try:
            call()
            print("went on")
        except BidexError as error:
            print(error)
    print("anew", *make().step(action)[1].shape)
    sys.exit(0)  # the interpreter frees the old world
status = os.waitpid(pid, 0)[1]
world.step(action)
sys.exit(status != 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_forked_child_is_refused_its_parents_threads_and_ends(threads: int) -> None:
    command = [sys.executable, "-W", "ignore", "-c", AFTER_FORK, str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    *calls, anew = done.stdout.splitlines()
    assert anew == "anew 4" and len(calls) == 3
    for line in calls:
        assert "forked" in line and "threads=1" in line if threads == 2 else line == "went on"


def test_a_row_without_memory_for_its_contacts_is_unstable() -> None:
    """MuJoCo raises SimulationError for such a row; the others have stepped, and no exception reaches the world."""
    spec = build_spec(registry.get("CatchUnderarm"))
    spec.memory = 300_000  # enough for a start, too little for the solver in the tangle below
    cramped = Scene(registry.get("CatchUnderarm"), spec.compile())
    engine = CpuEngine([cramped.model], [0] * 3, 1)
    qpos = torch.from_numpy(cramped.start_qpos).repeat(3, 1)
    qpos[:, cramped.qpos["object"].start] += 0.001 * torch.arange(3)
    # The hands of the second row penetrate each other and the floor, which gives more contacts than its memory holds.
    for side in ("right", "left"):
        place = cramped.qpos[f"{side}/base"].start
        qpos[1, place : place + 3] = torch.tensor([0.0, -0.3, 0.0], dtype=torch.float64)
        qpos[1, cramped.qpos[f"{side}/joints"]] = 1.0
    engine.reset(torch.tensor([True, False, True]), qpos[[0, 2]])
    engine.qpos[1] = qpos[1]
    before = engine.qpos.clone()
    engine.step(SUBSTEPS)
    assert engine.unstable().tolist() == [False, True, False]
    assert torch.equal(engine.qpos[1], before[1]), "the broken row keeps its state"
    assert (engine.qpos[[0, 2]] != before[[0, 2]]).any(dim=1).all()
    engine.reset(torch.tensor([False, True, False]), qpos[:1])
    assert not engine.unstable().any()
    engine.step(SUBSTEPS)
    assert not engine.unstable().any()
    twin = CpuEngine([cramped.model], [0] * 3, 1)
    twin.reset(torch.ones(3, dtype=torch.bool), qpos[[0, 0, 2]])
    twin.step(SUBSTEPS)
    assert torch.equal(engine.qpos[1], twin.qpos[1])


def variant(scene: Scene, change: str) -> mujoco.MjModel:
    model = copy.copy(scene.model)
    if change == "mass":
        model.body_mass[model.body("right/palm").id] *= 10
    elif change == "damping":
        model.dof_damping[:6] *= 0.2
    elif change == "pose":
        model.body_pos[model.body("right/mount").id] += 0.05
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def test_each_world_has_the_numbers_of_its_own_model(scenes: list[Scene]) -> None:
    """Mass, damping and pose that differ from row to row: every row moves as in C with its own model."""
    models = [variant(scenes[1], change) for change in ("", "mass", "damping", "pose")]
    ours, theirs = WarpEngine(models, range(ROWS), ROOM), CpuEngine(models, range(ROWS), 1)
    start = torch.from_numpy(scenes[1].start_qpos).repeat(ROWS, 1)
    start[:, scenes[1].qpos["object"].start] += 2.0  # nothing touches
    for engine in (ours, theirs):
        engine.reset(everyone(), start)
        generator = torch.Generator().manual_seed(20)
        for _ in range(8):
            act(engine, generator)
            engine.xfrc_applied[:] = engine.xfrc_applied[:1].clone()
            engine.step(SUBSTEPS)
    positions = [i for name, at in scenes[1].sensors.items() if name.endswith("position") for i in _range(at)]
    theirs_seen, ours_seen = theirs.sensordata[:, positions], ours.sensordata[:, positions].double()
    torch.testing.assert_close(ours_seen, theirs_seen, atol=1e-5, rtol=0)
    apart = (theirs_seen[1:] - theirs_seen[0]).abs().max(dim=1).values
    assert (apart > 1e-3).all(), "the variants differ"


def test_a_deterministic_engine_repeats_and_agrees_with_the_usual_one(scenes: list[Scene]) -> None:
    """On the Warp CPU device every engine repeats; the modes must be asked for, and leave the physics as it is."""
    models = [scene.model for scene in scenes]
    plain = WarpEngine(models, range(ROWS), ROOM)
    first, second = (WarpEngine(models, range(ROWS), ROOM, deterministic=True) for _ in range(2))
    assert first._m.opt.deterministic == mjw.DeterminismType.ALL and not plain._m.opt.deterministic
    for engine in (plain, first, second):
        reset(engine, everyone(), starts(scenes))
        generator = torch.Generator().manual_seed(3)
        for _ in range(10):
            act(engine, generator)
            engine.step(SUBSTEPS)
    assert torch.equal(first.qpos, second.qpos) and torch.equal(first.sensordata, second.sensordata)
    torch.testing.assert_close(first.qpos, plain.qpos, atol=1e-5, rtol=0)


def _range(at: slice) -> range:
    return range(int(at.start), int(at.stop))


def test_lost_contacts_are_reported(scenes: list[Scene]) -> None:
    """Too little room for rows breaks one world; too small a pool of contacts all, since whose were lost is unknown."""
    model, start = scenes[1].model, torch.from_numpy(scenes[1].start_qpos).repeat(2, 1)
    for side in ("right", "left"):  # the second row's hands stand in each other and in the floor
        place = scenes[1].qpos[f"{side}/base"].start
        start[1, place : place + 3] = torch.tensor([0.0, -0.3, 0.0], dtype=torch.float64)
    for capacity, told in ((Capacity(512, 64, 48), [False, True]), (Capacity(12, 4, 256), [True, True])):
        engine = WarpEngine([model], [0, 0], capacity=capacity)
        engine.reset(torch.ones(2, dtype=torch.bool), start)
        assert not engine.unstable().any()
        engine.step(SUBSTEPS)
        assert engine.unstable().tolist() == told, capacity
        start_again = start[[0, 0]]
        start_again[:, scenes[1].qpos["object"].start] += 2.0
        engine.reset(torch.tensor([False, True]), start_again)
        assert not engine.unstable()[1]


def test_unknown_sensors_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom name='a' size='1'/></body></worldbody>"
        "<sensor><clock/></sensor></mujoco>"
    )
    with pytest.raises(BidexError, match="CLOCK"):
        WarpEngine([model], [0], capacity=Capacity(8, 1, 8))
