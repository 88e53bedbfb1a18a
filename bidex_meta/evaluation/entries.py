"""Entries of the leaderboard: their schema, and the contradictions that an entry must not have."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.results import MANY_TASKS
from bidex_meta.evaluation.statistics import Estimate, bootstrap, estimate_from
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.suite import METAWORLD_SUITES, Suite, load_suite, suite_names
from bidex_meta.utils.validation import Count, Few, Fraction, NonNegative, Seed, Whole

FORMAT = 3
SHOTS = 2  # shots of a meta-test, so a trial has three episodes
TASKS = 20  # tasks per class in a meta-test, the first of its pool
MULTI_TASK = "multi-task"
_FIRST_SEED = 2**30
"""The least evaluation seed: seeds of training are small, so that no run trains on the tasks of an evaluation."""
_TASKS_OF_METAWORLD = 50
_MOST_EPISODES = 1000  # maximum number of episodes of a task after a shot, over all trials
ROUNDING = 1e-6  # rounding of stored rates
_Interval = tuple[Fraction, Fraction]
_Name = Annotated[str, Meta(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f|]*$")]
_Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{32}$")]
_Commit = Annotated[str, Meta(pattern=r"^[0-9a-f]{7,40}\+?$")]
_Identity = Annotated[str, Meta(pattern=r"^[0-9a-f]{12}$")]
_Version = Annotated[str, Meta(max_length=100, pattern=r"^[0-9][\w.+]*$")]

AdaptationTrack = Literal["reward-only", "privileged"]
"""The training of an agent that adapts: rewards of its own episodes alone; or also teachers, hidden parts of tasks, or
rewards of other goals."""
Track = Literal["multi-task", "reward-only", "privileged"]


@dataclass(frozen=True)
class ClassRow:
    """The results of a class."""

    success: Fraction
    interval: _Interval | None  # 95 % interval of the mean over runs and tasks; None with a single episode
    solved: Annotated[list[Annotated[list[Whole], Meta(min_length=1)]], Meta(min_length=1)]
    """Successful episodes of each task, one list per run."""


Classes = Annotated[dict[str, ClassRow], Meta(min_length=1)]


@dataclass(frozen=True)
class Part:
    """The results on tasks of one kind."""

    trials: Few  # adaptations to each task; each is followed by the entry's number of ``episodes``
    rollouts: Whole  # exploration episodes of each task in a shot; 0 for a policy that does not adapt
    shots: Annotated[list[Classes], Meta(min_length=1)]  # results after 0, 1, ... shots

    def tables(self, episodes: int, shot: int = -1) -> list[np.ndarray]:
        """Return success (runs, units) in each class after a shot; ``episodes`` are those of an adaptation."""
        return [_table(row.solved, episodes * self.trials) for row in self.shots[shot].values()]


@dataclass(frozen=True)
class Conditions:
    """Conditions of the evaluation."""

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
    """The submitter's statement of the search for settings."""

    trials: Count  # number of settings that were tried
    seeds: Count  # seeds per setting


@dataclass(frozen=True)
class Receipt:
    """Digests of everything that the results come from; lists have one item per run."""

    weights: list[_Digest]  # digests of the policies, see ``weights_digest``
    config: list[_Digest]
    code: _Commit | None  # commit that evaluated, with + if files differed from it; None: not from a repository
    evaluation: _Digest  # digest of all other content of the entry


@dataclass(frozen=True)
class Stated:
    """Statements of the run folders that nobody can verify; lists have one item per run."""

    seeds: list[Seed]
    hours: list[NonNegative]  # training time of each run, without evaluation
    device: _Name  # devices that trained
    commit: list[_Commit | None]  # commits that trained, with + if files differed; None: not from a repository


