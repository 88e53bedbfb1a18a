"""The CPU engine's resets, health report and state."""

import os
import subprocess
import sys

import mujoco
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import Scene, build_spec, compile_scene
from bidex_meta.utils.memory import usable_cores
from tests.tasks.worlds import Lens, depths

SUBSTEPS, ROWS = 4, 4


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(registry.get("CatchUnderarm"))


def fresh(scene: Scene, rows: int = ROWS, threads: int = 1) -> CpuEngine:
    engine = CpuEngine([scene.model], [0] * rows, threads)
    engine.reset(everyone(engine), starts(scene, rows))
    return engine


def starts(scene: Scene, rows: int) -> Tensor:
    qpos = torch.from_numpy(scene.start_qpos).repeat(rows, 1)
    qpos[:, scene.qpos["object"].start] += 0.001 * torch.arange(rows)
    return qpos


def everyone(engine: CpuEngine) -> Tensor:
    return torch.ones(engine.num, dtype=torch.bool)


def run(engine: CpuEngine, steps: int, seed: int, active: Tensor | None = None) -> list[Tensor]:
    """Random targets and forces, the same for the same seed; the states they led to."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(steps):
        engine.ctrl[:] = 0.7 * torch.rand(engine.ctrl.shape, generator=generator, dtype=torch.float64)
        engine.xfrc_applied[:, 1, :3] = 60 * torch.rand(engine.num, 3, generator=generator, dtype=torch.float64) - 30
        engine.step(SUBSTEPS, active)
        found.append(torch.cat((engine.qpos, engine.qvel, engine.sensordata), dim=1).clone())
    return found


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
def test_a_broken_row_is_told_and_its_neighbours_do_not_change_by_a_bit(scene: Scene, breakage: str) -> None:
    whole, broken = fresh(scene), fresh(scene)
    run(whole, 3, seed=0)
    run(broken, 3, seed=0)
    assert not broken.unstable().any()
    BREAKAGES[breakage](broken)
    broken.step(SUBSTEPS)
    whole.step(SUBSTEPS)
    assert broken.unstable().tolist() == [False, True, False, False]
    rest = [0, 2, 3]
    assert torch.equal(whole.qpos[rest], broken.qpos[rest])
    assert same(run(whole, 3, seed=1), run(broken, 3, seed=1), rest)
    assert broken.unstable().tolist() == [False, True, False, False], "told until the reset"
    assert not whole.unstable().any()


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_a_row_reset_after_breaking_is_as_good_as_new(scene: Scene, breakage: str) -> None:
    engine = fresh(scene)
    run(engine, 5, seed=2)
    BREAKAGES[breakage](engine)
    run(engine, 2, seed=3)
    mask = torch.tensor([False, True, False, False])
    engine.reset(mask, starts(scene, ROWS)[1:2])
    assert not engine.unstable().any()
    new = fresh(scene)
    assert torch.equal(engine.sensordata[1], new.sensordata[1])
    for view in ("qvel", "ctrl", "xfrc_applied"):
        assert (getattr(engine, view)[1] == 0).all(), view
    assert same(run(engine, 20, seed=4), run(new, 20, seed=4), [1])


def test_resets_of_all_rows_equal_a_fresh_batch(scene: Scene) -> None:
    """Nothing is carried over: warm start, controls, applied forces, contacts."""
    used, new = fresh(scene, 16), fresh(scene, 16)
    run(used, 30, seed=5)
    used.reset(everyone(used), starts(scene, 16))
    assert same(run(used, 10, seed=6), run(new, 10, seed=6))


def test_a_reset_touches_only_its_rows(scene: Scene) -> None:
    engine, untouched = fresh(scene), fresh(scene)
    run(engine, 5, seed=7)
    run(untouched, 5, seed=7)
    engine.reset(torch.tensor([True, False, False, True]), starts(scene, ROWS)[[0, 3]])
    assert torch.equal(engine.qpos[[0, 3]], starts(scene, ROWS)[[0, 3]])
    assert torch.equal(engine.qpos[[1, 2]], untouched.qpos[[1, 2]])
    assert same(run(engine, 5, seed=8), run(untouched, 5, seed=8), [1, 2])


def test_inactive_rows_stand_still(scene: Scene) -> None:
    engine, whole = fresh(scene), fresh(scene)
    before = engine.qpos.clone()
    some = run(engine, 5, seed=9, active=torch.tensor([True, False, True, False]))
    assert torch.equal(engine.qpos[[1, 3]], before[[1, 3]]) and (engine.qvel[[1, 3]] == 0).all()
    assert same(some, run(whole, 5, seed=9), [0, 2])


def test_threads_change_nothing(scene: Scene) -> None:
    assert same(run(fresh(scene, 8, threads=1), 10, seed=10), run(fresh(scene, 8, threads=2), 10, seed=10))
    assert usable_cores() >= 1


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


def test_a_saved_state_goes_on_bit_for_bit(scene: Scene) -> None:
    engine, other = fresh(scene), fresh(scene)
    run(engine, 10, seed=11)
    state = engine.state_dict()
    kept = {name: value.clone() for name, value in state.items()}
    future = run(engine, 10, seed=12)
    assert all(torch.equal(state[name], kept[name]) for name in kept), "the saved state is a copy"
    run(other, 3, seed=13)
    other.load_state_dict(state)
    assert torch.equal(other.qpos, state["qpos"])
    assert same(run(other, 10, seed=12), future)


def test_loading_forgets_that_a_row_was_broken(scene: Scene) -> None:
    engine = fresh(scene)
    state = engine.state_dict()
    engine.qpos[2, 5] = torch.nan
    engine.step(SUBSTEPS)
    assert engine.unstable()[2]
    engine.load_state_dict(state)
    assert not engine.unstable().any()


def test_a_row_without_memory_for_its_contacts_is_unstable() -> None:
    """MuJoCo raises SimulationError for such a row; the others have stepped, and no exception reaches the world."""
    spec = build_spec(registry.get("CatchUnderarm"))
    spec.memory = 300_000  # enough for a start, too little for the solver in the tangle below
    cramped = Scene(registry.get("CatchUnderarm"), spec.compile())
    engine = CpuEngine([cramped.model], [0] * 3, 1)
    qpos = starts(cramped, 3)
    # The second row's hands stand in each other and in the floor: more contacts than it has memory for.
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


def test_views_stay_the_engines_own(scene: Scene) -> None:
    engine = fresh(scene)
    views = {name: getattr(engine, name) for name in ("qpos", "qvel", "ctrl", "xfrc_applied", "sensordata")}
    run(engine, 2, seed=14)
    engine.reset(everyone(engine), starts(scene, ROWS))
    for name, view in views.items():
        assert getattr(engine, name).data_ptr() == view.data_ptr() and view.dtype == torch.float64
    assert torch.equal(views["qpos"], starts(scene, ROWS))


def test_sensors_after_a_step_are_those_of_the_new_state(scene: Scene) -> None:
    engine = fresh(scene, 1)
    run(engine, 4, seed=15)
    data = Lens(scene.model).look(engine.qpos[0], engine.qvel[0])
    mujoco.mj_sensorPos(scene.model, data)
    mujoco.mj_sensorVel(scene.model, data)
    for name in ("object/position", "object/linear_velocity", "right/FFJ1_velocity", "left/thdistal_quaternion"):
        torch.testing.assert_close(
            engine.sensordata[0, scene.sensors[name]],
            torch.from_numpy(data.sensor(name).data.copy()),
            atol=1e-12,
            rtol=0,
        )


def test_contact_depth(scene: Scene) -> None:
    engine = fresh(scene, 2)
    qpos = starts(scene, 2)
    qpos[0, scene.qpos["object"]] = torch.tensor([2.0, 0, 0.02, 1, 0, 0, 0], dtype=torch.float64)  # 2 cm in the floor
    qpos[1, scene.qpos["object"]] = torch.tensor([2.0, 0, 1.0, 1, 0, 0, 0], dtype=torch.float64)
    engine.reset(everyone(engine), qpos)
    assert engine.contact_depth(0) == pytest.approx(0.02, abs=1e-6)
    assert engine.contact_depth(1) == 0.0
    assert depths(engine.data(0)).max() == pytest.approx(0.02, abs=1e-6)


def test_broken_rows_are_silent(scene: Scene, capfd: pytest.CaptureFixture[str], monkeypatch, tmp_path) -> None:
    """MuJoCo prints each broken row and writes a log file into the working folder unless it is told not to."""
    monkeypatch.chdir(tmp_path)
    engine = fresh(scene)
    engine.qpos[0, 0] = torch.nan
    engine.step(SUBSTEPS)
    assert capfd.readouterr() == ("", "") and list(tmp_path.iterdir()) == []
