"""Fingers and palms as agents: partitions of the hands' units as a user writes them (appendix A.2). Imports no torch.

A partition is one line of text, which a run's config and its checkpoints keep:

* ``single``: one agent is both hands; ``hands``: one agent a hand; ``fingers``: each unit by itself, twelve agents;
* ``thrower=right/palm+right/thumb;helper=...``: agents by name, with the units that each has;
* the path of a TOML file with a table ``[agents]`` of the same: ``thrower = ["right/palm", "right/thumb"]``.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError

UNITS: dict[str, str] = {
    "palm": "WR", "first": "FF", "middle": "MF", "ring": "RF", "little": "LF", "thumb": "TH",
}  # fmt: skip
"""The smallest agents of a hand, with what the names of their joints begin with. The palm has the wrist, and the base
where it moves."""
NAMED = ("single", "hands", "fingers")
"""Partitions that need no list."""

Agents = str | Path | Mapping[str, Sequence[str]]
"""A partition: a name of :data:`NAMED`, a line, a TOML file, or units by the agent's name."""


def partition_line(agents: Agents) -> str:
    """A partition as one line: a name of :data:`NAMED`, or agents with their units.

    Whether all units are there, and each once, is checked where the world is known (``agent_views``).

    Raises:
        BidexError: A file that cannot be read, or what names no agents.
    """
    if isinstance(agents, Mapping):
        return _line(agents, "agents")
    text = str(agents)
    if text.endswith(".toml"):
        return _line(_read(Path(text).expanduser()), text)
    if text in NAMED:
        return text
    return _line(units_by_agent(text), "agents")


def units_by_agent(line: str) -> dict[str, list[str]]:
    """The units of each agent in a line ``name=unit+unit;name=unit``.

    Raises:
        BidexError: Another text, or an agent twice.
    """
    found: dict[str, list[str]] = {}
    for part in line.split(";"):
        name, equals, units = (each.strip() for each in part.partition("="))
        if not equals or not name or name in found:
            why = f"{name} twice" if name in found else repr(line)
            raise BidexError(
                f"agents: expected {', '.join(NAMED)}, the path of a TOML file, or name=unit+unit;name=unit with each "
                f"agent once, got {why}. Mend it as docs/learners/multiagent.md shows."
            )
        found[name] = [unit.strip() for unit in units.split("+")]
    return found


def _read(file: Path) -> Any:
    """The table ``[agents]`` of a file."""
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise BidexError(f"agents: expected a file at {file}, but {error.strerror or error}. Mend the path.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BidexError(f"{file}: expected TOML in UTF-8, but {error}.") from error
    if list(content) != ["agents"]:
        raise BidexError(f"{file}: expected one table [agents], got {', '.join(content) or 'nothing'}.")
    return content["agents"]


def _line(agents: Any, where: str) -> str:
    """Agents with their units, as one line."""
    example = 'thrower = ["right/palm", "right/thumb"]'
    if not isinstance(agents, Mapping) or not agents:
        raise BidexError(f"{where}: expected at least one agent with its units, got {agents!r}. Add {example}.")
    for name, units in agents.items():
        texts = (
            isinstance(units, list | tuple) and bool(units) and all(isinstance(unit, str) and unit for unit in units)
        )
        if not texts or any(sign in text for text in (name, *units) for sign in ";=+"):
            raise BidexError(f"{where}: {name}: expected a list of units, such as {example}, got {units!r}.")
    return ";".join(f"{name}={'+'.join(units)}" for name, units in agents.items())
