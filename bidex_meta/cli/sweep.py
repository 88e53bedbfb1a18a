"""``bidex-meta sweep``: start many runs from one file, several at a time, and resume stopped runs."""

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.cli.tables import NONE, plain_table, print_table
from bidex_meta.errors import EXIT_FAILED
from bidex_meta.experiments.sweep_plan import SweepPlan
from bidex_meta.experiments.sweep_progress import State, hours_left, states_of
from bidex_meta.experiments.sweeping import submit_plan, sweep
from bidex_meta.training.launch import say
from bidex_meta.utils.validation import Few


@dataclass(frozen=True)
class SweepFlags:
    """Start the runs that a file describes: all combinations of suites, learners, seeds and changed settings.

    Example: bidex-meta sweep results/sweeps/multitask.toml --workers 2

    Run the command again to continue the sweep. docs/sweeps.md explains the file.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """TOML file that lists the runs (docs/sweeps.md)."""
    workers: Few | None = None
    """Number of runs at a time, each on its own core. None: one run, or one run per core in --cores."""
    cores: str | None = None
    """Cores that the runs are bound to (Linux only), such as 1 or 0,2-3. None: the first available cores."""
    out: Path = Path("runs")  # Parent of the sweep's folder; its runs are OUT/NAME/SUITE-ARM-seedN.
    status: Switch = False  # Print which runs are done, running and left and how long they take, then exit.
    dry_run: Switch = False  # Check the file, print the commands of the runs that are left, and exit.
    submit: Literal["slurm", "local"] | None = None
    """Submit the runs to a cluster through submitit (extra slurm), with the parameters of the file's [slurm] table.
    slurm: the cluster; local: submitit's executor on this machine."""


def main(arguments: Sequence[str]) -> None:
    """Check everything, then run the sweep; exit with code 1 if a run has failed."""
    flags = parse(SweepFlags, arguments, "sweep")
    plan = SweepPlan.read(flags.file, flags.out)
    if flags.status:
        _print(states_of(plan))
    elif flags.dry_run:
        for state in states_of(plan):
            if state.state != "done":
                print(shlex.join(["bidex-meta", *state.run.begin]))
    elif flags.submit is not None:
        for name, job in submit_plan(plan, flags.submit).items():
            print(f"{name} is job {job}")
    else:
        result = sweep(plan, workers=flags.workers, cores=flags.cores)
        _print(result.states)
        if result.failures:
            say(f"{result.failures} failed or were stopped. Start the sweep again to go on with them.")
            raise SystemExit(EXIT_FAILED)


def _print(states: Sequence[State]) -> None:
    """Print a line per run, and how many hours of training are left."""
    hours = hours_left(states)
    rows = []
    for state, left in zip(states, hours, strict=True):
        minutes = state.run.config.minutes
        goal = f"{state.goal:,}" if minutes is None else f"{minutes:g} min"
        cells = [f"{state.step:,}", goal, f"{state.speed:,.0f}", NONE if math.isnan(left) else f"{left:.2f}"]
        rows.append([state.run.name, state.state, *cells, state.why[:120] if state.state == "failed" else ""])
    headers = ["run", "state", "steps", "of", "steps/s", "hours left", "why"]
    print_table(plain_table(headers, rows, spare=("steps/s", "of", "steps")))
    names = [state.state for state in states]
    counts = ", ".join(f"{names.count(name)} {name}" for name in ("done", "runs", "failed", "left"))
    total = sum(hours)
    print(counts + ("" if math.isnan(total) else f"; about {total:.2f} core-hours of training left"))
