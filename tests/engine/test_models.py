"""Which classes share a batch, and that sharing changes nothing."""

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.engine.models import differing_fields, same_structure
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import Scene, build_spec, compile_scene
from bidex_meta.world.base import split_rows
from bidex_meta.world.groups import build_groups
from tests.tasks.worlds import CASES, MOVING, slot

ONE_EGG = {(name, True) for name in ("CatchUnderarm", "CatchOver2Underarm", "CatchAbreast")}
DOORS = {case for case in CASES if case[0].startswith("Door")}
SUBSTEPS = 4


@pytest.fixture(scope="module")
def scenes() -> dict[tuple[str, bool], Scene]:
    return {case: compile_scene(registry.get(*case)) for case in CASES}


def test_classes_that_differ_in_numbers_share_a_batch(scenes: dict[tuple[str, bool], Scene]) -> None:
    for a in scenes:
        for b in scenes:
            together = a == b or {a, b} <= ONE_EGG or {a, b} <= DOORS
            assert same_structure(scenes[a].model, scenes[b].model) == together, (a, b)


def test_two_compiles_of_a_class_are_equal() -> None:
    first, second = (compile_scene(registry.get("CatchAbreast")).model for _ in range(2))
    assert differing_fields(first, second) == []
    assert same_structure(first, second)


CHANGES = {
    "": lambda spec, egg: None,
    "timestep": lambda spec, egg: setattr(spec.option, "timestep", 1 / 480),
    "geom type": lambda spec, egg: setattr(egg, "type", mujoco.mjtGeom.mjGEOM_BOX),
    "contact bits": lambda spec, egg: setattr(egg, "contype", 64),
    "condim": lambda spec, egg: setattr(egg, "condim", 1),
    "one more body": lambda spec, egg: spec.worldbody.add_body(name="extra", pos=(2, 0, 1)),
    "size": lambda spec, egg: setattr(egg, "size", (0.02, 0.03, 0.05)),
    "mass": lambda spec, egg: setattr(egg, "density", 900),
    "colour": lambda spec, egg: setattr(egg, "rgba", (1, 0, 0, 1)),
    "pose": lambda spec, egg: setattr(spec.body("right/base"), "pos", (0.3, 0.1, 0.7)),
}


def other(change: str) -> mujoco.MjModel:
    """HandOver with a change."""
    spec = build_spec(registry.get("HandOver", True))
    CHANGES[change](spec, next(geom for geom in spec.geoms if geom.name == "object/egg"))
    return spec.compile()


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_another_structure(change: str) -> None:
    numbers = change in ("", "size", "mass", "colour", "pose")
    assert same_structure(other(""), other(change)) == numbers
    if numbers:
        assert bool(differing_fields(other(""), other(change))) == bool(change)


def test_groups_of_a_mixed_world() -> None:
    slots = [slot(registry.get(name, True)) for name in MOVING]
    make = lambda models, rows, room: CpuEngine(models, rows, threads=1)  # noqa: E731
    groups = build_groups(slots, split_rows(23, len(slots)), make)
    names = [[member.scene.task.name for member in group.members] for group in groups]
    shared = [sorted(name for name, _ in ONE_EGG), sorted(name for name in MOVING if name.startswith("Door"))]
    alone = [[name] for name in MOVING if not any(name in group for group in shared)]
    assert sorted(map(sorted, names)) == sorted([*shared, *alone])
    rows = torch.cat([group.rows for group in groups])
    assert sorted(rows.tolist()) == list(range(23))
    for group in groups:
        assert group.engine.num == len(group.rows)
        for member in group.members:
            for row in range(member.engine_rows.start, member.engine_rows.stop):
                assert differing_fields(group.engine.model(row), member.scene.model) == []


@pytest.mark.parametrize(
    "num, slots, sizes", [(11, 4, [3, 3, 3, 2]), (8, 4, [2, 2, 2, 2]), (4, 4, [1] * 4), (5, 1, [5])]
)
def test_rows_are_split_evenly(num: int, slots: int, sizes: list[int]) -> None:
    rows = split_rows(num, slots)
    assert [r.stop - r.start for r in rows] == sizes
    assert [r.start for r in rows] == [0, *(r.stop for r in rows[:-1])]


@pytest.mark.parametrize("name", sorted(name for name, _ in ONE_EGG))
def test_a_class_in_a_mixed_batch_is_its_own_compile_bit_for_bit(
    scenes: dict[tuple[str, bool], Scene], name: str
) -> None:
    """The batch is made for one model and given the others by row; every class must run as if it were alone."""
    order = sorted(ONE_EGG)
    mixed = CpuEngine([scenes[case].model for case in order], [i for i in range(len(order)) for _ in range(2)], 1)
    place = order.index((name, True))
    mine = slice(2 * place, 2 * place + 2)
    alone = CpuEngine([scenes[name, True].model], [0, 0], 1)
    starts = torch.stack([torch.from_numpy(scenes[case].start_qpos) for case in order for _ in range(2)])
    mixed.reset(torch.ones(mixed.num, dtype=torch.bool), starts)
    alone.reset(torch.ones(2, dtype=torch.bool), starts[mine])
    rng = np.random.default_rng(0)
    low, high = scenes[name, True].model.actuator_ctrlrange.T
    bodies = scenes[name, True].base_bodies
    for _ in range(50):
        ctrl = torch.from_numpy(rng.uniform(low, high, (mixed.num, len(low))))
        wrench = torch.from_numpy(rng.uniform(-80, 80, (mixed.num, 2, 6)) * (1, 1, 1, 0.1, 0.1, 0.1))
        for engine, rows in ((mixed, slice(None)), (alone, mine)):
            engine.ctrl[:] = ctrl[rows]
            engine.xfrc_applied[:, bodies] = wrench[rows]
            engine.step(SUBSTEPS)
        for view in ("qpos", "qvel", "sensordata"):
            assert torch.equal(getattr(mixed, view)[mine], getattr(alone, view)), view
    assert not torch.equal(alone.qpos, starts[mine])
    assert not mixed.unstable().any()


@pytest.mark.parametrize("name, moving", CASES)
def test_the_batch_is_plain_mujoco(scenes: dict[tuple[str, bool], Scene], name: str, moving: bool) -> None:
    """Twenty control steps of a row against mj_step."""
    scene = scenes[name, moving]
    engine = CpuEngine([scene.model], [0], 1)
    engine.reset(torch.tensor([True]), torch.from_numpy(scene.start_qpos)[None])
    data = mujoco.MjData(scene.model)
    rng = np.random.default_rng(1)
    low, high = scene.model.actuator_ctrlrange.T
    for _ in range(20):
        ctrl = rng.uniform(low, high)
        engine.ctrl[0], data.ctrl[:] = torch.from_numpy(ctrl), ctrl
        engine.step(SUBSTEPS)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(scene.model, data)
        np.testing.assert_allclose(engine.qpos[0].numpy(), data.qpos, atol=1e-9)
        np.testing.assert_allclose(engine.qvel[0].numpy(), data.qvel, atol=1e-7)
