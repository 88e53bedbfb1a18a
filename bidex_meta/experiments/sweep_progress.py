"""The progress of a sweep's runs, read from their folders."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Literal, NamedTuple

from bidex_meta.errors import BidexError, one_line
from bidex_meta.experiments import metatest
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.run_config import check, resolve
from bidex_meta.experiments.sweep_plan import PlannedRun, SweepPlan
from bidex_meta.runs.evaluations import Evaluated, MetaTestEvaluation, SplitSummary
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.metrics import last_rows
from bidex_meta.suite import OTHERS
from bidex_meta.utils.files import JsonObject, absolute, exists, is_file
from bidex_meta.worlds import Worlds, open_worlds


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
        kind = str((replace(run.given, seed=0, start_from=None), run.final))
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
    """Return the progress of a run with resolved config.

    Raises BidexError if its folder has a run with another config, or one that has trained for more steps.
    """
    last: JsonObject = {"step": 0}
    evaluated = False
    stored = run.config
    if exists(run.folder.config_path):
        stored = run.folder.config()
        # Threads and device are ignored, because the machine may have changed.
        for name, there, here in stored.differences(run.config, ignored=("threads", "device")):
            raise BidexError(
                f"{run.path} is a run with another config: its {name} is {there}, not {here}. Give the arm another "
                "name, or move the folder away."
            )
        if is_file(run.folder.metrics_path):
            last = (last_rows(run.folder.metrics_path) or [last])[-1]
        evaluated = run.folder.evaluated and _played(run, run.folder.evaluation())
        if run.config.steps < min(stored.steps, last["step"]):
            raise BidexError(
                f"{run.path} has trained for {last['step']:,} steps, expected at most {run.config.steps:,}. Give the "
                "arm another name, or move the folder away."
            )
        asked = run.config.evaluate_every
        if evaluated and asked not in (None, stored.evaluate_every):
            raise BidexError(
                f"{run.path} has ended with evaluate_every {stored.evaluate_every}, expected {asked}. Evaluations "
                "during training cannot be made later: leave evaluate_every, or give the arm another name."
            )
    why = last_line(beside(run, "failed"))
    steps = run.config.goal(last)
    limit = run.config.minutes
    if limit is not None and (stored.minutes is None or limit > stored.minutes):
        steps = run.config.steps  # the run was not ended by this time limit
    if locked(run):
        state = "runs"
    elif evaluated and (run.folder.evaluation().steps or steps) >= steps:
        state = "done"
    elif why:
        state = "failed"
    else:
        state = "left"
    return State(run, state, last["step"], steps, last.get("Perf/training_time") or 0.0, why)


def _played(run: PlannedRun, evaluation: Evaluated) -> bool:
    """Return whether a stored evaluation is the one that a sweep asks for; its file may have changed since."""
    final = run.final
    if not isinstance(evaluation, MetaTestEvaluation):
        same_episodes = final.episodes in (None, evaluation.policy.episodes_per_task)
        return same_episodes and (not final.other_tasks or evaluation.other_tasks is not None)
    wanted = {"auto": (), "unseen": ("others", "test")}.get(final.split, (final.split,))
    if not evaluation.splits.keys() >= set(wanted):
        return False
    worlds = open_worlds(run.config.to_json())
    return all(_asked_for(final, part, split, worlds) for split, part in evaluation.splits.items())


def _asked_for(final: FinalEvaluation, part: SplitSummary, split: str, worlds: Worlds) -> bool:
    """Return whether the meta-test on a split has the numbers that a sweep asks for."""
    if final.hidden_rewards and part.hidden_by_shot is None:
        return False
    if split == OTHERS:
        pools = worlds.others.tasks("train")
    else:
        pools = worlds.tasks(split)
    # A meta-test plays fewer tasks or rollouts if there are not enough tasks or environments.
    limits = {"tasks": max(map(len, pools.values())), "rollouts": max(1, metatest.ENVIRONMENTS // len(pools))}
    tasks = next(iter(part.before.classes.values())).tasks
    found = {"tasks": tasks, "rollouts": part.rollouts, "shots": part.shots, "episodes": part.before.episodes_per_task}
    for name, number in found.items():
        asked = getattr(final, name)
        if None not in (asked, number) and number not in (asked, min(asked, limits.get(name, asked))):
            return False
    return True


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
