"""``bidex-meta sweep``: many runs from one file, so many at a time, resumed where they were stopped."""

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.config import RunConfig
from bidex_meta.errors import EXIT_FAILED, BidexError
from bidex_meta.utils.validation import Few

if TYPE_CHECKING:
    from bidex_meta.sweep.plan import Sweep
    from bidex_meta.sweep.queue import State


@dataclass(frozen=True)
class SweepFlags:
    """Run all that a file asks for: suites x learners x seeds x overrides. Started again, it goes on where it stopped.

    Example: bidex-meta sweep results/sweeps/multitask.toml --workers 2

    docs/sweeps.md explains the file.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """The sweep."""
    workers: Few | None = None
    """Runs at a time, each on a core of its own; None: one, or one for each of --cores."""
    cores: str | None = None
    """Cores that runs are bound to (Linux), such as 1 or 0,2-3; None: the first of those there are."""
    out: Path = Path("runs")
    """Where the sweep's folder lies: its runs are OUT/NAME/SUITE-ARM-seedN."""
    status: Switch = False
    """Print what is done, what runs, what is left and how long it takes, and stop."""
    dry_run: Switch = False
    """Check the file, print the commands of what is left, and stop."""
    submit: Literal["slurm", "local"] | None = None
    """Hand the runs to a cluster by submitit (extra slurm), with the parameters of the file's [slurm], instead of
    running them; local: submitit's executor on this machine."""


def main(arguments: Sequence[str]) -> None:
    """Check everything, then run it.

    Raises:
        BidexError: A bad file, a run that `bidex-meta run` would refuse, or a folder with a run of another config.
        SystemExit: A run has failed (exit code 1).
    """
    flags = parse(SweepFlags, arguments, "sweep")
    from bidex_meta.runs import RunFolder
    from bidex_meta.sweep.plan import read_sweep
    from bidex_meta.sweep.queue import choose_cores, state_of, submit, work

    sweep = read_sweep(flags.file, flags.out)
    cores = choose_cores(flags.cores, flags.workers)
    configs = _configs(sweep, flags.file)
    runs = [replace(run, config=configs[run.words]) for run in sweep.runs]
    states = [state_of(run) for run in runs]
    if flags.status:
        _print(states)
        return
    left = [each.run for each in states if each.state != "done"]
    if flags.dry_run:
        for run in left:
            print(shlex.join(["bidex-meta", *run.begin]))
        return
    sweep.out.mkdir(parents=True, exist_ok=True)
    with RunFolder(sweep.out).locked(f"Another sweep works in {sweep.out}. Wait for its end, or stop it."):
        if flags.submit is not None:
            unfinished = {run.path for run in left}
            idle = [each.run for each in states if each.state in ("left", "failed")]
            ready = [run for run in idle if run.after not in unfinished]
            for name, job in submit(ready, sweep.out, flags.submit, sweep.slurm).items():
                print(f"{name} is job {job.job_id}")
            if len(ready) < len(idle):
                _say(f"{len(idle) - len(ready)} start from runs that have not ended: submit again when those have.")
            return
        _say(f"{len(states) - len(left)} of {len(states)} runs are done; {len(cores)} at a time.")
        failed = work(left, cores, _say)
    _print([state_of(run) for run in runs])
    if failed:
        _say(f"{failed} failed. Started again, the sweep tries them anew.")
        raise SystemExit(EXIT_FAILED)


def _configs(sweep: "Sweep", file: Path) -> dict[tuple[str, ...], RunConfig[Any]]:
    """The resolved config of each kind of run, by its words: seeds share it.

    Raises:
        BidexError: `bidex-meta run` would refuse one.
    """
    from bidex_meta.cli.run_config import plan_run

    configs: dict[tuple[str, ...], RunConfig[Any]] = {}
    for run in sweep.runs:
        try:
            configs[run.words] = configs.get(run.words) or plan_run(run.begin[1:]).config
        except BidexError as error:
            raise BidexError(f"{file}: {run.arm} on {run.subject}: {error}") from None
    return configs


def _print(states: "Sequence[State]") -> None:
    """A line a run; hours left by its own speed, else by the mean on its suite, else by that of all."""
    from bidex_meta.cli.tables import plain_table, print_table

    speeds, rows, total = [(each.run.subject, each.speed) for each in states if each.speed], [], 0.0
    for each in states:
        alike = [speed for subject, speed in speeds if subject == each.run.subject] or [speed for _, speed in speeds]
        speed = each.speed or (mean(alike) if alike else math.nan)
        seconds = (each.goal - each.step) / speed if each.minutes is None else 60 * each.minutes - each.seconds
        hours = 0.0 if each.state == "done" else max(seconds / 3600, 0.0)
        total += hours
        goal = f"{each.goal:,}" if each.minutes is None else f"{each.minutes:g} min"
        cells = [f"{each.step:,}", goal, f"{each.speed:,.0f}", "–" if math.isnan(hours) else f"{hours:.2f}"]
        rows.append([each.run.name, each.state, *cells, each.why[:120] if each.state == "failed" else ""])
    print_table(plain_table(["run", "state", "steps", "of", "steps/s", "hours left", "why"], rows))
    names = [each.state for each in states]
    counts = ", ".join(f"{names.count(name)} {name}" for name in ("done", "runs", "failed", "left"))
    print(counts + ("" if math.isnan(total) else f"; about {total:.2f} core-hours of training left"))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
