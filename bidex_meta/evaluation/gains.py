"""Gains of adaptation: differences between two policies' episodes of the same tasks and starts, with intervals.

The bootstrap resamples runs (seeds), adaptations and, within each adaptation, episodes. An adaptation is one trial of a
task; the results of its episodes are correlated. If there are ``MANY_TASKS`` tasks or more, several trials of one task
are resampled within the task, because their results are correlated too. Intervals over few adaptations are too narrow.
We simulated five adaptations of ten episodes whose results depended more on the adaptation than on the episode: a
nominal 95 % interval contained the true value in 81 to 88 % of cases, and with three runs in 82 %. If adaptations do
not differ, the interval is slightly too wide. With a single adaptation, the interval does not cover the results that
another adaptation would give.
"""

from collections.abc import Callable, Mapping

import numpy as np

from bidex_meta.evaluation.results import MANY_TASKS, ClassResult, Difference, Evaluation
from bidex_meta.evaluation.statistics import estimate_from, generator_of_resamples, resampled_means
from bidex_meta.runs.evaluations import Gains

MEASURES: dict[str, Callable[[ClassResult], np.ndarray | None]] = {
    "return": lambda result: result.returns,
    "success": lambda result: result.successes,
    "score": lambda result: result.scores,
}
"""Measures by name: one value per episode, or None if a class does not have the measure."""


def paired_gains(after: Evaluation, before: Evaluation, adaptations: Mapping[str, np.ndarray]) -> Gains:
    """Return the gains of adaptation: the results ``after`` adaptation minus the results ``before``.

    Both policies must have played the same tasks and start states in the same order. ``adaptations`` holds, for each
    class, the number of the adaptation that each episode belongs to, ``(episodes,)``. All adaptations have the same
    number of episodes.
    """
    classes: dict[str, dict[str, Difference | None]] = {name: {} for name in after.classes}
    aggregate: dict[str, Difference | None] = {}
    for measure, values_of in MEASURES.items():
        means: list[float] = []
        resampled: list[np.ndarray] = []
        # One generator serves all classes, because equal draws in each class would correlate their errors.
        generator = generator_of_resamples()
        for name, result in after.classes.items():
            new = values_of(result)
            old = values_of(before.classes[name])
            if new is None or old is None:
                classes[name][measure] = None
                continue
            differences = grouped(new - old, adaptations[name])
            value = float(differences.mean())
            means.append(value)
            of_class = resampled_means(_by_task(differences, result, adaptations[name]), generator)
            if of_class is not None:
                resampled.append(of_class)
            classes[name][measure] = estimate_from(value, of_class)
        aggregate[measure] = _over_classes(means, resampled, len(classes))
    return Gains(classes, aggregate)


def _over_classes(means: list[float], resampled: list[np.ndarray], classes: int) -> Difference | None:
    """Return the mean over classes; None if a class is missing, because the rest is not a mean over all."""
    if len(means) < classes:
        return None
    if len(resampled) == classes:
        together = np.mean(resampled, axis=0)
    else:
        together = None
    return estimate_from(float(np.mean(means)), together)


def _by_task(differences: np.ndarray, result: ClassResult, adaptations: np.ndarray) -> np.ndarray:
    """Return differences (adaptations, episodes) as (tasks, trials, episodes), or as (1, adaptations, episodes).

    The second form is for fewer than ``MANY_TASKS`` tasks, and for tasks with a single trial each.
    """
    _, first = np.unique(adaptations, return_index=True)
    tasks = result.tasks[first]
    count = len(np.unique(tasks))
    if count < MANY_TASKS or count == len(tasks):
        return differences[None]
    return differences[np.argsort(tasks, kind="stable")].reshape(count, -1, differences.shape[1])


def grouped(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return values (groups, episodes per group) from values (n,) and the group number of each value (n,)."""
    return values[np.argsort(groups, kind="stable")].reshape(len(np.unique(groups)), -1)
