"""Entries of the leaderboard, verified by evaluating the runs again."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, Agreement, agreements
from bidex_meta.evaluation.entries import (
    FORMAT,
    MULTI_TASK,
    SHOTS,
    TASKS,
    AdaptationTrack,
    AgentEntry,
    Entry,
    Track,
    TransferEntry,
    evaluation_seed,
)
from bidex_meta.evaluation.entry_rows import class_row
from bidex_meta.evaluation.leaderboard import (
    agent_part,
    entry_name,
    read_entries,
    read_entry,
    sealed,
)
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import resolve_device
from bidex_meta.experiments.metatest import Adaptation, Options, meta_test
from bidex_meta.experiments.policies import policy_of
from bidex_meta.experiments.submitted_runs import SubmittedRun, read_runs, receipt, stated, track_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json, check_writable, write_json
from bidex_meta.runs.evaluations import MetaTestEvaluation, read_evaluation
from bidex_meta.training.launch import say
from bidex_meta.utils.files import exists, portable
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import parse
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds, open_worlds

_EPISODES = 1  # default number of episodes of each task
_EPISODES_OF_TRIALS = 10  # default number of episodes of each task after each adaptation
_FACTS = ("suite", "track", "algorithm", "train_tasks", "steps")
_AnEntry = TypeVar("_AnEntry", Entry, TransferEntry)


@dataclass(frozen=True)
class Check:
    """The result of :func:`check`."""

    classes: Sequence[Agreement]
    """Recorded and repeated success by class, part, shot and run."""
    different: Sequence[str]
    """Names of the entry's other fields whose values are not those of the runs."""

    @property
    def outcome(self) -> str:
        """Return ``equal``, ``within`` or ``differs``: the worst agreement over all classes and other fields.

        :mod:`bidex_meta.evaluation.agreement` defines these three outcomes.
        """
        outcomes = {each.outcome for each in self.classes}
        if self.different or DIFFERS in outcomes:
            return DIFFERS
        return WITHIN if WITHIN in outcomes else EQUAL


def submit(
    folders: Sequence[RunFolder], out: Path, *, name: str | None, tuning: tuple[int, int], episodes: int | None,
    device: str
) -> Path:  # fmt: skip
    """Evaluate runs on their train tasks and on new tasks, and write the result as an entry of the leaderboard.

    Runs of learners that adapt play a meta-test with two adaptation rounds, so that a trial has three episodes. The
    seed of all start states and of the new tasks is computed from the digests of the policies. Returns the path
    of the entry.

    Args:
        folders: Runs that differ only in the seed.
        out: Folder of the entries.
        name: The runs' name on the leaderboard; None: the algorithm.
        tuning: Number of settings that were tried, and number of seeds per setting.
        episodes: Episodes of each task; for learners that adapt, after each adaptation. None: 1, or 10 for learners
            that adapt.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises BidexError if the runs cannot form one entry, or if there is already an entry of this name or with the
    weights of one of the runs.
    """
    runs = read_runs(folders)
    config = runs[0].config
    name = name or short_name(config.algo)
    path = new_path(out / entry_name(open_worlds(config.to_json()).short_name, name))
    for known, entry in read_entries(out).items():
        for run in runs:
            if run.weights in entry.receipt.weights:
                raise BidexError(
                    f"{run.folder.path} is already in {known}: their weights are equal. Leave it out, or delete that "
                    "entry."
                )
    track = track_of(runs)
    if track is None:
        raise BidexError(
            f"{runs[0].folder.path} started from a run that is not here, but its training decides the track. Put "
            f"{portable(config.start_from)} there."
        )
    content = _played(runs, track, episodes, device)
    content |= {"name": name, "tuning": {"trials": tuning[0], "seeds": tuning[1]}}
    write_entry(path, sealed(content, Entry, str(path)))
    return path


