"""``bidex-meta data``: the data sets there are, what one holds, and whether it is sound."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import EXIT_FAILED, BidexError, known_name
from bidex_meta.validation import Few

_ACTIONS = ("list", "info", "check")


@dataclass(frozen=True)
class DataFlags:
    """The data sets there are; what one holds; whether one is sound.

    Example: bidex-meta data info CatchUnderarm/random-v0

    They lie in the folder that BIDEX_DATA names, else in data/; a path will do too.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="list|info|check")]
    """list: all, a line each; info: episodes, returns, success and coverage of one; check: every file of one has the
    digest it was written with, every episode is whole and consistent, and its rewards follow from what was observed,
    where that can be computed."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""
    """info, check: a data set's name or folder."""
    episodes: Few | None = None
    """check: look at so many episodes at most, evenly spread; None: all."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Print a table or JSON.

    Raises:
        SystemExit: A check found something wrong (exit code 1).
    """
    flags = parse(DataFlags, arguments, "data")
    what = known_name("data command", flags.what, _ACTIONS)
    if (what == "list") == bool(flags.name):
        told = "takes no name" if flags.name else "needs the name of a data set (see bidex-meta data list)"
        raise BidexError(f"bidex-meta data {what} {told}.")
    if flags.episodes is not None and what != "check":
        raise BidexError(f"--episodes goes with check, not with {what}. Leave it out.")
    if what == "list":
        _list(flags)
    elif what == "info":
        _info(flags)
    else:
        _check(flags)


def _list(flags: DataFlags) -> None:
    from bidex_meta.data import open_dataset
    from bidex_meta.data.dataset import data_folder, dataset_names

    rows = []
    for name in dataset_names():
        try:
            found = open_dataset(data_folder() / name)
        except BidexError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        about = found.metadata
        rows.append(
            {
                "name": name,
                "kind": about.get("kind"),
                "source": about.get("suite") or about.get("task"),
                "transitions": found.num_steps,
                "episodes": found.num_episodes,
                "megabytes": found.content.get("dataset_size"),
            }
        )
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    _print_rows(rows, f"No data sets in {data_folder()}. Record one: bidex-meta record random --task CatchUnderarm")


def _info(flags: DataFlags) -> None:
    from bidex_meta.data import open_dataset
    from bidex_meta.data.summary import coverage, summary

    dataset = open_dataset(flags.name)
    classes, spread = summary(dataset), coverage(dataset)
    about = {name: value for name, value in dataset.metadata.items() if name != "observation_groups"}
    sizes = {"observations": dataset.observation_size, "actions": dataset.action_size}
    if flags.json:
        told = {"name": dataset.name, "transitions": dataset.num_steps, "episodes": dataset.num_episodes, **sizes}
        print(
            json.dumps({**told, "classes": [asdict(each) for each in classes], "coverage": spread, **about}, indent=2)
        )
        return
    who = ", ".join(
        f"{each.get('algo') or 'uniform'} ({each.get('actions')} actions)" for each in about.get("policies", [])
    )
    left = ", ".join(
        f"{count:,} {name.replace('_', ' ')}" for name, count in about.get("left_out", {}).items() if count
    )
    print(f"{dataset.name}: {about['kind']} data of {about.get('suite') or about.get('task') or 'elsewhere'}")
    print(
        f"{dataset.num_steps:,} transitions, {dataset.num_episodes:,} episodes; {sizes}; commit {about.get('commit')}"
    )
    print(f"Acted: {who or 'unknown'}. Left out: {left or 'nothing'}.")
    _print_rows(
        [
            {
                "class": each.name,
                "episodes": each.episodes,
                "transitions": each.steps,
                "length": f"{each.length:.1f}",
                "return: least, median, mean, largest": " ".join(f"{value:.4g}" for value in each.returns),
                "success": f"{100 * each.success:.1f} %",
                "score": "–" if each.score is None else f"{each.score:.1f}",
                "tasks": each.tasks,
                "broken": each.broken,
            }
            for each in classes
        ]
    )
    groups = ", ".join(f"{name} {value:.3g}" for name, value in spread["observation_std"].items())
    print(f"Spread (standard deviation over states, mean over entries): {groups}")
    print(
        f"Actions: standard deviation {spread['action_std']:.3g}, {100 * spread['action_at_bounds']:.1f} % at a bound"
    )


def _check(flags: DataFlags) -> None:
    from bidex_meta.data import open_dataset
    from bidex_meta.data.checking import verify

    found = verify(open_dataset(flags.name), flags.episodes)
    if flags.json:
        print(json.dumps(asdict(found), indent=2))
    else:
        print(f"{found.episodes:,} episodes of {found.steps:,} transitions looked at, {found.count:,} wrong.")
        for name, count in found.recomputed.items():
            print(f"{name}: {count:,} rewards computed again, largest difference {found.largest[name]:.2g}")
        for name, reason in found.skipped.items():
            print(f"{name}: rewards not computed again: {reason}")
        if found.unsealed:
            print(f"Without a digest, since written elsewhere or by an older version: {len(found.unsealed):,} files.")
        for line in found.wrong:
            print(line)
    if found.count:
        raise SystemExit(EXIT_FAILED)


def _print_rows(rows: list[dict[str, Any]], otherwise: str = "Nothing.") -> None:
    from bidex_meta.commands.tables import plain_table, print_table

    if not rows:
        print(otherwise)
        return
    print_table(plain_table(list(rows[0]), [list(row.values()) for row in rows]))
