"""Scripted policies: they know the whole state and the task, and control the hands in closed loop."""

from collections.abc import Callable

from bidex_meta.errors import BidexError
from bidex_meta.rules import Rules
from bidex_meta.tasks.base import TaskClass
from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.scripts.blocks import push_blocks
from bidex_meta.witness.scripts.caps import pull_cap, swing_cup
from bidex_meta.witness.scripts.carrying import carry_egg, exchange_eggs
from bidex_meta.witness.scripts.placing import place_in_bucket
from bidex_meta.witness.scripts.pots import lift_underarm
from bidex_meta.witness.scripts.pouring import pour_and_carry, pour_water
from bidex_meta.witness.scripts.stack import stack_in_order
from bidex_meta.witness.scripts.swing_doors import close_outward, open_inward, push
from bidex_meta.witness.scripts.throwing import throw_down
from bidex_meta.witness.scripts.tools import open_pen, open_scissors, press_switches
from bidex_meta.witness.scripts.turning import turn_cubes

Script = Callable[[HandController], Actions]

SCRIPTS: dict[str, Script] = {
    "DoorCloseInward": push,
    "DoorCloseOutward": close_outward,
    "DoorOpenInward": open_inward,
    "GraspAndPlace": place_in_bucket,
    "LiftUnderarm": lift_underarm,
    "PourWater": pour_water,
    "ReOrientation": turn_cubes,
    "StackBlock": stack_in_order,
}
"""Scripts for version 1, by the class's name; version 2 shares those that WIDE_SCRIPTS does not replace."""
WIDE_SCRIPTS: dict[str, Script] = SCRIPTS | {
    "BottleCap": pull_cap,
    "CatchOver2Underarm": throw_down,
    "CatchUnderarm": carry_egg,
    "DoorOpenOutward": push,
    "HandOver": carry_egg,
    "OpenPenCap": open_pen,
    "OpenScissors": open_scissors,
    "PourWater": pour_and_carry,
    "PushBlock": push_blocks,
    "SwingCup": swing_cup,
    "Switch": press_switches,
    "TwoCatchUnderarm": exchange_eggs,
}
"""Scripts for version 2, by the class's name; they read what a task hides."""


def scripts_of(rules: Rules) -> dict[str, Script]:
    """Return the scripted policies for a suite with these rules, by the name of the task class."""
    return WIDE_SCRIPTS if rules.wide else SCRIPTS


def script_of(task: TaskClass) -> Script:
    """Return the script of a task class.

    Raises BidexError if the class has no script under its rules, or if its hands have fixed bases.
    """
    known = scripts_of(task.rules)
    if not task.moving_base:
        raise BidexError(f"Expected moving bases for the script of {task.name}, got fixed ones: moving_base=True.")
    if task.name not in known:
        raise BidexError(f"Expected a class with a script ({', '.join(known)}), got {task.name}; leave --script out.")
    return known[task.name]
