"""Entries of the leaderboard: their schema, and the contradictions that an entry must not have."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.entry_rows import ClassRow, class_row, faults_of_row, row_table
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.suite import Suite
from bidex_meta.suite_files import METAWORLD_SUITES, load_suite, suite_names
from bidex_meta.utils.validation import Count, Few, NonNegative, Seed, Whole

FORMAT = 3
SHOTS = 2  # shots of a meta-test, so a trial has three episodes
TASKS = 20  # tasks per class in a meta-test, the first of its pool
MULTI_TASK = "multi-task"
TRANSFER = "transfer"
TRANSFER_STEPS = 1_000_000  # of training on each held-out class
_FIRST_SEED = 2**30
"""The smallest evaluation seed. Seeds of training are smaller, so that no run trains on the tasks of an evaluation."""
_TASKS_OF_METAWORLD = 50
_MOST_EPISODES = 1000  # of a task after a shot, over all trials
_ITEMS = {MULTI_TASK: 1, TRANSFER: 2}  # of ``shots`` by track; other tracks have one before and one after each shot
_Name = Annotated[str, Meta(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f|<>\[\]]*$")]
_Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{32}$")]
_Commit = Annotated[str, Meta(pattern=r"^[0-9a-f]{7,40}\+?$")]
_Identity = Annotated[str, Meta(pattern=r"^[0-9a-f]{12}$")]
_Version = Annotated[str, Meta(max_length=100, pattern=r"^[0-9][\w.+]*$")]

AdaptationTrack = Literal["reward-only", "privileged"]
"""Information in the training of an agent that adapts. ``reward-only``: only the rewards of the agent's own episodes;
``privileged``: also teachers, hidden parts of tasks, or rewards of other goals."""
Track = Literal["multi-task", "reward-only", "privileged", "transfer"]
ADAPTATION: tuple[str, ...] = get_args(AdaptationTrack)


Classes = Annotated[dict[str, ClassRow], Meta(min_length=1)]


@dataclass(frozen=True)
class Part:
    """The part of a leaderboard entry that holds results on new tasks, or on the tasks that the runs trained on."""

    trials: Few  # adaptations to each task, each followed by the entry's ``episodes``
    rollouts: Whole  # exploration episodes of each task in a shot; 0 for a policy that does not adapt
    shots: Annotated[list[Classes], Meta(min_length=1)]
    """Results after 0, 1, ... shots; for a transfer, results from scratch and then from the run."""

    def tables(self, episodes: int, shot: int = -1) -> list[np.ndarray]:
        """Return a table of success for each class, computed from ``shots[shot]``, by default the last item.

        A table has the shape (runs, units). Units are tasks, or episodes if the class has few tasks. ``episodes`` is
        the number of evaluation episodes of a task after each adaptation.
        """
        return [row_table(row.solved, episodes * self.trials) for row in self.shots[shot].values()]


@dataclass(frozen=True)
class Conditions:
    """Conditions under which the results of a leaderboard entry were measured."""

    device: _Name
    engine: Literal["auto", "c", "warp"]
    threads: Count | None
    num_envs: Count | None
    packages: dict[str, _Version | None]
    physics: _Identity | None
    suite_version: Whole | None
    suite_digest: _Identity | None


@dataclass(frozen=True)
class Tuning:
    """The extent of the hyperparameter search, as stated by the submitter."""

    trials: Count  # settings that were tried
    seeds: Count  # seeds of each setting


@dataclass(frozen=True)
class Receipt:
    """Digests of everything that the results come from; lists have one item per run."""

    weights: list[_Digest]  # digests of the policies, see ``weights_digest``
    config: list[_Digest]
    code: _Commit | None  # commit of the code that evaluated, with + if files differed from it; None: no repository
    evaluation: _Digest  # digest of all other content of the entry


@dataclass(frozen=True)
class Stated:
    """Statements of the run folders that nobody can verify; lists have one item per run."""

    seeds: list[Seed]
    hours: list[NonNegative]  # hours of training, without evaluation
    device: _Name  # device that trained
    commit: list[_Commit | None]  # commit of the code that trained, with + if files differed from it


@dataclass(frozen=True, kw_only=True)
class _Listed(ABC):
    """The fields that all entries of the leaderboard have."""

    verified: ClassVar[bool]
    """True if ``submit`` has played the episodes."""
    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)]
    name: _Name
    suite: _Name
    track: Track
    tuning: Tuning
    seed: Seed  # seed of starts; for runs also of new tasks
    episodes: Few  # episodes of each task after each adaptation
    new: Part
    """Results on tasks that the seed draws; for an agent that is not a run, results on test tasks."""
    conditions: Conditions
    receipt: Receipt

    @property
    def runs(self) -> int:
        """Return the number of runs; every class has one list of successes per run."""
        return len(self.receipt.weights)

    @property
    def result(self) -> list[np.ndarray]:
        """Return the success by which entries are ranked: success on new tasks, from the last item of ``shots``.

        The list has one table (runs, units) per class. Units are tasks, or episodes if the class has few tasks.
        """
        return self.new.tables(self.episodes)

    @property
    def parts(self) -> dict[str, Part]:
        """Return the entry's results by name of the part: only ``new``, the results on new tasks."""
        return {"new": self.new}

    def summaries(self) -> dict[str, ClassSummary]:
        """Return a summary of success for each combination of run, part, shot and class.

        The summaries can be compared with those of a repeated evaluation; their returns are set to 0.
        """
        found = {}
        for where, part, shot, name, row in self._rows():
            episodes = self.episodes * part.trials
            for run, solved in enumerate(row.solved):
                own = class_row([solved], episodes)
                found[f"{name} ({where}, shot {shot}, run {run})"] = ClassSummary(
                    success=own["success"], success_interval=own["interval"], mean_return=0.0, solved=solved,
                    episodes=episodes * len(solved), tasks=len(solved)
                )  # fmt: skip
        return found

    def _rows(self) -> Iterator[tuple[str, Part, int, str, ClassRow]]:
        for where, part in self.parts.items():
            for shot, classes in enumerate(part.shots):
                yield from ((where, part, shot, name, row) for name, row in classes.items())

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within the entry, and between the entry and its suite."""
        conditions = self.conditions
        if missing := {"bidex-meta", "mujoco"} - conditions.packages.keys():
            yield f"conditions.packages: expected {min(missing)} to be there"
        suite = _suite(self.suite)
        if suite is None:
            identity = (None, None)
        else:
            trained_on = suite.with_train_tasks(self._train_tasks())
            identity = (trained_on.version, trained_on.digest)
        if (conditions.suite_version, conditions.suite_digest) != identity:
            yield f"conditions: expected {self.suite} as it is here, version {identity[0]}, digest {identity[1]}"
        if self.track in ADAPTATION and (suite is None or "test" not in suite.splits):
            yield f"track: {self.suite} has no test tasks to adapt to"
        if self.track == TRANSFER and not held_out(suite):
            yield f"track: {self.suite} has no class that is only tested"
        for where, part in self.parts.items():
            yield from (f"{where}.{fault}" for fault in self._faults_of(part, self._pools(where)))

    def _faults_of(self, part: Part, pools: Mapping[str, int]) -> Iterator[str]:
        """Yield messages about contradictions within a part; ``pools`` has the number of tasks of each class."""
        adapts = self.track in ADAPTATION
        shots = _ITEMS.get(self.track, SHOTS + 1)
        if len(part.shots) != shots:
            yield f"shots: expected {shots} of the track {self.track}, got {len(part.shots)}"
        if adapts != (part.rollouts > 0):
            yield f"rollouts: expected {'some' if adapts else 'none'} of the track {self.track}, got {part.rollouts}"
        if not adapts and part.trials > 1:
            yield f"trials: expected 1 of the track {self.track}, got {part.trials}"
        episodes = self.episodes * part.trials
        if episodes > _MOST_EPISODES:
            yield f"trials: expected at most {_MOST_EPISODES} episodes of a task, got {episodes}"
            return
        for shot, classes in enumerate(part.shots):
            if list(classes) != list(pools):
                yield f"shots[{shot}]: expected the classes {', '.join(pools)}, got {', '.join(classes)}"
                return
            for name, row in classes.items():
                faults = faults_of_row(row, self.runs, self._tasks(pools[name]), episodes)
                yield from (f"shots[{shot}].{name}.{fault}" for fault in faults)

    def _pools(self, where: str) -> dict[str, int]:
        """Return the number of tasks that each class has in a part of the entry, ``where`` ("new" or "own")."""
        suite = _suite(self.suite)
        if self.track == TRANSFER:
            return held_out(suite)
        if suite is None:
            return dict.fromkeys(METAWORLD_SUITES[self.suite], _TASKS_OF_METAWORLD)
        if where == "own":
            suite = suite.with_train_tasks(self._train_tasks())
        if where == "own" or self.track == MULTI_TASK:
            split = "train"
        else:
            split = "test"
        return {slot: len(tasks) for slot, tasks in suite.task_names(split).items()}

    def _train_tasks(self) -> int | None:
        """Return the number of train tasks per class, or None for the number that the suite file gives."""
        return None

    @abstractmethod
    def _tasks(self, pool: int) -> range:
        """Return the allowed numbers of evaluated tasks, as a range, for a class that has ``pool`` tasks."""


@dataclass(frozen=True, kw_only=True)
class _OfRuns(_Listed):
    """A leaderboard entry whose results the command `submit` measured by evaluating the policies of runs."""

    verified = True
    algorithm: _Name
    train_tasks: Whole | None  # train tasks per class; 0: a new task per episode or trial; None: as in the suite
    steps: list[Count]  # environment steps of the checkpoints
    stated: Stated

    def _train_tasks(self) -> int | None:
        return self.train_tasks

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within the entry, and between the entry and its suite."""
        weights = self.receipt.weights
        if len({*weights}) < len(weights):
            yield "receipt.weights: expected another policy of each run, got one twice"
        seed = evaluation_seed(weights)
        if self.seed != seed:
            yield f"seed: expected {seed}, which comes from the weights, got {self.seed}"
        yield from super().faults()


