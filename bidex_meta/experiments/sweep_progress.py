"""The progress of a sweep's runs, read from their folders."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Literal, NamedTuple

from bidex_meta.errors import BidexError, one_line
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.run_config import check, resolve
from bidex_meta.experiments.sweep_plan import PlannedRun, SweepPlan
from bidex_meta.runs.evaluations import Evaluated, MetaTestEvaluation
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.metrics import last_rows
from bidex_meta.utils.files import JsonObject, absolute, exists, is_file


class State(NamedTuple):
    """Progress of one run of a sweep."""

    run: PlannedRun
    state: Literal["done", "runs", "failed", "left"]
    step: int
    """Environment steps that were logged."""
    goal: int
    """Environment steps to train for; if time, a return or a score ended the run, the steps that it reached."""
    seconds: float
    """Seconds of training so far."""
    why: str
    """The last line of the run's log if the run failed when it was last begun or resumed."""

    @property
    def speed(self) -> float:
        """Return the measured steps per second; 0 before the first line of metrics."""
        if self.seconds:
            return self.step / self.seconds
        return 0.0


def states_of(plan: SweepPlan) -> list[State]:
    """Resolve and check the configs of all runs, and return the runs' progress.

    Raises BidexError for bad values, and if a run's folder has a run with another config.
    """
    configs: dict[str, AnyConfig] = {}  # runs that differ only in the seed share a config
    runs = []
    for run in plan.runs:
        kind = str(replace(run.given, seed=0, start_from=None))
        if kind not in configs:
            try:
                configs[kind] = _resolved(run)
            except BidexError as error:
                raise BidexError(f"{plan.source}: {run.arm} on {run.subject}: {error}") from None
        start = None if run.after is None else str(absolute(run.after))
        runs.append(replace(run, config=replace(configs[kind], seed=run.seed, start_from=start)))
    return [state_of(run) for run in runs]


def _resolved(run: PlannedRun) -> AnyConfig:
    config = resolve(run.given)
    check(config)
    run.final.check(config)
    return config


def state_of(run: PlannedRun) -> State:
    """Return the progress of a run with resolved config; raise BidexError if its folder has another config."""
    last: JsonObject = {"step": 0}
    evaluated = False
    if exists(run.folder.config_path):
        # Threads and device are ignored, because the machine may have changed.
        for name, there, here in run.folder.config().differences(run.config, ignored=("threads", "device")):
            raise BidexError(
                f"{run.path} is a run with another config: its {name} is {there}, not {here}. Give the arm another "
                "name, or move the folder away."
            )
        if is_file(run.folder.metrics_path):
            last = (last_rows(run.folder.metrics_path) or [last])[-1]
        evaluated = run.folder.evaluated and _played(run.final, run.folder.evaluation())
    why = last_line(beside(run, "failed"))
    steps = run.config.goal(last)
    if locked(run):
        state = "runs"
    elif evaluated and (run.folder.evaluation().steps or steps) >= steps:
        state = "done"
    elif why:
        state = "failed"
    else:
        state = "left"
    return State(run, state, last["step"], steps, last.get("Perf/training_time") or 0.0, why)


def _played(final: FinalEvaluation, evaluation: Evaluated) -> bool:
    """Return whether a stored evaluation has all parts that a sweep asks for; its file may have changed since."""
    if not isinstance(evaluation, MetaTestEvaluation):
        return not final.other_tasks or evaluation.other_tasks is not None
    wanted = {"auto": (), "unseen": ("others", "test")}.get(final.split, (final.split,))
    if not evaluation.splits.keys() >= set(wanted):
        return False
    parts = evaluation.splits.values()
    same_shots = final.shots is None or all(part.shots == final.shots for part in parts)
    return same_shots and (not final.hidden_rewards or all(part.hidden_by_shot is not None for part in parts))


def hours_left(states: Sequence[State]) -> list[float]:
    """Return the hours that each run still has to train, or NaN if no run has a known speed.

    The assumed speed is the run's own speed if known, otherwise the mean over the runs on its suite, otherwise the mean
    over all runs.
    """
    speeds = [(state.run.subject, state.speed) for state in states if state.speed]
    hours = []
    for state in states:
        minutes = state.run.config.minutes
        alike = [speed for subject, speed in speeds if subject == state.run.subject] or [speed for _, speed in speeds]
        if state.state == "done":
            seconds = 0.0
        elif minutes is not None:
            seconds = max(60 * minutes - state.seconds, 0.0)
        elif alike:
            seconds = max((state.goal - state.step) / (state.speed or mean(alike)), 0.0)
        else:
            seconds = math.nan
        hours.append(seconds / 3600)
    return hours


def locked(run: PlannedRun) -> bool:
    """Return whether a process trains in a run's folder."""
    try:
        with run.folder.locked():
            return False
    except FileNotFoundError:
        return False
    except BidexError:
        return True


def beside(run: PlannedRun, kind: str) -> Path:
    """Return the path of a file next to a run's folder: ``log`` (output), ``failed`` (last error) or ``job`` (id)."""
    return run.path.with_name(f"{run.name}.{kind}")


def last_line(path: Path) -> str:
    """Return the last line of a text file that is not blank; return an empty string if there is none."""
    if is_file(path):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    else:
        lines = []
    return next((one_line(line) for line in reversed(lines) if line.strip()), "")
