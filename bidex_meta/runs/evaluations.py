"""The content of ``evaluation.json``: a policy's evaluation or a meta-test, read and written only by this module.

``bidex-meta evaluate --json`` prints the same content. Unknown entries are ignored. Entries that default to None may be
missing in a file.
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.utils.files import read_json
from bidex_meta.utils.validation import Environments, Few, Finite, Seed, Shots, Text, Threads, Whole, parse

_DERIVED = ("means over classes", "intervals")  # results that follow from those of the classes and their episodes

Interval = tuple[Finite, Finite]  # Lower and upper end of a 95 % bootstrap interval.
Engine = Literal["auto", "c", "warp"]


@dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval."""

    value: Finite
    interval: Interval | None  # 95 % bootstrap interval; None with fewer than two entries to resample

    @property
    def excludes_zero(self) -> bool:
        """Return True if the interval lies on one side of zero."""
        if self.interval is None:
            return False
        low, high = self.interval
        return low > 0 or high < 0

    def text(self, factor: float = 1.0, unit: str = "", form: str = ".1f") -> str:
        """Return the value times ``factor``, followed by the interval in brackets if there is one."""
        value = f"{factor * self.value:{form}}{unit}"
        if self.interval is None:
            return value
        low, high = self.interval
        return f"{value} [{factor * low:{form}}, {factor * high:{form}}]"


@dataclass(frozen=True)
class Aggregate:
    """A measure over all classes of an evaluation: statistics of the class means."""

    mean: Finite
    interval: Interval | None
    iqm: Finite  # interquartile mean


class ClassSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The results of one class without the individual episodes."""

    success: Finite
    success_interval: Interval | None = None
    success_once: Finite | None = None  # share of episodes solved at any step
    success_at_end: Finite | None = None  # share of episodes solved in their last steps
    mean_return: Finite = msgspec.field(name="return")
    return_interval: Interval | None = None
    length: Finite | None = None  # mean length, steps
    score: Finite | None = None  # mean score (``evaluation.references``); None if a reference is missing
    episode_steps: Few | None = None  # version 2: steps of a full episode; the score is 100 * return / episode_steps
    episodes: Whole | None = None
    tasks: Few | None = None
    unstable: Whole | None = None  # episodes that ended because the physics broke
    solved: list[Whole] | None = None  # successful episodes of each task, in ascending order of task number


Classes = Annotated[dict[str, ClassSummary], Meta(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The results of one policy on one set of tasks."""

    episodes_per_task: Few | None = None
    classes: Classes
    aggregate: dict[str, Aggregate | None] | None = None  # aggregates by measure: ``success`` and ``score``


@dataclass(frozen=True)
class Gains:
    """Differences of means by measure (``return``, ``success``, ``score``); None if a measure is missing."""

    classes: dict[str, dict[str, Estimate | None]]
    aggregate: dict[str, Estimate | None]
    """Mean over classes. Returns have a different scale in each class, so for several classes quote the score."""

    def to_json(self) -> Json:
        """Return the gains, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class SplitSummary:
    """A meta-test on the tasks of one split."""

    split: Text | None = None
    shots: Shots
    rollouts: Few
    trials: Few
    max_adapt_steps: Few | None = None
    adapt_steps: list[Whole] | None = None  # transitions that each shot adapted to
    before: Summary
    after: Summary
    gain: Gains | None = None
    by_shot: Annotated[list[Summary], Meta(min_length=1)]  # results after 0, 1, ..., ``shots`` shots
    rewards_shown: bool = False  # agents saw the rewards of these episodes; before 0.3.0 they did not
    hidden_by_shot: list[Summary] | None = None  # the same episodes played with their rewards hidden


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions that an evaluation's numbers depend on.

    An entry that is None was not recorded, or had its default value.
    """

    device: Text | None = None
    engine: Engine | None = None
    threads: Threads | None = None
    num_envs: Environments | None = None
    packages: dict[str, Text | None] = field(default_factory=dict)
    physics: Text | None = None
    suite_version: Whole | None = None
    suite_digest: Text | None = None


@dataclass(frozen=True, kw_only=True)
class OtherTasks:
    """The evaluation of a policy on tasks that its run was not trained on."""

    task_seed: Seed | None = None
    steps: Whole | None = None
    split: Text = "train"
    seed: Seed | None = None
    policy: Summary
    random: Summary | None = None
    return_above_random: dict[str, Estimate] | None = None


