"""``bidex-meta data``: list, describe and check data sets."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import print_rows
from bidex_meta.data.checking import verify
from bidex_meta.data.dataset import data_folder, open_dataset
from bidex_meta.errors import EXIT_FAILED, BidexError, known_name
from bidex_meta.experiments import data_tables
from bidex_meta.utils.validation import Few

_ACTIONS = ("list", "info", "check")


@dataclass(frozen=True)
class DataFlags:
    """List data sets, or describe or check one data set.

    Example: bidex-meta data info CatchUnderarm/random-v0

    Data sets are in the folder that BIDEX_DATA names, otherwise in data/. You can also give a path.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="list|info|check")]
    """list: print all data sets, one per line. info: print episodes, returns, success and coverage of one data set.
    check: test that every file of a data set has its recorded digest, that every episode is whole and consistent, and,
    if rewards can be computed from the observations, that rewards are correct."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = ""
    """With info and check: name or folder of the data set."""
    episodes: Few | None = None
    """With check: maximum number of episodes to check, evenly spread over the data set; None: all."""
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
    rows, errors = data_tables.list_rows()
    for line in errors:
        print(line, file=sys.stderr)
    none = f"No data sets in {data_folder()}. Record one: bidex-meta record random --task CatchUnderarm"
    print_rows(rows, flags.json, none)


def _info(flags: DataFlags) -> None:
    found = data_tables.description(open_dataset(flags.name))
    if flags.json:
        print(json.dumps(found, indent=2))
        return
    print(*data_tables.origin_lines(found), sep="\n")
    print_rows([data_tables.class_row(slot) for slot in found["classes"]], as_json=False)
    print(*data_tables.coverage_lines(found["coverage"]), sep="\n")


def _check(flags: DataFlags) -> None:
    findings = verify(open_dataset(flags.name), flags.episodes)
    if flags.json:
        print(json.dumps(asdict(findings), indent=2))
    else:
        print(*data_tables.findings_lines(findings), sep="\n")
    if findings.count:
        raise SystemExit(EXIT_FAILED)
