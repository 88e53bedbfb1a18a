"""Which classes share a batch, and that sharing changes nothing."""

import mujoco
import pytest

from bidex_meta.engine.capacity import check_ordered_sums, room_for
from bidex_meta.engine.models import differing_fields, same_structure
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene, build_spec, compile_scene
from tests.tasks.worlds import CASES

ONE_EGG = {(name, True) for name in ("CatchUnderarm", "CatchOver2Underarm", "CatchAbreast")}
DOORS = {case for case in CASES if case[0].startswith("Door")}


@pytest.fixture(scope="module")
def scenes() -> dict[tuple[str, bool], Scene]:
    return {case: compile_scene(registry.get(*case)) for case in CASES}


def test_classes_that_differ_in_numbers_share_a_batch(scenes: dict[tuple[str, bool], Scene]) -> None:
    for a in scenes:
        for b in scenes:
            together = a == b or {a, b} <= ONE_EGG or {a, b} <= DOORS
            assert same_structure(scenes[a].model, scenes[b].model) == together, (a, b)


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


@pytest.mark.parametrize("name", registry.names())
def test_room_exceeds_what_was_seen(name: str) -> None:
    seen = registry.get(name, True).needs
    room = room_for([seen])
    assert room.contacts >= 1.5 * seen.contacts and room.rows >= 1.5 * seen.rows
    assert room.contacts >= room.convex >= max(2, 1.5 * seen.convex)


@pytest.mark.parametrize(("num", "fits"), [(25, True), (8192, False)])
def test_ordered_sums_that_exceed_the_memory_are_refused(num: int, fits: bool) -> None:
    """The door classes on a GPU of 139 GB: 66 degrees of freedom, four substeps."""
    if fits:
        check_ordered_sums(66, 192, num, 4, 139 * 10**9)
    else:
        with pytest.raises(BidexError, match=r"8,192 environments .* about 473 GB .* \(about 2,40. of this kind fit\)"):
            check_ordered_sums(66, 192, num, 4, 139 * 10**9)


def test_every_class_was_measured_and_a_stranger_has_the_largest_of_all() -> None:
    seen = [registry.get(name, True).needs for name in registry.names()]
    for name in ("contacts", "convex", "rows"):
        assert getattr(TaskClass.needs, name) == max(getattr(one, name) for one in seen)
    assert len(set(seen)) == len(seen)


def test_more_water_gets_more_room() -> None:
    """Against the most that was seen with 125 drops."""
    few, many = (registry.get("PourWater", True, water=water).needs for water in (12, 125))
    room = room_for([many])
    assert room.contacts > 255 and room.convex > 129 and room.rows > 282
    assert few == registry.get("PourWater", True).needs
    assert room_for([few, many]) == room
