"""Scripted policies: they know the whole state and the task, and control the hands in closed loop."""

from collections.abc import Callable

from bidex_meta.errors import BidexError
from bidex_meta.tasks.registry import plain_name
from bidex_meta.witness.controller import HandController
from bidex_meta.witness.scripts.blocks import grasp_and_place, push_blocks, stack_block
from bidex_meta.witness.scripts.caps import pull_cap, swing_cup
from bidex_meta.witness.scripts.pots import lift_underarm, pour_water
from bidex_meta.witness.scripts.swing_doors import close_outward, open_inward, push
from bidex_meta.witness.scripts.tools import open_pen, open_scissors, press_switches
from bidex_meta.witness.scripts.turning import turn_cubes

Script = Callable[[HandController], None]

SCRIPTS: dict[str, Script] = {
    "DoorCloseOutward": close_outward,
    "DoorOpenInward": open_inward,
    "GraspAndPlace": grasp_and_place,
    "LiftUnderarm": lift_underarm,
    "PourWater": pour_water,
    "ReOrientation": turn_cubes,
    "StackBlock": stack_block,
}
"""Of version 1; they play version 2 too."""
WIDE_SCRIPTS: dict[str, Script] = SCRIPTS | {
    "BottleCap": pull_cap,
    "DoorCloseInward": push,
    "DoorOpenOutward": push,
    "OpenPenCap": open_pen,
    "OpenScissors": open_scissors,
    "PushBlock": push_blocks,
    "SwingCup": swing_cup,
    "Switch": press_switches,
}
"""Of version 2: they read what a task hides."""


def script_of(name: str) -> Script:
    """The script of a class, ``X`` or ``X-v2``; raises BidexError where it has none."""
    plain = plain_name(name)
    known = SCRIPTS if plain == name else WIDE_SCRIPTS
    if plain not in known:
        raise BidexError(f"Expected a class with a script ({', '.join(known)}), got {name}; leave --script out.")
    return known[plain]
