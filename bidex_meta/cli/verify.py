"""``bidex-meta verify``: test if a run's checkpoint still reproduces its recorded evaluation."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import Engine, JsonSwitch, RunPath, parse
from bidex_meta.cli.tables import Sheet, percent, print_table, ranged
from bidex_meta.errors import EXIT_FAILED
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, Agreement
from bidex_meta.experiments.verifying import verify
from bidex_meta.utils.validation import Environments


@dataclass(frozen=True)
class VerifyFlags:
    """Repeat the recorded evaluation of a run's checkpoint, and compare the two evaluations class by class.

    Example: bidex-meta verify runs/MT4/mtppo/2026-11-21_10-00-00_seed0

    The exit code is 0 if all is equal bit for bit or within the intervals, and 1 if something differs.
    """

    run: RunPath  # Folder of the run to verify.
    evaluation: Path | None = None
    """Output of `bidex-meta evaluate --json` for this run to compare with; None: the run's evaluation.json."""
    device: str = "auto"
    """Device: auto, cpu or cuda:N. auto: the device of the recorded evaluation if it is available, otherwise the
    CPU."""
    engine: Engine | None = None
    """Physics engine: auto, c or warp. None: as in the recorded evaluation; on another device auto."""
    num_envs: Environments | None = None  # Environments stepped together; None: as in the recorded evaluation.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Verify a run and print a table or JSON; return exit code 1 if something differs."""
    flags = parse(VerifyFlags, arguments, "verify")
    found = verify(
        flags.run, evaluation=flags.evaluation, device=flags.device, engine=flags.engine, num_envs=flags.num_envs
    )
    if flags.json:
        print(json.dumps(found.to_json(), indent=2))
    else:
        _print_table(f"{found.title}, recorded and again", found.classes)
        verdict = f"{found.count(EQUAL)} equal bit for bit, {found.count(WITHIN)} within, {found.count(DIFFERS)} differ"
        if found.agrees:
            end = ""
        else:
            end = ": this run is not what its evaluation says"
        print(f"{len(found.classes)} classes: {verdict}{end}")
        print(f"Not verified: {', '.join(found.unverified)}.")
    if not found.agrees:
        raise SystemExit(EXIT_FAILED)


def _print_table(title: str, found: Sequence[Agreement]) -> None:
    """Print a table with one row per class."""
    caption = "within: apart by no more than both 95 % intervals allow, over all classes together"
    table = Sheet(["task", "outcome", "success", "again", "return [95 %]", "return again [95 %]"], title, caption)
    for each in found:
        both = each.recorded, each.again
        cells = [each.name, each.outcome, *(percent(row.success) for row in both)]
        cells += [ranged(row.mean_return, row.return_interval) for row in both]
        table.add(*cells, style="bold red" if each.outcome == DIFFERS else "")
    print_table(table)