@dataclass(frozen=True, kw_only=True)
class PolicyEvaluation:
    """The evaluation of a policy that does not adapt."""

    run: Text | None = None
    steps: Whole | None = None  # environment steps that the policy was trained for
    split: Text = "train"
    seed: Seed | None = None  # seed of the episodes' starts
    policy: Summary
    random: Summary | None = None  # The results of a random policy on the same tasks.
    return_above_random: dict[str, Estimate] | None = None
    other_tasks: OtherTasks | None = None
    conditions: Conditions = Conditions()
    randomisation: Json | None = None

    @property
    def results(self) -> dict[str, ClassSummary]:
        """Return the results by the name of the class."""
        return self.policy.classes

    @property
    def all_results(self) -> dict[str, ClassSummary]:
        """Return the results that a verification compares: the results by class, also those on other tasks."""
        rows = dict(self.policy.classes)
        if self.other_tasks is not None:
            for name, row in self.other_tasks.policy.classes.items():
                rows[f"{name} (other tasks)"] = row
        return rows

    @property
    def unverified(self) -> list[str]:
        """Name the recorded results that a verification does not compare."""
        random = any(part is not None and part.random is not None for part in (self, self.other_tasks))
        return ["random policy"] * random + [*_DERIVED]


@dataclass(frozen=True, kw_only=True)
class MetaTestEvaluation:
    """The evaluation of a learner, or of a user's own agent, before and after it adapts."""

    run: Text | None = None
    agent: Text | None = None  # class of an agent that is not a run
    suite: Text | None = None  # suite of the agent's meta-test; a run's suite is in its config
    task_seed: Seed | None = None  # seed that drew the agent's tasks
    steps: Whole | None = None  # environment steps that the learner was meta-trained for
    seed: Seed | None = None  # seed of the episodes' starts
    splits: Annotated[dict[str, SplitSummary], Meta(min_length=1)]
    conditions: Conditions = Conditions()
    randomisation: Json | None = None

    @property
    def split(self) -> str:
        """Return ``train``, the split that a run trains on."""
        return "train"

    @property
    def results(self) -> dict[str, ClassSummary]:
        """Return the results after adaptation; the keys are class names followed by the split in brackets.

        The split is needed because in ML1 suites the train and test tasks are of the same class.
        """
        rows = {}
        for split, part in self.splits.items():
            for name, row in part.after.classes.items():
                rows[f"{name} ({split})"] = row
        return rows

    @property
    def all_results(self) -> dict[str, ClassSummary]:
        """Return the results that a verification compares; a key is a text that names class, split and shot.

        Results of episodes with hidden rewards are included.
        """
        rows = {}
        for split, part in self.splits.items():
            for text, shots in (("", part.by_shot), (", rewards hidden", part.hidden_by_shot or ())):
                for number, shot in enumerate(shots):
                    for name, row in shot.classes.items():
                        rows[f"{name} ({split}, shot {number}{text})"] = row
        return rows

    @property
    def unverified(self) -> list[str]:
        """Name the recorded results that a verification does not compare."""
        return ["gains", *_DERIVED]


Evaluated = PolicyEvaluation | MetaTestEvaluation


def unusual_settings(evaluation: Evaluated) -> list[str]:
    """Name an evaluation's split unless it is ``train``, and its randomisation if there is one."""
    settings = []
    if evaluation.split != "train":
        settings.append(f"split {evaluation.split}")
    if evaluation.randomisation is not None:
        settings.append("randomised")
    return settings


def read_evaluation(path: Path, again: str) -> Evaluated:
    """Read an ``evaluation.json``, or the output of ``bidex-meta evaluate --json``.

    Raises BidexError if the file cannot be read or holds something else; ``again`` is the command that writes it again.
    """
    try:
        return parse_evaluation(read_json(path, "an evaluation"), str(path))
    except BidexError as error:
        raise BidexError(f"{error} Write it again: {again}") from None


def parse_evaluation(content: object, where: str) -> Evaluated:
    """Return the evaluation in a file's content; raises BidexError, which begins with ``where``, for a wrong entry."""
    if not isinstance(content, dict) or "splits" not in content:
        return parse(content, PolicyEvaluation, where)
    evaluation = parse(content, MetaTestEvaluation, where)
    for name, split in evaluation.splits.items():
        for shot in (split.after, *split.by_shot):
            if missing := split.before.classes.keys() - shot.classes.keys():
                raise BidexError(f"{where}: splits.{name}: expected {min(missing)} after adaptation too, found none.")
    return evaluation


def write_evaluation(path: Path, evaluation: Evaluated) -> None:
    """Write an ``evaluation.json``, atomically."""
    write_json(path, evaluation_json(evaluation))


def evaluation_json(evaluation: Evaluated) -> Json:
    """Return the content of ``evaluation.json``."""
    content = _without_none(msgspec.to_builtins(evaluation))
    if "other_tasks" in content:
        content["other_tasks"] = _without_none(content["other_tasks"])
    return content


def _without_none(content: Json) -> Json:
    """Return the content without those top-level entries whose value is None."""
    return {name: value for name, value in content.items() if value is not None}