@dataclass(frozen=True, kw_only=True)
class _Listed(ABC):
    """The fields of every entry."""

    verified: ClassVar[bool]
    """True if ``submit`` has played the episodes."""
    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)]
    name: _Name
    suite: _Name
    track: Track
    tuning: Tuning
    seed: Seed  # seed of start states, and for runs also of new tasks
    episodes: Few  # episodes of each task after each adaptation
    new: Part
    """Results on tasks that the seed draws; of an agent that is no run, on test tasks."""
    conditions: Conditions
    receipt: Receipt

    @property
    def runs(self) -> int:
        """Return the number of runs; an agent that is no run counts as one."""
        return max(1, len(self.receipt.weights))

    @property
    def result(self) -> list[np.ndarray]:
        """Return the success (runs, units) in each class by which entries are ranked: on new tasks, at the end."""
        return self.new.tables(self.episodes)

    @property
    def parts(self) -> dict[str, Part]:
        """Return the parts by name."""
        return {"new": self.new}

    def summaries(self) -> dict[str, ClassSummary]:
        """Return the results, without returns, that a repetition compares: of each run, part, shot and class."""
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
        """Yield the contradictions within an entry and to its suite."""
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
        if self.track != MULTI_TASK and (suite is None or "test" not in suite.splits):
            yield f"track: {self.suite} has no test tasks to adapt to"
        for where, part in self.parts.items():
            yield from (f"{where}.{fault}" for fault in self._faults_of(part, self._pools(where)))

    def _faults_of(self, part: Part, pools: Mapping[str, int]) -> Iterator[str]:
        """Yield the contradictions within a part whose classes have ``pools`` tasks."""
        adapts = self.track != MULTI_TASK
        shots = SHOTS + 1 if adapts else 1
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
                faults = _faults_of_row(row, self.runs, self._tasks(pools[name]), episodes)
                yield from (f"shots[{shot}].{name}.{fault}" for fault in faults)

    def _pools(self, where: str) -> dict[str, int]:
        """Return the number of tasks per class in a part."""
        suite = _suite(self.suite)
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
        """Return the number of train tasks per class, if it differs from that of the suite."""
        return None

    @abstractmethod
    def _tasks(self, pool: int) -> range:
        """Return the numbers of tasks that may be played of a pool."""


