"""Measure how much the policy of a run helps on unseen classes.

Training that starts from the policy is compared with training from scratch: by reinforcement learning, and from a few
demonstrations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bidex_meta.config import RunConfig
from bidex_meta.data import part_files
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.transfer_measures import TAG, add_over_nothing, at_the_end, by_reinforcement
from bidex_meta.experiments.conditions import say_differences
from bidex_meta.experiments.evaluating import USUAL_EVALUATION, FinalEvaluation
from bidex_meta.experiments.policies import say_other_rules
from bidex_meta.experiments.run_config import check, resolve
from bidex_meta.experiments.sweep_progress import state_of
from bidex_meta.experiments.sweeping import choose_cores, work
from bidex_meta.experiments.transfer_plan import Arm, Cell, arms_of, cells_of, demonstrations_of, held_out, suite_file
from bidex_meta.runs import RunFolder, plots
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.provenance import check_alike
from bidex_meta.runs.versions import collect_versions
from bidex_meta.training.launch import say
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import JsonObject, portable
from bidex_meta.utils.validation import Few, Whole
from bidex_meta.worlds import Worlds, open_worlds

USUAL_RUN: RunConfig = RunConfig(
    algo="ppo", preset="laptop", logger="none", num_envs=256, learner={"demonstration_cloning": 5000}
)
"""Default config of the runs of a transfer; the transfer sets suite, seed, steps, initial policy and network."""


@dataclass(frozen=True)
class TransferResult:
    """The result of :func:`transfer`, as ``transfer.json`` holds it."""

    folder: Path
    """The folder of the runs, ``transfer.json`` and the figures."""
    reinforcement: tuple[JsonObject, ...]
    """A row per class and initial policy, for runs that learned by reinforcement."""
    demonstrations: tuple[JsonObject, ...]
    """A row per class, initial policy and number of demonstrations, for runs that learned from demonstrations."""
    failures: int
    """Runs that failed or were stopped in this call; the rows leave them out."""


@checked_arguments
def transfer(
    run: RunFolder | str | Path,
    out: str | Path,
    *,
    start_from: Sequence[str | Path] = (),
    classes: Sequence[str] = (),
    steps: Whole = 1_000_000,
    demonstrations: Sequence[Whole] = (0, 1, 5, 25),
    data: Sequence[str] = (),
    seeds: Few = 3,
    config: RunConfig = USUAL_RUN,
    final: FinalEvaluation = USUAL_EVALUATION,
    workers: Few | None = None,
    cores: str | None = None,
) -> TransferResult:
    """Train on held-out classes from a run's policy and from scratch, and compare the two.

    A call after an interruption continues where the last call stopped.

    Args:
        run: A run on a suite with held-out classes, whose policy is measured.
        out: The folder of the runs, the tables and the figures.
        start_from: Further runs whose policies training also starts from; their observations must have the same
            form.
        classes: Held-out classes; empty: all held-out classes of the run's suite.
        steps: Environment steps of each run that trains by reinforcement learning; 0: no such runs.
        demonstrations: Numbers of demonstrated episodes that runs learn from; empty: no such runs.
        data: Data sets of demonstrations. For other classes, the class's scripted policy records demonstrations.
        seeds: Number of runs of each kind; their seeds are 0, 1, ...
        config: The config of every run, whose learner is ``ppo``; ``transfer`` sets suite, seed, steps and
            initial policy.
        final: The evaluation at the end of every run.
        workers: Number of simultaneous runs, each on its own core; None: 1, or one for each of ``cores``.
        cores: Cores that runs are bound to (Linux), such as ``1`` or ``0,2-3``; None: the first cores.

    Raises BidexError for bad input, before anything is written. A run that fails is logged and counted in the result.
    """
    measured = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    others = [RunFolder.open(path) for path in start_from]
    arms = arms_of([measured, *others])
    for folder in (measured, *others):
        say_differences(folder)
    worlds = open_worlds(measured.config().to_json())
    for folder in others:
        say_other_rules(folder, worlds)
    names = held_out(worlds, classes)
    chosen = choose_cores(cores, workers)
    planned = _planned(config, final, measured)
    if any(demonstrations):
        part_files.hdf5()
    out = Path(out)
    check_writable(out / "transfer.json")
    out.mkdir(parents=True, exist_ok=True)
    with RunFolder(out).locked(f"Another transfer works in {out}. Wait for its end, or stop it."):
        cells = _cells(planned, final, worlds, names, arms, out, steps, sorted({*demonstrations}), data, seeds)
        left = [cell.run for cell in cells if state_of(cell.run).state != "done"]
        say(f"{len(cells) - len(left)} of {len(cells)} runs are done; {len(chosen)} at a time.")
        failures = work(left, chosen)
    by_steps, by_demonstrations = _rows(cells, steps)
    made = {"run": portable(str(measured.path)), "suite": portable(worlds.name), "steps": steps}
    made |= {"versions": collect_versions()}
    write_json(out / "transfer.json", made | {"reinforcement": by_steps, "demonstrations": by_demonstrations})
    _draw(out, by_steps, by_demonstrations)
    return TransferResult(out, tuple(by_steps), tuple(by_demonstrations), failures)


_EARLY = ("minutes", "stop_at_return", "stop_at_success", "stop_at_score")
"""Entries of a config that may end a run before its steps are done."""


def _planned(config: AnyConfig, final: FinalEvaluation, measured: RunFolder) -> AnyConfig:
    """Return the resolved config of all runs, on the suite of the run that is measured."""
    if config.algo != USUAL_RUN.algo:
        raise BidexError(f"transfer: config: expected the learner {USUAL_RUN.algo}, got {config.algo}.")
    for name in _EARLY:
        if getattr(config, name) is not None:
            raise BidexError(
                f"transfer: {name}: expected none, got {getattr(config, name)}, because curves are compared over the "
                "same number of steps. Leave it out; --steps limits a run."
            )
    planned = resolve(replace(config, suite=measured.config().suite, task=None, threads=1))
    check(planned)
    final.check(planned)
    return planned


def _cells(
    config: AnyConfig, final: FinalEvaluation, worlds: Worlds, classes: Sequence[str], arms: Sequence[Arm], out: Path,
    steps: int, counts: Sequence[int], data: Sequence[str], seeds: int
) -> list[Cell]:  # fmt: skip
    """Prepare a transfer experiment and return all its runs, ordered by seed.

    This writes a suite file for each class. It also records the demonstrations that are missing.
    """
    for folder in ("suites", "data", "runs"):
        (out / folder).mkdir(exist_ok=True)
    files = {name: suite_file(worlds, name, out / "suites") for name in classes}
    datasets = {}
    for name, file in files.items():
        if any(counts):
            datasets[name] = demonstrations_of(file, name, data, out / "data", counts[-1])
            if datasets[name] is None:
                say(f"{name} has no script: it is not learned from demonstrations. Give some by --data.")
    cells = []
    for seed in range(seeds):
        of_seed = replace(config, seed=seed)
        for name, file in files.items():
            cells += cells_of(of_seed, final, file, name, arms, out, steps, counts, datasets.get(name))
    return cells


def _rows(cells: Sequence[Cell], steps: int) -> tuple[list[JsonObject], list[JsonObject]]:
    """Return the rows of ``transfer.json`` for runs that are finished.

    The first list is for reinforcement learning and has a row per class and initial policy. The second list is for
    learning from demonstrations and has a row per class, initial policy and number of demonstrations.
    """
    groups: dict[tuple[str, str, int | None], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.task, cell.arm, cell.demonstrations), []).append(cell)
    by_steps: list[JsonObject] = []
    by_demonstrations: list[JsonObject] = []
    for (task, arm, count), members in groups.items():
        done = [cell.run for cell in members if state_of(cell.run).state == "done"]
        row = {"class": task, "from": arm, "seeds": [run.seed for run in done]}
        folders = [run.folder for run in done]
        check_alike(folders)
        if not done:
            continue
        if count is None:
            by_steps.append(row | by_reinforcement(folders, steps))
        else:
            by_demonstrations.append(row | {"demonstrations": count} | at_the_end(folders))
    add_over_nothing(by_steps, "area")
    add_over_nothing(by_demonstrations, "success")
    return by_steps, by_demonstrations


def _draw(out: Path, steps: Sequence[JsonObject], shots: Sequence[JsonObject]) -> None:
    """Draw a panel per class: success against steps, and success against demonstrations."""
    curves = {(row["class"], row["from"]): _curve(**row["curve"]) for row in steps}
    if curves:
        _save(plots.draw_panels(_panels(curves), TAG, "success"), out / "reinforcement.png")
    of_shots: dict[tuple[str, str], list[JsonObject]] = {}
    for row in sorted(shots, key=lambda row: row["demonstrations"]):
        of_shots.setdefault((row["class"], row["from"]), []).append(row)
    if of_shots:
        panels = _panels({key: _curve_of_shots(rows) for key, rows in of_shots.items()})
        unit = (1.0, "demonstrations")
        _save(plots.draw_panels(panels, TAG, "success", unit), out / "demonstrations.png")


def _save(figure: "plots.Figure", out: Path) -> None:
    for axis in figure.axes:
        axis.set_ylim(-0.02, 1.02)
    plots.save(figure, out)


def _panels(curves: dict[tuple[str, str], plots.Curve]) -> dict[str, list[plots.Group]]:
    panels: dict[str, list[plots.Group]] = {}
    for (name, arm), curve in curves.items():
        panels.setdefault(name, []).append((arm, {TAG: curve}))
    return panels


def _curve_of_shots(rows: Sequence[JsonObject]) -> plots.Curve:
    found = [row["success"] for row in rows]
    ends = [each["interval"] for each in found]
    low, high = zip(*ends, strict=True) if all(ends) else (None, None)
    return _curve([row["demonstrations"] for row in rows], [each["value"] for each in found], low, high)


def _curve(steps: Sequence[float], mean: Sequence[float], low: object, high: object) -> plots.Curve:
    ends = (None if end is None else np.array(end) for end in (low, high))
    return plots.Curve(np.array(steps), np.array(mean), *ends)
