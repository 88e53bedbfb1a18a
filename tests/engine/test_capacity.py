"""Room for contacts: the table covers the classes, and a group gets the largest of its classes' rooms."""

import mujoco
import pytest

from bidex_meta.engine import capacity
from bidex_meta.engine.capacity import Capacity, capacity_of
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene


def model(name: str) -> mujoco.MjModel:
    return compile_scene(registry.get(name, True)).model


def test_every_class_was_measured() -> None:
    assert sorted(capacity._MEASURED) == sorted(registry.names())


@pytest.mark.parametrize("name", registry.names())
def test_room_exceeds_what_was_seen(name: str) -> None:
    room, (contacts, convex, rows) = capacity_of([model(name)]), capacity._MEASURED[name]
    assert room.contacts >= 1.5 * contacts and room.rows >= 1.5 * rows and room.convex >= max(2, 1.5 * convex)
    assert room.convex <= room.contacts


def test_more_water_gets_more_room() -> None:
    """Against the most that was seen with 125 drops."""
    few, many = (compile_scene(registry.get("PourWater", True, water=water)).model for water in (12, 125))
    room = capacity_of([many])
    assert room.contacts > 255 and room.convex > 129 and room.rows > 282
    assert capacity_of([few]) == capacity_of([model("PourWater")])
    assert capacity_of([few, many]) == room


def test_a_group_gets_the_largest_room_of_its_classes_and_a_stranger_that_of_all() -> None:
    assert capacity_of([model("CatchUnderarm"), model("HandOver")]) == Capacity(48, 12, 80)
    stranger = mujoco.MjModel.from_xml_string("<mujoco model='ball'><worldbody/></mujoco>")
    assert capacity_of([stranger]) == Capacity(112, 30, 208)