def check(path: Path, folders: Sequence[RunFolder], device: str) -> Check:
    """Evaluate the runs of an entry again, with the entry's seed, and compare the results.

    Raises BidexError if the runs are not those of the entry.
    """
    entry = read_entry(path)
    if isinstance(entry, TransferEntry):
        raise BidexError(f"{path} is of a transfer. Name the run, and the folder of its transfer by --transfer.")
    if not isinstance(entry, Entry):
        raise BidexError(
            f"{path} belongs to an agent that is not a run, so it cannot be played again. Name an entry of runs."
        )
    weights = entry.receipt.weights
    runs = read_runs(folders)
    found = [run.weights for run in runs]
    if sorted(found) != sorted(weights):
        raise BidexError(
            f"{path} belongs to other runs: expected weights {', '.join(weights)}, got {', '.join(found)}."
        )
    runs.sort(key=lambda run: weights.index(run.weights))
    track = track_of(runs) or entry.track  # the run that it started from may be missing here
    content = _played(runs, track, entry.episodes, device)
    content |= {"name": entry.name, "tuning": asdict(entry.tuning)}
    return compared(path, entry, content, _FACTS)


def compared(path: Path, entry: _AnEntry, content: Json, facts: Sequence[str]) -> Check:
    """Compare an entry in ``path`` with the content of the same entry played again; ``facts`` are fields to compare."""
    repeated = parse(sealed(content, type(entry), str(path)), type(entry), str(path))
    different = [name for name in facts if getattr(repeated, name) != getattr(entry, name)]
    if repeated.receipt.config != entry.receipt.config:
        different.append("receipt.config")
    return Check(agreements(entry.summaries(), repeated.summaries()), different)


def submit_agent(
    file: Path, out: Path, *, name: str | None, track: AdaptationTrack | None, tuning: tuple[int, int]
) -> Path:  # fmt: skip
    """Write a leaderboard entry for the meta-test of a user's own agent, and return the entry's path.

    We do not have the agent, so its results are not verified.

    Args:
        file: The meta-test, as ``meta_test(agent, suite).save(file)`` writes it.
        out: Folder of the entries.
        name: The agent's name on the leaderboard; None: the name of its class.
        track: The track of the agent's training, ``reward-only`` or ``privileged``.
        tuning: Number of settings that were tried, and number of seeds per setting.

    Raises BidexError if ``file`` is not a meta-test, if there is no track, or if there is an entry of this name.
    """
    found = read_evaluation(file, "meta_test(agent, suite).save(file)")
    if not isinstance(found, MetaTestEvaluation):
        raise BidexError(f"{file}: expected a meta-test, got an evaluation of a policy. Submit its run instead.")
    episodes, part = agent_part(found, str(file))
    if track is None:
        raise BidexError(
            "--track: expected reward-only (trained by rewards of its own episodes) or privileged (by teachers, hidden "
            "parts of tasks or rewards of other goals too), got none."
        )
    name = name or found.agent or ""
    path = new_path(out / "trials" / entry_name(found.suite or "", name))
    content = {
        "format": FORMAT, "name": name, "suite": found.suite, "track": track, "agent": found.agent,
        "tuning": {"trials": tuning[0], "seeds": tuning[1]}, "seed": found.seed, "task_seed": found.task_seed,
        "episodes": episodes, "new": asdict(part), "conditions": asdict(found.conditions),
        "receipt": {"weights": [], "config": [], "code": None},
    }  # fmt: skip
    write_entry(path, sealed(content, AgentEntry, str(file)))
    return path


