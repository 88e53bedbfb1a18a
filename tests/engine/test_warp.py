"""The Warp engine's resets, health report, state and per-world fields, on the Warp CPU device."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import Scene, compile_scene
from tests.engine.test_cpu import BREAKAGES, same
from tests.tasks.worlds import Lens

SUBSTEPS, ROWS = 2, 4
ROOM = Capacity(contacts=112, convex=30, rows=208)
NAMES = ("HandOver", "CatchUnderarm", "CatchOver2Underarm", "CatchUnderarm")
# A cold cache compiles for a minute and more, and one test process shall do it, not all (--dist loadgroup).
pytestmark = [pytest.mark.timeout(900), pytest.mark.xdist_group("warp")]


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [compile_scene(registry.get(name, True)) for name in NAMES]


@pytest.fixture(scope="module")
def engines(scenes: list[Scene]) -> tuple[WarpEngine, WarpEngine]:
    """Two of the same classes; tests restart them and change their arrays alone."""
    models = [scene.model for scene in scenes]
    return WarpEngine(models, range(ROWS), ROOM), WarpEngine(models, range(ROWS), ROOM)


@pytest.fixture
def engine(engines: tuple[WarpEngine, WarpEngine], scenes: list[Scene]) -> WarpEngine:
    return fresh(engines[0], scenes)


@pytest.fixture
def other(engines: tuple[WarpEngine, WarpEngine], scenes: list[Scene]) -> WarpEngine:
    return fresh(engines[1], scenes)


def fresh(engine: WarpEngine, scenes: list[Scene]) -> WarpEngine:
    engine.reset(everyone(), starts(scenes))
    return engine


def everyone() -> Tensor:
    return torch.ones(ROWS, dtype=torch.bool)


def some(*rows: int) -> Tensor:
    mask = torch.zeros(ROWS, dtype=torch.bool)
    mask[list(rows)] = True
    return mask


def starts(scenes: list[Scene]) -> Tensor:
    return torch.stack([torch.from_numpy(scene.start_qpos) for scene in scenes]).float()


def act(engine: WarpEngine | CpuEngine, generator: torch.Generator) -> None:
    """Random targets, and random forces on the first base."""
    targets = torch.rand(engine.ctrl.shape, generator=generator, dtype=torch.float64)
    forces = torch.rand(engine.num, 3, generator=generator, dtype=torch.float64)
    engine.ctrl.copy_(0.7 * targets)
    engine.xfrc_applied[:, 1, :3] = (60 * forces - 30).to(engine.ctrl.dtype)


def run(engine: WarpEngine, steps: int, seed: int, active: Tensor | None = None) -> list[Tensor]:
    """Random actions, the same for the same seed; the states they led to."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(steps):
        act(engine, generator)
        engine.step(SUBSTEPS, active)
        found.append(torch.cat((engine.qpos, engine.qvel, engine.sensordata), dim=1).clone())
    return found


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_a_broken_row_is_told_and_its_neighbours_do_not_change_by_a_bit(
    engine: WarpEngine, other: WarpEngine, breakage: str
) -> None:
    run(engine, 2, seed=0)
    run(other, 2, seed=0)
    assert not engine.unstable().any()
    BREAKAGES[breakage](engine)
    engine.step(SUBSTEPS)
    other.step(SUBSTEPS)
    assert engine.unstable().tolist() == [False, True, False, False]
    rest = [0, 2, 3]
    assert same(run(engine, 3, seed=1), run(other, 3, seed=1), rest)
    assert engine.unstable().tolist() == [False, True, False, False], "told until the reset"
    assert not other.unstable().any()


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_a_row_reset_after_breaking_is_as_good_as_new(
    engine: WarpEngine, other: WarpEngine, scenes: list[Scene], breakage: str
) -> None:
    run(engine, 2, seed=2)
    BREAKAGES[breakage](engine)
    run(engine, 2, seed=3)
    engine.reset(some(1), starts(scenes))
    assert not engine.unstable().any()
    assert torch.equal(engine.sensordata[1], other.sensordata[1])
    for view in ("qvel", "ctrl", "xfrc_applied"):
        assert (getattr(engine, view)[1] == 0).all(), view
    assert same(run(engine, 8, seed=4), run(other, 8, seed=4), [1])


def test_a_reset_touches_only_its_rows(engine: WarpEngine, other: WarpEngine, scenes: list[Scene]) -> None:
    """Refreshing all sensors changes neither forces nor states of the others."""
    run(engine, 4, seed=7)
    run(other, 4, seed=7)
    given = starts(scenes) + 0.001
    given[[1, 2]] = torch.nan  # rows outside the mask are ignored
    engine.reset(some(0, 3), given)
    assert torch.equal(engine.qpos[[0, 3]], given[[0, 3]])
    for name, value in engine.state_dict().items():
        assert torch.equal(value[[1, 2]], other.state_dict()[name][[1, 2]]), name
    assert torch.equal(engine.sensordata[[1, 2]], other.sensordata[[1, 2]])
    assert same(run(engine, 4, seed=8), run(other, 4, seed=8), [1, 2])


