"""Settings that apply to all classes of a suite: its rules (version 1, version 2 or a mixture), and randomisation."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from bidex_meta.errors import one_line
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import check_fields, check_rising

CONTROL_RATE = 60
"""Control steps per second of every class (docs/figures.md, control)."""
HELD_STEPS = 15
"""Number of control steps at the end of an episode (0.25 s) in which the condition must hold without a break, if
success counts at the end."""


@checked_arguments
@dataclass(frozen=True)
class Rules:
    """The four rules in which versions 1 and 2 of a suite differ: reward, variation of tasks, success, and starts.

    A suite can choose each rule independently. The defaults are those of version 1, and ``V2`` has those of version 2.
    """

    reward: Literal["paper", "v2"] = "paper"
    """``paper``: the formula that the paper prints for each class; ``v2``: the terms of ``aligned_terms``."""
    variation: Literal["narrow", "wide"] = "narrow"
    """Narrow goals vary about as much as success tolerates; wide goals vary several times as much, with a hidden
    quantity in every class. Wide variation also makes the w of objects' and goals' quaternions non-negative in
    observations."""
    success: Literal["once", "at-end"] = "once"
    """``once``: the condition must hold in at least one step of the episode; ``at-end``: in the last ``HELD_STEPS``
    steps."""
    starts: Literal["plain", "jittered"] = "plain"
    """``plain``: starts as each class defines them; ``jittered``: every episode of every class draws joint noise and
    shifts fixtures and objects."""

    @property
    def wide(self) -> bool:
        """Return whether the suite uses the wide variation of tasks, in which every class hides a quantity."""
        return self.variation == "wide"

    @property
    def as_printed(self) -> bool:
        """Return whether tasks and reward are those of version 1, so that returns can be compared with version 1."""
        return self.reward == "paper" and not self.wide

    @property
    def jittered(self) -> bool:
        """Return whether every episode begins with joint noise and shifted objects and fixtures."""
        return self.starts == "jittered"


V1 = Rules()
V2 = Rules("v2", "wide", "at-end", "jittered")
_VERSIONED = re.compile(r"([^-/]+)-v2(?![^-/])", re.IGNORECASE)


def plain_name(name: str) -> str:
    """Return a class's name without the ``-v2`` that gives the class the rules of version 2."""
    found = _VERSIONED.match(name)
    if found is None:
        return name
    return found[1] + name[found.end() :]


def versioned_name(name: str, rules: Rules) -> str:
    """Return a class's name with ``-v2`` added if the rules are those of version 2, otherwise unchanged.

    In a name with an object, ``-v2`` comes before the object: ``CatchUnderarm-v2-block``.
    """
    task_class, dash, thing = plain_name(name).partition("-")
    if rules == V2:
        return f"{task_class}-v2{dash}{thing}"
    return name


def rules_apart(others: Mapping[str, object], rules: Rules) -> str:
    """Describe in words how the rules ``others`` differ from ``rules``; return "" if they are equal.

    ``others`` maps the names of rules to their values.
    """
    pairs = [(name, others.get(name), value) for name, value in vars(rules).items()]
    return ", ".join(one_line(f"{name} {other}, not {value}") for name, other, value in pairs if other != value)


_Factor = Annotated[float, Meta(ge=0.01, le=100.0)]
_Size = Annotated[float, Meta(ge=0.9, le=1.1)]  # the success of StackBlock and PourWater assumes sizes near 1
_Steps = Annotated[int, Meta(ge=0, le=60)]
_Range = tuple[_Factor, _Factor]


@dataclass(frozen=True)
class Randomisation:
    """Random changes of environments: factors on quantities of the physics, noise, delays of actions, and pushes.

    Factors are drawn uniformly from ranges. By default nothing is changed. Raises BidexError for values out of bounds,
    or if a range ends below its start.
    """

    friction: _Range = (1.0, 1.0)
    """Factor of the friction of all contacts."""
    object_mass: _Range = (1.0, 1.0)
    object_size: tuple[_Size, _Size] = (1.0, 1.0)
    """Factor of the lengths of free objects without joints; their masses do not change. Not with point clouds,
    pictures or ``--object``."""
    actuator_gain: _Range = (1.0, 1.0)
    """Factor of the fingers' actuator forces, before their limits."""
    joint_damping: _Range = (1.0, 1.0)
    """Factor of the damping of the fingers' joints."""
    gravity: _Range = (1.0, 1.0)
    observation_noise: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    """Standard deviation of the noise on sensor readings of hands and objects, in the units of the observation."""
    action_noise: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.0
    """Standard deviation of the noise on actions, which are clipped afterwards."""
    action_delay: tuple[_Steps, _Steps] = (0, 0)
    """Range of the delay of actions, in whole control steps."""
    push_speed: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    """Largest change that a push makes to the velocity of every object along each axis, m/s."""
    push_interval: Annotated[float, Meta(ge=0.1, le=1000.0)] = 1.0
    """Mean time between pushes, s."""
    draw: Literal["episode", "environment"] = "episode"
    """Factors and the delay are drawn in every episode, or once per environment."""

    def __post_init__(self) -> None:
        check_fields(self, "randomisation")
        check_rising(self, "randomisation", *FACTORS, "action_delay")


FACTORS = ("friction", "object_mass", "object_size", "actuator_gain", "joint_damping", "gravity")
"""Fields of ``Randomisation`` that are factors of quantities of the physics model."""
