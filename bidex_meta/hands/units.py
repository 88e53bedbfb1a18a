"""Partitions of the units of hands (fingers and palms) into agents (appendix A.2). This module imports no torch.

A partition is ``single``, ``hands``, ``fingers`` (twelve agents), ``thrower=right/palm+right/thumb;helper=...``, or the
path of a TOML file with a table ``[agents]``: ``thrower = ["right/palm", "right/thumb"]``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.utils.files import expanded, read_toml
from bidex_meta.utils.validation import Text, parse

UNITS: dict[str, str] = {"palm": "WR", "first": "FF", "middle": "MF", "ring": "RF", "little": "LF", "thumb": "TH"}
"""The smallest agents of a hand, with the prefix of their joints' names. The palm has the wrist, and the base if it
moves."""
NAMED = ("single", "hands", "fingers")
"""Names of partitions whose units need not be listed."""

Agents = str | Path | Mapping[str, Sequence[str]]
"""A partition: a name of :data:`NAMED`, a line, a TOML file, or a mapping from each agent's name to its units."""


@dataclass(frozen=True)
class _Partition:
    agents: Annotated[dict[Text, Annotated[list[Text], Meta(min_length=1)]], Meta(min_length=1)]


def partition_line(agents: Agents) -> str:
    """Return a partition of the hands into agents as one line of text.

    The line is a name of :data:`NAMED`, or lists the agents with their units (``name=unit+unit;name=unit``). The names
    of the units are not checked here; ``agent_views`` checks them. Raises BidexError for a line of another form, or a
    file that cannot be read or has no agents.
    """
    if isinstance(agents, Mapping):
        return _line({"agents": dict(agents)}, "partition")
    text = str(agents)
    if text.endswith(".toml"):
        return _line(read_toml(expanded(text), "a partition of agents"), text)
    if text in NAMED:
        return text
    return _line({"agents": units_by_agent(text)}, "partition")


def units_by_agent(line: str) -> dict[str, list[str]]:
    """Return the units of each agent in a line ``name=unit+unit;name=unit``.

    Raises BidexError if the line has another form, or if an agent occurs twice.
    """
    found: dict[str, list[str]] = {}
    for part in line.split(";"):
        name, equals, units = (each.strip() for each in part.partition("="))
        if not equals or not name or name in found:
            if name in found:
                why = f"{name} twice"
            else:
                why = repr(line)
            raise BidexError(
                f"agents: expected {', '.join(NAMED)}, the path of a TOML file, or name=unit+unit;name=unit with each "
                f"agent once, got {why}. Fix it as docs/learners/multiagent.md shows."
            )
        found[name] = [unit.strip() for unit in units.split("+")]
    return found


def _line(content: object, where: str) -> str:
    agents = parse(content, _Partition, where, exact=True).agents
    for name, units in agents.items():
        if set(";=+").intersection("".join((name, *units))):
            raise BidexError(f"{where}: agents.{name}: expected names without ; = and +, got {units!r}.")
    return ";".join(f"{name}={'+'.join(units)}" for name, units in agents.items())