@dataclass(frozen=True, kw_only=True)
class Entry(_Listed):
    """Runs that differ only in the seed, and their verified results; lists have one item per run."""

    verified = True
    algorithm: _Name
    train_tasks: Whole | None  # per class; 0: a new task in each episode or trial; None: the suite's number
    steps: list[Count]  # steps of the checkpoints
    own: Part
    """Results on the tasks of the suite's train split, as the runs' seeds draw them."""
    stated: Stated

    @property
    def parts(self) -> dict[str, Part]:
        """Return the parts by name."""
        return {"new": self.new, "own": self.own}

    def _train_tasks(self) -> int | None:
        return self.train_tasks

    def _tasks(self, pool: int) -> range:
        tasks = pool if self.track == MULTI_TASK else min(pool, TASKS)
        return range(tasks, tasks + 1)

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within an entry and to its suite."""
        receipt = self.receipt
        named = {"steps": self.steps, "receipt.weights": receipt.weights, "receipt.config": receipt.config}
        named |= {f"stated.{name}": value for name, value in vars(self.stated).items() if isinstance(value, list)}
        for name, values in named.items():
            if len(values) != self.runs:
                yield f"{name}: expected {self.runs} values, one per run, got {len(values)}"
        if len({*receipt.weights}) < len(receipt.weights):
            yield "receipt.weights: expected another policy of each run, got one twice"
        if len({*self.stated.seeds}) < len(self.stated.seeds):
            yield "stated.seeds: expected each seed once"
        seed = evaluation_seed(receipt.weights)
        if self.seed != seed:
            yield f"seed: expected {seed}, which comes from the weights, got {self.seed}"
        yield from super().faults()


@dataclass(frozen=True, kw_only=True)
class AgentEntry(_Listed):
    """A meta-test of an agent that is no run, in ``trials/`` of the folder of entries. Nothing in it is verified."""

    verified = False
    track: AdaptationTrack
    agent: _Name  # class of the agent
    task_seed: Seed

    def _tasks(self, pool: int) -> range:
        return range(1, pool + 1)

    def faults(self) -> Iterator[str]:
        """Yield the contradictions within an entry and to its suite."""
        receipt = self.receipt
        if receipt.weights or receipt.config or receipt.code:
            yield "receipt: expected no weights, config and code of an agent that was played elsewhere"
        yield from super().faults()


AnyEntry = Entry | AgentEntry


def evaluation_seed(weights: Iterable[str]) -> int:
    """Return the seed of an evaluation, from the digests of the policies that it plays."""
    digest = hashlib.sha256("/".join(("bidex-meta evaluation", *sorted(weights))).encode()).digest()
    return _FIRST_SEED + int.from_bytes(digest[:8], "little") % _FIRST_SEED


def class_row(solved: list[list[int]], episodes: int) -> Json:
    """Return the results of a class, ready for JSON, from the number of successes per run and task, of ``episodes``."""
    mean = _mean(_table(solved, episodes))
    return {"success": mean.value, "interval": mean.interval, "solved": solved}


def _table(solved: list[list[int]], episodes: int) -> np.ndarray:
    """Return success (runs, units): the units are tasks, or episodes if there are few tasks (``MANY_TASKS``)."""
    counts = np.array(solved)
    if counts.shape[1] >= MANY_TASKS:
        return counts / episodes
    table = []
    for run, of_run in enumerate(counts):
        outcomes = (np.arange(episodes) < of_run[:, None]).ravel()
        # All runs are resampled at the same columns, so successes of two runs must not line up.
        table.append(np.random.default_rng(run).permutation(outcomes))
    return np.array(table, dtype=float)


def _mean(table: np.ndarray) -> Estimate:
    """Return the mean of a table (runs, units), with an interval over both."""
    if table.size < 2:
        return Estimate(float(table.mean()), None)

    def means(runs: np.ndarray, units: np.ndarray) -> np.ndarray:
        return table[runs[:, :, None], units[:, None]].mean(axis=(1, 2))

    return estimate_from(float(table.mean()), bootstrap(means, [(len(table),), (table.shape[1],)]))


def _suite(name: str) -> Suite | None:
    """Return a shipped suite, or None for one of Meta-World's; raise BidexError for another name."""
    if name in METAWORLD_SUITES:
        return None
    if name not in suite_names():
        raise BidexError(
            f"expected a shipped suite, got {name}: other people cannot play it. Submit a run on a shipped suite."
        )
    return load_suite(name)


def _faults_of_row(row: ClassRow, runs: int, tasks: range, episodes: int) -> Iterator[str]:
    """Yield the contradictions within a class of ``runs`` runs, ``tasks`` tasks and ``episodes`` of each."""
    counts = {len(of_run) for of_run in row.solved}
    if len(row.solved) != runs or len(counts) != 1 or min(counts) not in tasks:
        yield f"solved: expected {tasks[-1]} values of each of {runs} runs, got {[*map(len, row.solved)]}"
        return
    if max(map(max, row.solved)) > episodes:
        yield f"solved: expected at most {episodes} episodes of a task"
        return
    expected = class_row(row.solved, episodes)
    if abs(expected["success"] - row.success) > ROUNDING:
        yield f"success: expected the mean of its tasks, {expected['success']:.4f}, got {row.success:.4f}"
    given = row.interval
    wanted = expected["interval"]
    if given is None or wanted is None:
        apart = given is not wanted
    else:
        apart = max(abs(given[0] - wanted[0]), abs(given[1] - wanted[1])) > ROUNDING
    if apart:
        yield f"interval: expected that of its tasks, {wanted}, got {given}"
