"""``bidex-meta sweep``: many runs from one file, so many at a time, resumed where they were stopped."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import EXIT_FAILED, BidexError

if TYPE_CHECKING:
    from bidex_meta.sweep.plan import PlannedRun, Sweep
    from bidex_meta.sweep.states import State


@dataclass(frozen=True)
class SweepFlags:
    """Run all that a file asks for: suites x learners x seeds x overrides. Started again, it goes on where it stopped.

    Example: bidex-meta sweep results/sweeps/multitask.toml --workers 2

    docs/sweeps.md explains the file.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """The sweep."""
    workers: int | None = None
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
    from bidex_meta.sweep.plan import read_sweep
    from bidex_meta.sweep.workers import alone, choose_cores, work

    sweep = read_sweep(flags.file, flags.out)
    cores = choose_cores(flags.cores, flags.workers)
    configs = _configs(sweep, flags.file)
    states = _states(sweep, configs)
    if flags.status:
        _print(states, len(cores))
        return
    left = [state.run for state in states if state.state != "done"]
    if flags.dry_run:
        for run in left:
            print(shlex.join(["bidex-meta", *run.begin]))
        return
    with alone(sweep.out):
        if flags.submit is not None:
            from bidex_meta.sweep.cluster import submit

            unfinished = {run.path for run in left}
            left = [state.run for state in states if state.state in ("left", "failed")]
            later = [run for run in left if run.after in unfinished]
            left = [run for run in left if run not in later]
            for name, job in submit(left, sweep.out, flags.submit, sweep.slurm).items():
                print(f"{name} is job {job.job_id}")
            if later:
                _say(f"{len(later)} start from runs that are not through yet: submit again when those are.")
            return

        def through(run: "PlannedRun") -> bool:
            return _state(run, configs).state == "done"

        _say(f"{len(states) - len(left)} of {len(states)} runs are done; {len(cores)} at a time.")
        failed = work(left, cores, through, lambda text: _say(f"{text}{_rest(sweep, configs, len(cores))}"))
    _print(_states(sweep, configs), len(cores))
    if failed:
        _say(f"{failed} failed. Started again, the sweep tries them anew.")
        raise SystemExit(EXIT_FAILED)


def _configs(sweep: "Sweep", file: Path) -> dict[tuple[str, ...], dict[str, Any]]:
    """The resolved config of each kind of run, by its words: seeds share it.

    Raises:
        BidexError: `bidex-meta run` would refuse one.
    """
    from bidex_meta.commands.run_config import plan_run

    configs: dict[tuple[str, ...], dict[str, Any]] = {}
    for run in sweep.runs:
        if run.words in configs:
            continue
        try:
            configs[run.words] = plan_run(run.begin[1:]).config
        except BidexError as error:
            raise BidexError(f"{file}: {run.arm} on {run.subject}: {error}") from None
    return configs


def _state(run: "PlannedRun", configs: dict[tuple[str, ...], dict[str, Any]]) -> "State":
    from bidex_meta.sweep.states import state_of

    return state_of(run, configs[run.words])


def _states(sweep: "Sweep", configs: dict[tuple[str, ...], dict[str, Any]]) -> "list[State]":
    return [_state(run, configs) for run in sweep.runs]


def _rest(sweep: "Sweep", configs: dict[tuple[str, ...], dict[str, Any]], workers: int) -> str:
    """What is still to do, for the end of a line."""
    from bidex_meta.sweep.states import seconds_left, span

    states = _states(sweep, configs)
    done = sum(state.state == "done" for state in states)
    seconds = span(seconds_left(states), workers)
    return f" ({done} of {len(states)} done" + (f"; about {seconds / 3600:.2g} h left)" if seconds else ")")


def _print(states: "Sequence[State]", workers: int) -> None:
    from bidex_meta.commands.tables import plain_table, print_table
    from bidex_meta.sweep.states import seconds_left, span

    left, rows = seconds_left(states), []
    for state, seconds in zip(states, left, strict=True):
        goal = f"{state.goal:,}" if state.minutes is None else f"{state.minutes:g} min"
        speed = "–" if state.speed is None else f"{state.speed:,.0f}"
        hours = "–" if seconds is None else f"{seconds / 3600:.2f}"
        rows.append([state.run.name, state.state, f"{state.step:,}", goal, speed, hours, state.why[:120]])
    print_table(plain_table(["run", "state", "steps", "of", "steps/s", "hours left", "why"], rows))
    counts = {name: sum(state.state == name for state in states) for name in ("done", "runs", "failed", "left")}
    unknown = sum(seconds is None for seconds in left)
    print(
        ", ".join(f"{count} {name}" for name, count in counts.items())
        + f"; about {span(left, workers) / 3600:.2f} h of training left, {workers} at a time"
        + (f" (without {unknown} of unknown speed)" if unknown else "")
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
