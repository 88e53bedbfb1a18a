"""``bidex-meta transfer``: measure how much a run's policy helps on unseen classes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidex_meta.cli.parsing import RunPath, parse
from bidex_meta.cli.run_flags import config_of_words
from bidex_meta.cli.sweep import choose_cores, state_of, work
from bidex_meta.cli.tables import NONE, Json, plain_table, print_table
from bidex_meta.cli.transfer_plan import (
    Arm,
    Cell,
    arms_of,
    cells_of,
    demonstrations_of,
    held_out,
    reinforced,
    shared_words,
    suite_file,
)
from bidex_meta.config import Several, Steps
from bidex_meta.data import part_files
from bidex_meta.errors import EXIT_FAILED
from bidex_meta.evaluation.statistics import Estimate
from bidex_meta.evaluation.transfer_measures import TAG, add_over_nothing, at_the_end, by_reinforcement
from bidex_meta.experiments.conditions import say_differences
from bidex_meta.experiments.policies import say_other_rules
from bidex_meta.runs import RunFolder, plots
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.provenance import check_alike
from bidex_meta.runs.versions import collect_versions
from bidex_meta.training.launch import say
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Environments, Few, Whole
from bidex_meta.worlds import Worlds


@dataclass(frozen=True)
class TransferFlags:
    """Learn held-out classes from a run's policy and from nothing: by reinforcement, and from a few demonstrations.

    Example: bidex-meta transfer results/ML20-mtppo-seed0 --classes LiftUnderarm --out runs/transfer

    Started again, it goes on where it stopped. What follows -- are flags of `bidex-meta run` for every run, such as
    `-- --learner.critic-first 20000` (docs/transfer.md).
    """

    run: RunPath  # Run folder on a suite with held-out classes: its policy is measured.
    out: Path  # Folder of the runs, transfer.json and figures.
    start_from: tuple[Path, ...] = ()  # Other runs to start from, on observations of the same form.
    classes: tuple[str, ...] = ()  # Held-out classes; none: all of the run's suite.
    steps: Steps = 1_000_000  # Environment steps of a run by reinforcement; 0: no such runs.
    demonstrations: tuple[Whole, ...] = (0, 1, 5, 25)  # Episodes to learn from; --demonstrations alone: no such runs.
    data: Several = ()
    """Data set of a class's demonstrations (a name of `bidex-meta data list`, or a folder), in place of its script's.
    Given several times: of several classes."""
    seeds: Few = 3  # Runs of each kind, with seeds 0, 1, ...
    num_envs: Environments = 256  # Environments stepped together in each run.
    workers: Few | None = None  # Runs at a time, as of `bidex-meta sweep`.
    cores: str | None = None  # Cores that runs are bound to, likewise.


def main(arguments: Sequence[str]) -> None:
    """Run the runs that are left, print and store the tables; exit with code 1 if a run has failed."""
    if "--" in arguments:
        at = arguments.index("--")
    else:
        at = len(arguments)
    flags = parse(TransferFlags, arguments[:at], "transfer")
    arms = arms_of([flags.run, *flags.start_from])
    for run in (flags.run, *flags.start_from):
        say_differences(RunFolder.open(run))
    config = RunFolder.open(flags.run).config()
    worlds = Worlds.open(config.to_json())
    for path in flags.start_from:
        say_other_rules(RunFolder.open(path), worlds)
    classes = held_out(worlds, flags.classes)
    cores = choose_cores(flags.cores, flags.workers)
    words = shared_words(flags.num_envs, arguments[at + 1 :])
    # Bad words after -- are refused before anything is written.
    planned = config_of_words([f"--suite={config.suite}", *words])
    if any(flags.demonstrations):
        part_files.hdf5()
    check_writable(flags.out / "transfer.json")
    flags.out.mkdir(parents=True, exist_ok=True)
    with RunFolder(flags.out).locked(f"Another transfer works in {flags.out}. Wait for its end, or stop it."):
        cells = list(_cells(flags, worlds, classes, arms, words, reinforced(flags.steps, planned)))
        left = [cell.run for cell in cells if state_of(cell.run).state != "done"]
        say(f"{len(cells) - len(left)} of {len(cells)} runs are done; {len(cores)} at a time.")
        failed = work(left, cores, say)
    _report(flags, worlds.name, cells)
    if failed:
        say(f"{failed} failed or were stopped. Start it again to go on with them.")
        raise SystemExit(EXIT_FAILED)


def _cells(
    flags: TransferFlags, worlds: Worlds, classes: Sequence[str], arms: Sequence[Arm], words: Sequence[str],
    steps: list[str]
) -> Iterator[Cell]:  # fmt: skip
    """Yield all runs, seeds outermost; write suite files, and record missing demonstrations."""
    counts = sorted({*flags.demonstrations})
    most = max(flags.demonstrations, default=0)
    for folder in ("suites", "data", "runs"):
        (flags.out / folder).mkdir(exist_ok=True)
    files = {name: suite_file(worlds, name, flags.out / "suites") for name in classes}
    data = {n: demonstrations_of(file, n, flags.data, flags.out / "data", most) for n, file in files.items() if most}
    for name in (name for name, dataset in data.items() if dataset is None):
        say(f"{name} has no script: it is not learned from demonstrations. Give some by --data.")
    for seed in range(flags.seeds):
        for name, file in files.items():
            yield from cells_of(file, name, arms, seed, words, flags.out, steps, counts, data.get(name))


def _report(flags: TransferFlags, suite: str, cells: Sequence[Cell]) -> None:
    """Report the runs that are done: a table per track, transfer.json and, with matplotlib, a figure per track."""
    groups: dict[tuple[str, str, int | None], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.task, cell.arm, cell.demonstrations), []).append(cell)
    steps = list[Json]()
    shots = list[Json]()
    for (task, arm, count), members in groups.items():
        done = [cell.run for cell in members if state_of(cell.run).state == "done"]
        row: Json = {"class": task, "from": arm, "seeds": [run.seed for run in done]}
        folders = [run.folder for run in done]
        check_alike(folders)
        if not done:
            continue
        if count is None:
            steps.append(row | by_reinforcement(folders, flags.steps))
        else:
            shots.append(row | {"demonstrations": count} | at_the_end(folders))
    add_over_nothing(steps, "area")
    add_over_nothing(shots, "success")
    made = {"run": portable(str(flags.run)), "suite": portable(suite), "steps": flags.steps}
    made |= {"versions": collect_versions()}
    write_json(flags.out / "transfer.json", made | {"reinforcement": steps, "demonstrations": shots})
    if steps:
        print_table(plain_table(*_steps_table(steps, flags.steps), spare=("seeds", "return")))
    if shots:
        print_table(plain_table(*_shots_table(shots), spare=("seeds", "return")))
    _draw(flags.out, steps, shots)
    say(f"Tables and figures: {flags.out}")


def _steps_table(rows: Sequence[Json], end: int) -> tuple[list[str], list[list[str]]]:
    columns = ["class", "from", "seeds", *(f"at {int(at):,} (%)" for at in rows[0]["at"]), "at the end (%)"]
    columns += ["return", "area (%)", "area over nothing", "steps to 50 %"]
    cells = []
    for row in rows:
        measures = [*map(_text, (*row["at"].values(), row["success"])), _text(row["return"], 1.0), _text(row["area"])]
        median = row["half"]["median"]
        seeds = row["half"]["of_seeds"]
        if median is None:
            half = f"> {end:,}"
        else:
            half = f"{median:,}"
        half += f" ({sum(each is not None for each in seeds)} of {len(seeds)})"
        cells.append(
            [row["class"], row["from"], *_seeds(row), *measures, _text(row["over_nothing"], form="+.1f"), half]
        )
    return columns, cells


def _shots_table(rows: Sequence[Json]) -> tuple[list[str], list[list[str]]]:
    columns = ["class", "from", "seeds", "demonstrations", "success (%)", "return", "success over nothing"]
    cells = []
    for row in rows:
        measures = [_text(row["success"]), _text(row["return"], 1.0), _text(row["over_nothing"], form="+.1f")]
        cells.append([row["class"], row["from"], *_seeds(row), str(row["demonstrations"]), *measures])
    return columns, cells


def _seeds(row: Json) -> list[str]:
    return [", ".join(map(str, row["seeds"]))]


def _text(found: Json | None, factor: float = 100.0, form: str = ".1f") -> str:
    if found is None:
        return NONE
    return Estimate(found["value"], found["interval"]).text(factor, form=form)


def _draw(out: Path, steps: Sequence[Json], shots: Sequence[Json]) -> None:
    """Draw a panel per class: success against steps, and success against demonstrations."""
    curves = {(row["class"], row["from"]): _curve(**row["curve"]) for row in steps}
    if curves:
        _save(plots.draw_panels(_panels(curves), TAG, "success"), out / "reinforcement.png")
    of_shots: dict[tuple[str, str], list[Json]] = {}
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


def _curve_of_shots(rows: Sequence[Json]) -> plots.Curve:
    found = [row["success"] for row in rows]
    ends = [each["interval"] for each in found]
    low, high = zip(*ends, strict=True) if all(ends) else (None, None)
    return _curve([row["demonstrations"] for row in rows], [each["value"] for each in found], low, high)


def _curve(steps: Sequence[float], mean: Sequence[float], low: object, high: object) -> plots.Curve:
    ends = (None if end is None else np.array(end) for end in (low, high))
    return plots.Curve(np.array(steps), np.array(mean), *ends)
