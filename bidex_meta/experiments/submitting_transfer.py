"""Leaderboard entries of transfers: how much a run's policy helps to learn the held-out classes of its suite."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.entries import FORMAT, TRANSFER, TRANSFER_STEPS, TransferEntry, evaluation_seed, held_out
from bidex_meta.evaluation.entry_rows import class_row
from bidex_meta.evaluation.leaderboard import entry_name, read_entries, read_entry, sealed
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import resolve_device
from bidex_meta.experiments.submitted_runs import SubmittedRun, read_runs, receipt, stated
from bidex_meta.experiments.submitting import Check, compared, judged, new_path, write_entry
from bidex_meta.experiments.transfer_plan import suite_file
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.suite_files import load_suite
from bidex_meta.training.launch import say
from bidex_meta.utils.files import absolute
from bidex_meta.utils.plugins import short_name
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import open_worlds

_FACTS = ("suite", "algorithm", "train_tasks", "steps", "start", "scratch", "seeds", "budget")


@dataclass(frozen=True)
class _Transfer:
    """A pretrained run, and the runs that then learned the held-out classes of its suite.

    ``transferred`` holds the runs that started from the pretrained policy, and ``scratch`` holds the runs that started
    from scratch. Both dicts map a class to its runs, sorted by seed.
    """

    run: SubmittedRun
    seeds: list[int]
    transferred: dict[str, list[SubmittedRun]]
    scratch: dict[str, list[SubmittedRun]]

    @property
    def played(self) -> list[SubmittedRun]:
        """Return the runs that started from the pretrained policy, class by class."""
        return _in_order(self.transferred)


def _in_order(runs: Mapping[str, Sequence[SubmittedRun]]) -> list[SubmittedRun]:
    """Return the runs of all classes, class by class."""
    return list(chain.from_iterable(runs.values()))


def submit_transfer(
    folder: RunFolder, transfer: Path, out: Path, *, name: str | None, tuning: tuple[int, int], episodes: int,
    device: str
) -> Path:  # fmt: skip
    """Evaluate the policies of a finished transfer on new tasks, write the leaderboard's entry, and return its path.

    Args:
        folder: The run that was transferred.
        transfer: The folder of `bidex-meta transfer`, with runs of a million steps on every held-out class.
        out: Folder of the entries.
        name: The run's name on the leaderboard; None: the algorithm.
        tuning: Number of settings that were tried, and number of seeds per setting.
        episodes: Episodes of each task.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises BidexError for a transfer that is not finished or had other settings, and if there is an entry of this name.
    """
    found = _read(folder, transfer)
    config = found.run.config
    name = name or f"{short_name(config.algo)}-{TRANSFER}"
    path = new_path(out / entry_name(open_worlds(config.to_json()).short_name, name))
    for known, entry in read_entries(out).items():
        if isinstance(entry, TransferEntry) and entry.start == found.run.weights:
            raise BidexError(f"{folder.path} is already in {known}: their weights are equal. Delete that entry.")
    content = _played(found, episodes, device)
    content |= {"name": name, "tuning": {"trials": tuning[0], "seeds": tuning[1]}}
    write_entry(path, sealed(content, TransferEntry, str(path)))
    return path


def check_transfer(path: Path, folder: RunFolder, transfer: Path, device: str) -> Check:
    """Evaluate the policies of an entry again, with the entry's seed, and compare the results.

    Raises BidexError if the policies are not those of the entry.
    """
    entry = read_entry(path)
    if not isinstance(entry, TransferEntry):
        raise BidexError(f"{path} is not of a transfer. Leave --transfer out.")
    found = _read(folder, transfer)
    weights = [run.weights for run in found.played]
    if weights != entry.receipt.weights:
        raise BidexError(
            f"{path} is of other runs: expected weights {', '.join(entry.receipt.weights)}, got {', '.join(weights)}."
        )
    content = _played(found, entry.episodes, device) | {"name": entry.name, "tuning": asdict(entry.tuning)}
    return compared(path, entry, content, _FACTS)


def _read(folder: RunFolder, transfer: Path) -> _Transfer:
    """Return the runs of a transfer; raise BidexError if one is missing, or differs in more than class and seed."""
    [run] = read_runs([folder])
    worlds = open_worlds(run.config.to_json())
    classes = held_out(worlds.suite)
    if not classes:
        raise BidexError(f"{folder.path}: expected a run on a suite with held-out classes, got {worlds.name}.")
    folders: dict[tuple[str, bool], dict[int, RunFolder]] = {}
    for path in sorted((transfer / "runs").glob("*/")):
        member = RunFolder.open(path)
        config = member.config()
        own = config.start_from is not None and absolute(Path(config.start_from)) == absolute(folder.path)
        if config.suite is None or config.steps != TRANSFER_STEPS or not (own or config.start_from is None):
            continue  # of demonstrations, or of another start
        [name] = load_suite(config.suite).task_names("train")
        folders.setdefault((name, own), {})[config.seed] = member
    seeds = sorted(folders.get((next(iter(classes)), True), {}))
    kinds = []
    for key in product(classes, (True, False)):
        of_seeds = folders.get(key, {})
        if not seeds or sorted(of_seeds) != seeds or not all(member.evaluated for member in of_seeds.values()):
            raise BidexError(
                f"{transfer}: expected finished runs of {TRANSFER_STEPS:,} steps on {', '.join(classes)}, from the run "
                f"and from scratch, with the same seeds. {key[0]} {'from the run' if key[1] else 'from scratch'} has "
                f"the seeds {sorted(of_seeds)}. Go on: bidex-meta transfer {folder.path} --out {transfer}"
            )
        kinds += [run_kind(member.config()) | {"on": "", "started": ""} for member in of_seeds.values()]
    if any(kind != kinds[0] for kind in kinds):
        raise BidexError(f"{transfer}: expected runs that differ only in class, start and seed. Name another --out.")
    transferred = {name: _policies(folders[name, True]) for name in classes}
    scratch = {name: _policies(folders[name, False]) for name in classes}
    return _Transfer(run, seeds, transferred, scratch)


def _policies(of_seeds: Mapping[int, RunFolder]) -> list[SubmittedRun]:
    return read_runs([folder for _, folder in sorted(of_seeds.items())], shipped=False)


def _played(found: _Transfer, episodes: int, device: str) -> Json:
    """Evaluate all policies of a transfer and return the content of its leaderboard entry.

    The caller adds the entry's name, the facts about tuning, and the digest of the evaluation.
    """
    stored = found.run.config
    seed = evaluation_seed(run.weights for run in found.played)
    config = stored.to_json()
    config |= {"device": resolve_device(device, open_worlds(config).on_gpu), "engine": "auto"}
    new = open_worlds({**config, "task_seed": seed, "tasks_per_class": None})
    shots = []
    with TemporaryDirectory() as folder:
        files = {name: suite_file(new, name, Path(folder)) for name in found.transferred}
        for start, runs_of in (("scratch", found.scratch), ("the run", found.transferred)):
            classes = {}
            for name, runs in runs_of.items():
                say(f"{name}: playing the policies from {start}.")
                evaluations = [_on_new_tasks(run, files[name], config, episodes, seed) for run in runs]
                classes[name] = class_row([_solved(evaluation) for evaluation in evaluations], episodes)
            shots.append(classes)
    return {
        "format": FORMAT, "suite": new.short_name, "track": TRANSFER, "algorithm": stored.algo,
        "train_tasks": stored.tasks_per_class, "steps": [found.run.steps], "seed": seed, "episodes": episodes,
        "new": {"trials": 1, "rollouts": 0, "shots": shots}, "conditions": asdict(conditions(open_worlds(config))),
        "start": found.run.weights, "scratch": [run.weights for run in _in_order(found.scratch)],
        "seeds": found.seeds, "budget": TRANSFER_STEPS, "stated": stated([found.run]), "receipt": receipt(found.played),
    }  # fmt: skip


def _on_new_tasks(run: SubmittedRun, file: Path, config: Json, episodes: int, seed: int) -> Evaluation:
    """Play a policy on the tasks that a suite file lists."""
    set_up_torch(run.config.threads, run.config.deterministic)
    own = run.config.to_json() | {"suite": str(file), "device": config["device"], "engine": config["engine"]}
    [evaluation] = judged(run, open_worlds(own), episodes, seed).by_shot
    return evaluation


def _solved(evaluation: Evaluation) -> list[int]:
    """Return the number of successful episodes of each task, in the order of the tasks.

    The evaluation is of a single class. If it has several objects, the tasks of all objects are listed one after
    another.
    """
    solved = []
    for row in evaluation.classes.values():
        solved += row.solved
    return solved
