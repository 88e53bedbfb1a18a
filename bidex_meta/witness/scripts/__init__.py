"""Scripted policies: they know the whole state and the task, and control the hands in closed loop."""

from collections.abc import Callable

from bidex_meta.errors import BidexError
from bidex_meta.tasks.registry import plain_name
from bidex_meta.witness.controller import HandController
from bidex_meta.witness.scripts.blocks import grasp_and_place, push_blocks, stack_block
from bidex_meta.witness.scripts.caps import pull_cap, swing_cup
from bidex_meta.witness.scripts.cubes import turn_cubes
from bidex_meta.witness.scripts.doors import close_outward, open_inward, push
from bidex_meta.witness.scripts.tools import open_pen, open_scissors, press_switches
from bidex_meta.witness.scripts.vessels import lift_underarm, pour_water

SCRIPTS: dict[str, Callable[[HandController], None]] = {
    "BottleCap": pull_cap,
    "DoorCloseInward": push,
    "DoorCloseOutward": close_outward,
    "DoorOpenInward": open_inward,
    "DoorOpenOutward": push,
    "GraspAndPlace": grasp_and_place,
    "LiftUnderarm": lift_underarm,
    "OpenPenCap": open_pen,
    "OpenScissors": open_scissors,
    "PourWater": pour_water,
    "PushBlock": push_blocks,
    "ReOrientation": turn_cubes,
    "StackBlock": stack_block,
    "SwingCup": swing_cup,
    "Switch": press_switches,
}


def script_of(name: str) -> Callable[[HandController], None]:
    """The script of a class, whatever its version; raises BidexError where it has none."""
    plain = plain_name(name)
    if plain not in SCRIPTS:
        raise BidexError(f"Expected a class with a script ({', '.join(SCRIPTS)}), got {name}; leave --script out.")
    return SCRIPTS[plain]
