"""Views of several agents on a world: the observation entries and the actions of each agent.

The division follows the paper's appendix A.2. Each hand has six units: five fingers, and the palm with wrist and base.
An agent controls one or more units. It observes all entries of each hand in which it controls a unit, and all entries
that belong to no hand: object, goal, task id. All agents share the reward.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.hands.hand import SIDES, hand
from bidex_meta.hands.units import UNITS, Agents, partition_line, units_by_agent
from bidex_meta.tasks.layout import hand_blocks
from bidex_meta.world.contract import ObservationGroup


@dataclass(frozen=True)
class AgentView:
    """One agent of a world, e.g. ``right`` or ``right/thumb``."""

    name: str
    groups: tuple[ObservationGroup, ...]
    """The observation groups that the agent sees, with index ranges in the world's observation."""
    actions: tuple[int, ...]
    """Indices of the agent's entries in the world's action, ascending."""

    @property
    def columns(self) -> tuple[int, ...]:
        """Indices of the entries of the world's observation that the agent sees, ascending."""
        columns: list[int] = []
        for group in self.groups:
            for part in group.where:
                columns += range(part.start, part.stop)
        return tuple(sorted(columns))

    def own_groups(self) -> tuple[ObservationGroup, ...]:
        """Return the agent's observation groups, with index ranges in the agent's observation (:attr:`columns`)."""
        index = {column: i for i, column in enumerate(self.columns)}
        parts = [(slice(index[part.start], index[part.stop - 1] + 1) for part in group.where) for group in self.groups]
        return tuple(ObservationGroup(g.name, _joined(where)) for g, where in zip(self.groups, parts, strict=True))


def agent_views(groups: Sequence[ObservationGroup], num_actions: int, agents: Agents) -> tuple[AgentView, ...]:
    """Return one view per agent of a world, in the order of the agents in ``agents``.

    ``agents`` says which agent controls which units of the hands. It is ``single``, ``hands`` or ``fingers``, a line or
    a TOML file in the format of ``hands/units.py``, or a dict from each agent's name to its units. With ``hands`` and
    ``fingers`` the agents of the right hand come first. A world without hands has the units ``action/0``, ``action/1``,
    ..., and every agent observes everything. Raises BidexError if a unit is unknown, missing or named twice, or if the
    hands' bases move in only some of the classes.
    """
    units = _units(groups, num_actions)
    views = []
    for name, own in _units_of_agents(units, partition_line(agents)).items():
        others = {f"{side}_hand" for side in SIDES} - {f"{unit.partition('/')[0]}_hand" for unit in own}
        visible = tuple(group for group in groups if group.name not in others or not _has_hands(groups))
        actions = tuple(sorted(chain.from_iterable(units[unit] for unit in own)))
        views.append(AgentView(name, visible, actions))
    return tuple(views)


def _joined(parts: Iterable[slice]) -> tuple[slice, ...]:
    found: list[slice] = []
    for part in parts:
        if found and found[-1].stop == part.start:
            found[-1] = slice(found[-1].start, part.stop)
        else:
            found.append(part)
    return tuple(found)


def _has_hands(groups: Sequence[ObservationGroup]) -> bool:
    names = {group.name for group in groups}
    return any(f"{side}_hand" in names for side in SIDES)


def _units(groups: Sequence[ObservationGroup], num_actions: int) -> dict[str, list[int]]:
    if not _has_hands(groups):
        return {f"action/{i}": [i] for i in range(num_actions)}
    share = num_actions // len(SIDES)
    found = dict[str, list[int]]()
    sizes = {group.name: group.size for group in groups}
    moving = share > len(hand().actuated)
    whole = [sum(block.size for block in hand_blocks("right", moving, touch)) for touch in (False, True)]
    if any(sizes.get(f"{side}_hand") not in whole for side in SIDES):
        raise BidexError(
            f"agents: expected a world that shows each hand as {whole[0]} entries, or {whole[1]} with touch, got "
            f"{sizes}: its classes have moving and fixed bases. Name a suite or a task of one kind."
        )
    joints = [hand().joints[i] for i in hand().actuated]
    for number, side in enumerate(SIDES):
        for unit, begin in UNITS.items():
            own = [i for i, joint in enumerate(joints) if joint.startswith(begin)]
            own += range(len(joints), share) if unit == "palm" else []
            found[f"{side}/{unit}"] = [number * share + i for i in own]
    return found


def _units_of_agents(units: dict[str, list[int]], line: str) -> dict[str, list[str]]:
    if line == "single":
        return {"single": list(units)}
    if line in ("hands", "fingers") and not any(unit.startswith(SIDES) for unit in units):
        raise BidexError(f"agents: {line} needs a world with hands; this one has the units {', '.join(units)}.")
    if line == "fingers":
        return {unit: [unit] for unit in units}
    if line == "hands":
        return {side: [unit for unit in units if unit.startswith(f"{side}/")] for side in SIDES}
    found = units_by_agent(line)
    owners: dict[str, str] = {}
    for name, own in found.items():
        for unit in own:
            if unit not in units:
                raise unknown_name(f"unit of agent {name}", unit, units)
            if unit in owners:
                raise BidexError(
                    f"agents: expected each unit once, but {unit} belongs to {owners[unit]} and to {name}. Remove one."
                )
            owners[unit] = name
    missing = [unit for unit in units if unit not in owners]
    if missing:
        raise BidexError(
            f"agents: expected each unit of the world, but {', '.join(missing)} belongs to no agent. Add it."
        )
    return found
