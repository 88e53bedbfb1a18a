"""Worlds of one throwing class with an object of the shelf."""

from typing import Any

import numpy as np

from bidex_meta.tasks import registry
from bidex_meta.world import World
from tests.tasks.worlds import slot

PUBLISHED = {
    # mm in ascending order and g: Calli et al. 2015, the table of the YCB set; what is round has its diameter twice.
    "sugar_box": ((38, 89, 175), 514),
    "soup_can": ((66, 66, 101), 349),
    "mustard_bottle": ((58, 95, 190), 603),
    "tuna_can": ((33, 85, 85), 171),
    "pudding_box": ((35, 89, 110), 187),
    "gelatin_box": ((28, 73, 85), 97),
    "meat_can": ((50, 82, 97), 370),
    "apple": ((75, 75, 75), 68),
    "pear": ((66.2, 66.2, 100), 49),
    "hammer": ((24, 32, 135), 665),
    "tennis_ball": ((64.7, 64.7, 64.7), 58),
    "rubiks_cube": ((57, 57, 57), 94),
}
LONG = {"banana": (190, 66), "mug": (None, 118), "pen": (216, 42.36), "block": (50, 70.9)}
"""Others: longest side (mm) and mass (g)."""


def world_with(name: str, thing: str, rows: int, moving: bool | None = True, **options: Any) -> World:
    """Rows of a class with an object, each with a task of its own; they wait for resets."""
    slots = [slot(registry.get(name, moving, object=thing), min(rows, 16))]
    return World(slots, rows, **({"autoreset_mode": "DISABLED", "threads": 1} | options))


def worst_depth(world: World, lens: Any, placement: np.ndarray) -> float:
    """The deepest that anything sticks in anything right after a reset, metres."""
    from tests.tasks.worlds import depths

    return max(float(depths(lens.look(row)).max()) for row in placement)
