"""Room for contacts: every class says what it needs, and a group gets the largest of its classes' rooms."""

import pytest

from bidex_meta.engine.capacity import room_for
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass


@pytest.mark.parametrize("name", registry.names())
def test_room_exceeds_what_was_seen(name: str) -> None:
    seen = registry.get(name, True).needs
    room = room_for([seen])
    assert room.contacts >= 1.5 * seen.contacts and room.rows >= 1.5 * seen.rows
    assert room.contacts >= room.convex >= max(2, 1.5 * seen.convex)


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