def _played(runs: Sequence[SubmittedRun], track: Track, episodes: int | None, device: str) -> Json:
    """Evaluate runs and return the content of their leaderboard entry.

    The caller adds the entry's name, the facts about tuning, and the digest of the evaluation.
    """
    first = runs[0].config
    if episodes is None:
        episodes = _EPISODES if track == MULTI_TASK else _EPISODES_OF_TRIALS
    seed = evaluation_seed(run.weights for run in runs)
    worlds = [_worlds(run.config, seed, device, track) for run in runs]
    parts = {}
    for place, name in enumerate(("own", "new")):
        played = []
        for run, of_run in zip(runs, worlds, strict=True):
            say(f"{run.folder.path}: playing {'its own' if name == 'own' else 'new'} tasks.")
            set_up_torch(run.config.threads, run.config.deterministic)
            if track == MULTI_TASK:
                played.append(judged(run, of_run[place], episodes, seed))
            else:
                adaptation = Adaptation.of(of_run[0], run.config)
                played.append(_adapted(run, of_run[place], adaptation, ("train", "test")[place], episodes, seed))
        parts[name] = _part(played, episodes)
    return {
        "format": FORMAT, "suite": worlds[0][0].short_name, "track": track, "algorithm": first.algo,
        "train_tasks": first.tasks_per_class, "steps": [run.steps for run in runs], "seed": seed,
        "episodes": episodes, **parts, "conditions": asdict(conditions(worlds[0][0])),
        "stated": stated(runs), "receipt": receipt(runs),
    }  # fmt: skip


def _worlds(stored: RunConfig, seed: int, device: str, track: str) -> tuple[Worlds, Worlds]:
    """Open the suite of a run twice: with the tasks that the run was trained on, and with new tasks.

    ``seed`` draws the new tasks. Raises BidexError in the multi-task track if the suite lists all its tasks.
    """
    config = stored.to_json()
    config |= {"device": resolve_device(device, open_worlds(config).on_gpu), "engine": "auto"}
    drawn = {**config, "tasks_per_class": None}
    if track == MULTI_TASK:
        return open_worlds(config), open_worlds(drawn).with_new_tasks(seed)
    return open_worlds(config), open_worlds({**drawn, "task_seed": seed})


@dataclass(frozen=True)
class _Played:
    """Results of one run, either on the tasks that it was trained on or on new tasks."""

    by_shot: Sequence[Evaluation]
    trials: int = 1
    rollouts: int = 0


def judged(run: SubmittedRun, worlds: Worlds, episodes: int, seed: int) -> _Played:
    """Play the episodes of a policy that does not adapt."""
    world = worlds.world("train")
    found = worlds.evaluate(
        policy_of(run.folder, run.state, worlds.device), world, worlds.protocol("train", episodes, seed)
    )
    world.close()
    return _Played([found])


def _adapted(
    run: SubmittedRun, worlds: Worlds, adaptation: Adaptation, split: str, episodes: int, seed: int
) -> _Played:
    """Play the meta-test of a run's policy on one split."""
    # An agent that adapts to its own episodes is evaluated in the environments in which it explored.
    rollouts = episodes if adaptation.is_per_environment else None
    options = Options(shots=SHOTS, tasks=TASKS, episodes=episodes, rollouts=rollouts, seed=seed)
    load = partial(policy_of, run.folder, run.state, worlds.device)
    found = meta_test(worlds, adaptation, load, options, [split])[split]
    return _Played(found.by_shot, found.protocol.trials, found.rollouts)


def _part(played: Sequence[_Played], episodes: int) -> Json:
    """Return the results of all runs on their train tasks or on new tasks, by shot and class, ready for JSON."""
    first = played[0]
    shots = []
    for evaluations in zip(*(of_run.by_shot for of_run in played), strict=True):
        classes = {}
        for name in evaluations[0].classes:
            solved = [evaluation.classes[name].solved for evaluation in evaluations]
            classes[name] = class_row(solved, episodes * first.trials)
        shots.append(classes)
    return {"trials": first.trials, "rollouts": first.rollouts, "shots": shots}


def new_path(path: Path) -> Path:
    """Return the path of a new entry; raise BidexError if the file exists, or cannot be written."""
    if exists(path):
        raise BidexError(f"{path} exists already. Give another --name, or delete it.")
    check_writable(path)
    return path


def write_entry(path: Path, content: Json) -> None:
    """Write the file of an entry; make its folder if that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
