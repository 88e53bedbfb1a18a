"""``bidex-meta data``: list, describe and check data sets."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import Json, print_rows
from bidex_meta.data.dataset import data_folder, dataset_names, open_dataset
from bidex_meta.errors import EXIT_FAILED, BidexError, known_name
from bidex_meta.utils.validation import Few

_ACTIONS = ("list", "info", "check")


@dataclass(frozen=True)
class DataFlags:
    """List data sets; describe one; check one.

    Example: bidex-meta data info CatchUnderarm/random-v0

    They lie in the folder that BIDEX_DATA names, else in data/; a path will do too.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="list|info|check")]
    """list: all, a line each; info: episodes, returns, success and coverage of one; check: every file of one has the
    digest it was written with, every episode is whole and consistent, and its rewards follow from what was observed,
    where that can be computed."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""  # info, check: name or folder.
    episodes: Few | None = None  # check: at most so many episodes, evenly spread; None: all.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Print a table or JSON; exit with code 1 if a check found a fault."""
    flags = parse(DataFlags, arguments, "data")
    what = known_name("data command", flags.what, _ACTIONS)
    if (what == "list") == bool(flags.name):
        if flags.name:
            mend = "takes no name"
        else:
            mend = "needs the name of a data set (see bidex-meta data list)"
        raise BidexError(f"bidex-meta data {what} {mend}.")
    if flags.episodes is not None and what != "check":
        raise BidexError(f"--episodes goes with check, not with {what}. Leave it out.")
    {"list": _list, "info": _info, "check": _check}[what](flags)


def _list(flags: DataFlags) -> None:
    rows: list[Json] = []
    for name in dataset_names():
        try:
            dataset = open_dataset(data_folder() / name)
        except BidexError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        about = dataset.metadata
        sizes = {"transitions": dataset.num_steps, "episodes": dataset.num_episodes}
        what = {"name": name, "kind": about.get("kind"), "source": about.get("suite") or about.get("task")}
        rows.append({**what, **sizes, "megabytes": dataset.content.get("dataset_size")})
    none = f"No data sets in {data_folder()}. Record one: bidex-meta record random --task CatchUnderarm"
    print_rows(rows, flags.json, none)


def _info(flags: DataFlags) -> None:
    from bidex_meta.data.checking import coverage, summary

    dataset = open_dataset(flags.name)
    classes = summary(dataset)
    spread = coverage(dataset)
    about = {name: value for name, value in dataset.metadata.items() if name != "observation_groups"}
    sizes = {"observations": dataset.observation_size, "actions": dataset.action_size}
    if flags.json:
        totals = {"name": dataset.name, "transitions": dataset.num_steps, "episodes": dataset.num_episodes, **sizes}
        content = {**totals, "classes": [asdict(each) for each in classes], "coverage": spread, **about}
        print(json.dumps(content, indent=2))
        return
    policies = about.get("policies", [])
    left_out = about.get("left_out", {})
    acted = ", ".join(f"{policy.get('algo') or 'uniform'} ({policy.get('actions')} actions)" for policy in policies)
    left = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in left_out.items() if count)
    episodes = f"{dataset.num_steps:,} transitions, {dataset.num_episodes:,} episodes"
    print(f"{dataset.name}: {about['kind']} data of {about.get('suite') or about.get('task') or 'elsewhere'}")
    print(f"{episodes}; {sizes}; commit {about.get('commit')}")
    print(f"Acted: {acted or 'unknown'}. Left out: {left or 'nothing'}.")
    rows = []
    for slot in classes:
        score = "–" if slot.score is None else f"{slot.score:.1f}"
        rows.append(
            {
                "class": slot.name,
                "episodes": slot.episodes,
                "transitions": slot.steps,
                "length": f"{slot.length:.1f}",
                "return: least, median, mean, largest": " ".join(f"{value:.4g}" for value in slot.returns),
                "success": f"{100 * slot.success:.1f} %",
                "score": score,
                "tasks": slot.tasks,
                "broken": slot.broken,
            }
        )
    print_rows(rows, as_json=False)
    groups = ", ".join(f"{name} {value:.3g}" for name, value in spread["observation_std"].items())
    print(f"Spread (standard deviation over states, mean over entries): {groups}")
    at_bounds = f"{100 * spread['action_at_bounds']:.1f} % at a bound"
    print(f"Actions: standard deviation {spread['action_std']:.3g}, {at_bounds}")


def _check(flags: DataFlags) -> None:
    from bidex_meta.data.checking import verify

    findings = verify(open_dataset(flags.name), flags.episodes)
    if flags.json:
        print(json.dumps(asdict(findings), indent=2))
    else:
        print(f"{findings.episodes:,} episodes of {findings.steps:,} transitions checked, {findings.count:,} wrong.")
        for name, count in findings.recomputed.items():
            print(f"{name}: {count:,} rewards computed again, largest difference {findings.largest[name]:.2g}")
        for name, reason in findings.skipped.items():
            print(f"{name}: rewards not computed again: {reason}")
        if findings.unsealed:
            print(f"Files without a digest, from elsewhere: {len(findings.unsealed):,}.")
        for line in findings.wrong:
            print(line)
    if findings.count:
        raise SystemExit(EXIT_FAILED)