def test_a_start_with_a_bad_number_is_told(engine: WarpEngine, scenes: list[Scene]) -> None:
    given = starts(scenes)
    given[2, 5] = torch.nan
    engine.reset(some(2), given)
    assert engine.unstable().tolist() == [False, False, True, False]
    assert engine.sensordata.isfinite().all()


def test_force_sensors_are_zero_after_a_reset_and_those_of_the_last_substep_after_a_step(
    engine: WarpEngine, scenes: list[Scene]
) -> None:
    force = scenes[0].sensors["right/FFJ3_force"]
    assert (engine.sensordata[:, force] == 0).all()
    run(engine, 1, seed=9)
    assert (engine.sensordata[:, force] != 0).all()


def test_sensors_after_a_step_are_those_of_the_new_state(engine: WarpEngine, scenes: list[Scene]) -> None:
    run(engine, 4, seed=15)
    for row, scene in enumerate(scenes):
        data = Lens(scene.model).look(engine.qpos[row], engine.qvel[row])
        mujoco.mj_sensorPos(scene.model, data)
        mujoco.mj_sensorVel(scene.model, data)
        for name in ("object/position", "object/linear_velocity", "right/FFJ1_velocity", "left/thdistal_quaternion"):
            ours, theirs = engine.sensordata[row, scene.sensors[name]], torch.from_numpy(data.sensor(name).data.copy())
            torch.testing.assert_close(ours, theirs.float(), atol=2e-6, rtol=2e-6)


def test_inactive_rows_stand_still(engine: WarpEngine, other: WarpEngine) -> None:
    run(engine, 2, seed=16)
    run(other, 2, seed=16)
    before, sensors = engine.state_dict(), engine.sensordata.clone()
    advanced = run(engine, 4, seed=9, active=some(0, 2))
    for name in ("time", "qpos", "qvel", "qacc_warmstart"):
        assert torch.equal(engine.state_dict()[name][[1, 3]], before[name][[1, 3]]), name
    assert torch.equal(engine.sensordata[[1, 3]], sensors[[1, 3]])
    assert same(advanced, run(other, 4, seed=9), [0, 2])


def test_a_saved_state_goes_on_bit_for_bit(engine: WarpEngine, other: WarpEngine) -> None:
    run(engine, 6, seed=11)
    state = engine.state_dict()
    kept = {name: value.clone() for name, value in state.items()}
    future = run(engine, 5, seed=12)
    assert all(torch.equal(state[name], kept[name]) for name in kept), "the saved state is a copy"
    run(other, 2, seed=13)
    other.qpos[2, 3] = torch.nan
    other.step(SUBSTEPS)
    other.load_state_dict(state)
    assert not other.unstable().any()
    assert same(run(other, 5, seed=12), future)


def test_views_stay_the_engines_own_and_graphs_can_be_recorded_anew(
    engine: WarpEngine, other: WarpEngine, scenes: list[Scene]
) -> None:
    views = {name: getattr(engine, name) for name in ("qpos", "qvel", "ctrl", "xfrc_applied", "sensordata")}
    engine.recapture()
    assert same(run(engine, 2, seed=14), run(other, 2, seed=14))
    engine.reset(everyone(), starts(scenes))
    for name, view in views.items():
        assert getattr(engine, name).data_ptr() == view.data_ptr() and view.dtype == torch.float32
    assert torch.equal(views["qpos"], starts(scenes))


def test_data_and_contact_depth_are_c_mujocos_view(engine: WarpEngine, scenes: list[Scene]) -> None:
    given = starts(scenes)
    egg = scenes[0].qpos["object"]
    given[0, egg] = torch.tensor([2.0, 0, 0.02, 1, 0, 0, 0])  # 2 cm in the floor
    given[1, egg] = torch.tensor([2.0, 0, 1.0, 1, 0, 0, 0])
    engine.reset(everyone(), given)
    assert engine.contact_depth(0) == pytest.approx(0.02, abs=1e-6)
    assert engine.contact_depth(1) == 0.0
    np.testing.assert_allclose(engine.data(1).qpos, given[1].numpy())
    assert engine.model(3) is scenes[3].model


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


def _range(at: slice) -> range:
    return range(int(at.start), int(at.stop))


def test_lost_contacts_are_told(scenes: list[Scene]) -> None:
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