@dataclass(frozen=True, kw_only=True)
class Entry(_OfRuns):
    """Runs that differ only in the seed, and their verified results; lists have one item per run."""

    own: Part
    """Results on the tasks of the suite's train split, as the runs' seeds draw them."""

    @property
    def parts(self) -> dict[str, Part]:
        """Return the entry's results by name of the part: on ``new`` tasks, and on the runs' ``own`` train tasks."""
        return {"new": self.new, "own": self.own}

    def _tasks(self, pool: int) -> range:
        tasks = pool if self.track == MULTI_TASK else min(pool, TASKS)
        return range(tasks, tasks + 1)

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within the entry, and between the entry and its suite."""
        receipt = self.receipt
        named = {"steps": self.steps, "receipt.weights": receipt.weights, "receipt.config": receipt.config}
        named |= {f"stated.{name}": value for name, value in vars(self.stated).items() if isinstance(value, list)}
        yield from _faults_of_lengths(named, self.runs)
        if len({*self.stated.seeds}) < len(self.stated.seeds):
            yield "stated.seeds: expected each seed once"
        if self.track == TRANSFER:
            yield "track: expected policies that learned the held-out classes, got none"
        yield from super().faults()


@dataclass(frozen=True, kw_only=True)
class TransferEntry(_OfRuns):
    """A leaderboard entry that compares learning each held-out class from a run's policy and from scratch.

    The lists of ``steps`` and ``stated`` have one item, for the run. ``new.shots`` has two items: the results of
    training from scratch, and the results of training that began with the run's policy.
    """

    start: _Digest
    """Digest of the run's policy. The digests in the receipt are of the policies that were trained from it, class by
    class."""
    scratch: list[_Digest]  # digests of the policies from scratch, in the same order
    seeds: Annotated[list[Seed], Meta(min_length=1)]  # seeds of the training on each class
    budget: Count  # environment steps of the training on each class

    @property
    def runs(self) -> int:
        """Return the number of policies per class that were trained from the run's policy, one per seed."""
        return len(self.seeds)

    def _tasks(self, pool: int) -> range:
        return range(pool, pool + 1)

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within the entry, and between the entry and its suite."""
        if self.track != TRANSFER:
            yield f"track: expected {TRANSFER}, got {self.track}"
        if self.budget != TRANSFER_STEPS:
            yield f"budget: expected {TRANSFER_STEPS:,} steps, got {self.budget:,}"
        receipt = self.receipt
        policies = self.runs * len(held_out(_suite(self.suite)))
        named = {"receipt.weights": receipt.weights, "receipt.config": receipt.config, "scratch": self.scratch}
        yield from _faults_of_lengths(named, policies)
        stated = {f"stated.{name}": value for name, value in vars(self.stated).items() if isinstance(value, list)}
        yield from _faults_of_lengths({"steps": self.steps, **stated}, 1)
        if len({*self.seeds}) < len(self.seeds):
            yield "seeds: expected each seed once"
        if len({self.start, *receipt.weights, *self.scratch}) < 1 + 2 * policies:
            yield "start, receipt.weights, scratch: expected each policy once"
        yield from super().faults()


@dataclass(frozen=True, kw_only=True)
class AgentEntry(_Listed):
    """A leaderboard entry with the meta-test of a user's own agent, which this package did not train.

    Its file is in the folder ``trials/`` of the entries. The results are those that the user submitted; nobody has
    verified them.
    """

    verified = False
    track: AdaptationTrack
    agent: _Name  # name of the agent's class
    task_seed: Seed

    @property
    def runs(self) -> int:
        """Return 1, because an agent that is not a run counts as one run."""
        return 1

    def _tasks(self, pool: int) -> range:
        return range(1, pool + 1)

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within the entry, and between the entry and its suite."""
        receipt = self.receipt
        if receipt.weights or receipt.config or receipt.code:
            yield "receipt: expected no weights, config and code of an agent that was played elsewhere"
        yield from super().faults()


