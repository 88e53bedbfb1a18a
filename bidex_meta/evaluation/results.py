"""Results of an evaluation: the episodes of each class, and their statistics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import to_builtins

from bidex_meta.evaluation.references import Reference, counted_returns
from bidex_meta.evaluation.statistics import aggregate, estimate, mean, mean_difference
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary, Estimate, Summary
from bidex_meta.utils.arguments import checked_arguments

MANY_TASKS = 5
"""Number of tasks from which intervals resample tasks instead of episodes.

We simulated five tasks of ten episodes that differ much in difficulty: nominal 95 % intervals over tasks contained the
true value in 87 % of cases, intervals over episodes in 55 %. With ten tasks of four episodes it was 92 and 79 %. Suites
with up to four tasks per class list all goals that there are.
"""


@dataclass(frozen=True)
class ClassResult:
    """The episodes of one class; arrays of shape ``(episodes,)``, in the order they were played."""

    returns: np.ndarray  # sum of the unscaled reward, float64; broken episodes: ``counted_returns``
    successes: np.ndarray  # success by the suite's rule, float64 0 or 1; 0 for broken episodes
    lengths: np.ndarray  # steps, int64
    tasks: np.ndarray  # index of the played task in the class's pool, int64
    unstable: int  # episodes that ended because the physics broke
    reference: Reference | None = None  # for the score and broken episodes, if known
    once: float | None = None  # share of episodes solved at any step
    at_end: float | None = None  # share of episodes solved in their last steps (``suite.HELD_STEPS``)

    @property
    def episodes(self) -> int:
        """Return the number of episodes."""
        return len(self.returns)

    @property
    def success(self) -> float:
        """Return the success rate in [0, 1]."""
        return float(self.successes.mean())

    @property
    def mean_return(self) -> float:
        """Return the mean return."""
        return float(self.returns.mean())

    @property
    def score(self) -> float | None:
        """Return the mean score; None if a reference is missing."""
        scores = self.scores
        if scores is None:
            return None
        return float(scores.mean())

    @property
    def scores(self) -> np.ndarray | None:
        """Return the score of each episode, ``(episodes,)``; None if a reference is missing."""
        if self.reference is None:
            return None
        return self.reference.scores(self.returns)

    def drawn(self, values: np.ndarray) -> np.ndarray:
        """Return the sample that a bootstrap of ``values`` (episodes,) should resample.

        The sample holds the mean of each task, because episodes of one task are alike, so that resampling them
        separately would make intervals too narrow. With fewer than ``MANY_TASKS`` tasks, it is ``values`` itself.
        """
        means = self.task_means(values)
        if len(means) < MANY_TASKS:
            return values
        return means

    def task_means(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of ``values`` (episodes,) in each task, in ascending order of task number."""
        _, task = np.unique(self.tasks, return_inverse=True)
        return np.bincount(task, values) / np.bincount(task)

    @property
    def solved(self) -> list[int]:
        """Return the number of successful episodes of each task, in ascending order of task number."""
        _, task = np.unique(self.tasks, return_inverse=True)
        return np.bincount(task, self.successes).astype(int).tolist()

    def summary(self) -> ClassSummary:
        """Return the results without the individual episodes."""
        return ClassSummary(
            success=self.success, success_interval=estimate(mean, self.drawn(self.successes)).interval,
            success_once=self.once, success_at_end=self.at_end,
            mean_return=self.mean_return, return_interval=estimate(mean, self.drawn(self.returns)).interval,
            length=float(self.lengths.mean()), score=self.score, episodes=self.episodes,
            episode_steps=None if self.reference is None else self.reference.episode_steps,
            tasks=len(np.unique(self.tasks)), unstable=self.unstable, solved=self.solved,
        )  # fmt: skip


@dataclass(frozen=True)
class Evaluation:
    """The results of ``evaluate``."""

    classes: dict[str, ClassResult]  # per class, by name, in the world's order of slots
    episodes_per_task: int  # number of episodes of every task

    @property
    def success(self) -> float:
        """Return the mean over classes of the success rate, in [0, 1]."""
        rates = [result.success for result in self.classes.values()]
        return sum(rates) / len(rates)

    def summary(self) -> Summary:
        """Return the results without the individual episodes."""
        results = self.classes.values()
        return Summary(
            episodes_per_task=self.episodes_per_task,
            classes={name: result.summary() for name, result in self.classes.items()},
            aggregate={
                "success": aggregate([result.drawn(result.successes) for result in results]),
                "score": aggregate([_drawn_scores(result) for result in results]),
            },
        )

    def to_json(self) -> Json:
        """Return the results without the individual episodes, ready for JSON."""
        return to_builtins(self.summary())


Difference = Estimate  # of two policies' mean returns in a class; tasks (episodes, if tasks are few) are resampled


def results_by_class(
    names: Sequence[str], episodes: dict[str, np.ndarray], references: Mapping[str, Reference] | None = None,
    compared: Sequence[dict[str, np.ndarray]] = ()
) -> dict[str, ClassResult]:  # fmt: skip
    """Group by class the episodes that ``play_tasks`` returned, and compute the result of each class.

    ``names`` are the names of the world's classes. ``counted_returns`` corrects the returns of episodes whose physics
    broke. ``compared`` holds the episodes of the policies with which this policy is compared.
    """
    classes = {}
    for slot, name in enumerate(names):
        own = {key: values[episodes["slot"] == slot] for key, values in episodes.items()}
        finished = []
        for played in (episodes, *compared):
            finished.append(played["return"][(played["slot"] == slot) & ~played["unstable"].astype(bool)])
        broken = own["unstable"].astype(bool)
        reference = _reference(references or {}, name)
        classes[name] = ClassResult(
            returns=counted_returns(own["return"], broken, reference, np.concatenate(finished)),
            successes=(own["success"] & ~broken).astype(np.float64), lengths=own["length"], tasks=own["task"],
            unstable=int(broken.sum()), reference=reference, once=_share(own, "once", broken),
            at_end=_share(own, "at_end", broken),
        )  # fmt: skip
    return classes


def _reference(references: Mapping[str, Reference], name: str) -> Reference | None:
    """Return the reference of a slot; a slot of one listed task, ``class/task``, has that of its class in version 2."""
    of_class = references.get(name.partition("/")[0])
    if name not in references and of_class is not None and of_class.episode_steps is not None:
        return of_class
    return references.get(name)


def _share(episodes: dict[str, np.ndarray], name: str, broken: np.ndarray) -> float | None:
    """Return the share of episodes that are solved and whose physics did not break.

    ``name`` is the array of successes to use, such as ``once`` (solved at any step). The result is None if ``episodes``
    has no such array.
    """
    if name not in episodes:
        return None
    return float((episodes[name] & ~broken).mean())


@checked_arguments
def compare(a: Evaluation, b: Evaluation) -> dict[str, Difference]:
    """Return the mean return of ``a`` minus that of ``b`` for each class that both have, with a bootstrap interval."""
    differences = {}
    for name, ours in a.classes.items():
        if name in b.classes:
            theirs = b.classes[name]
            differences[name] = estimate(mean_difference, ours.drawn(ours.returns), theirs.drawn(theirs.returns))
    return differences


def _drawn_scores(result: ClassResult) -> np.ndarray | None:
    scores = result.scores
    return None if scores is None else result.drawn(scores)