AnyEntry = Entry | TransferEntry | AgentEntry


def evaluation_seed(weights: Iterable[str]) -> int:
    """Return the seed of an evaluation, from the digests of the policies that it plays."""
    digest = hashlib.sha256("/".join(("bidex-meta evaluation", *sorted(weights))).encode()).digest()
    return _FIRST_SEED + int.from_bytes(digest[:8], "little") % _FIRST_SEED


def _suite(name: str) -> Suite | None:
    """Return a shipped suite, or None for one of Meta-World's suites; raise BidexError for an unknown name."""
    if name in METAWORLD_SUITES:
        return None
    if name not in suite_names():
        raise BidexError(
            f"expected a shipped suite, got {name}: other people cannot play it. Submit a run on a shipped suite."
        )
    return load_suite(name)


def held_out(suite: Suite | None) -> dict[str, int]:
    """Return the number of test tasks of each class that a suite tests but does not train on."""
    if suite is None:
        return {}
    pools = suite.task_names("test") if "test" in suite.splits else {}
    names = [entry.name for entry in suite.classes if entry.splits == ("test",)]
    return {name: len(pools[name]) for name in names}


def _faults_of_lengths(lists: Mapping[str, Sequence[object]], expected: int) -> Iterator[str]:
    for name, values in lists.items():
        if len(values) != expected:
            yield f"{name}: expected {expected} values, got {len(values)}"
