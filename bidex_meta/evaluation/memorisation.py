"""Probes that guess a task from the first observations of its episodes.

A learner that can name the task from its first observation may learn the train tasks by heart instead of adapting (Yin
et al. 2020, arXiv 1912.03820). There are four probes. The nearest neighbour among other episodes and a ridge regression
on other episodes guess the task, or the hidden values and with them the task that is nearest. If observations do not
reveal the task, no probe does better than chance. If they show the goal, the regression of hidden values finds the task
even where fifty tasks lie along one number, which a regression of labels cannot separate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bidex_meta.world import World

_FOLDS = 5
_GUESSES = 500
"""Guesses of each class, over all of its tasks: the share of correct guesses has a standard error of at most 2.3
points."""
_RIDGES = (1e-4, 1e-2, 1.0, 100.0)
"""Weights of the ridge penalty per sample, for standardised observations. Part of the training samples choose one."""


@dataclass(frozen=True)
class Memorised:
    """Results of the probes for one class."""

    named: float
    """Share of the episodes whose task the best probe guesses correctly."""
    chance: float
    """The same share for random guesses: one over the number of tasks."""
    explained: float
    """R² of the hidden values, predicted for unseen tasks by the better probe; at most 0 if nothing shows them."""


def memorised(world: World, episodes: int | None = None, seed: int = 0) -> dict[str, Memorised]:
    """Return how well probes guess tasks from first observations, by class; the world has one environment per task.

    The world is reset ``episodes`` times, each time with new starts. If ``episodes`` is None, it is reset until each
    class has 500 guesses, so that a class with few tasks is measured as precisely as a class with many. A probe that
    guesses the task's name learns from the other resets. A probe that guesses the hidden values learns from the other
    tasks.
    """
    if episodes is None:
        fewest = min(rows.stop - rows.start for rows in world.slot_env_ids)
        episodes = max(_FOLDS, math.ceil(_GUESSES / fewest))
    starts = np.stack([world.reset(seed=seed + number)[0].cpu().double().numpy() for number in range(episodes)])
    found = {}
    for index, (name, rows) in enumerate(zip(world.task_names, world.slot_env_ids, strict=True)):
        seen = _standardised(starts[:, rows])
        tasks = world.task_index[rows].cpu().numpy()
        labels = np.eye(int(tasks.max()) + 1)[tasks]
        hidden = world.pools[index][tasks]
        targets = np.broadcast_to(labels, (episodes, *labels.shape))
        resets = np.arange(episodes)[:, None].repeat(len(tasks), 1)
        guesses = _guesses(seen, targets, resets)
        values = np.broadcast_to(hidden, (episodes, *hidden.shape))
        named = [guess.argmax(-1) for guess in guesses]
        named += [_nearest_task(guess, world.pools[index]) for guess in _guesses(seen, values, resets)]
        explained = max(_r2(guess, values) for guess in _guesses(seen, values, tasks[None].repeat(episodes, 0)))
        best = max(float((tasks == guess).mean()) for guess in named)
        found[name] = Memorised(best, 1.0 / labels.shape[1], explained)
    return found


def _standardised(starts: np.ndarray) -> np.ndarray:
    """Return observations (episodes, n, d) with mean 0 and standard deviation 1; entries that never change are 0."""
    deviation = starts.std((0, 1))
    changing = deviation > 1e-9
    return np.where(changing, (starts - starts.mean((0, 1))) / np.where(changing, deviation, 1.0), 0.0)


def _guesses(seen: np.ndarray, targets: np.ndarray, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cross-validated predictions of ``targets`` (episodes, n, k) by two probes.

    These are the nearest neighbour and a ridge regression on the observations ``seen`` (episodes, n, d). Samples
    with the same number in ``groups`` (episodes, n) are in the same fold. A fold is predicted from all other folds.
    """
    x = seen.reshape(-1, seen.shape[-1])
    y = targets.reshape(-1, targets.shape[-1])
    fold = groups.reshape(-1) % _FOLDS
    nearest = np.zeros_like(y)
    linear = np.zeros_like(y)
    for number in range(_FOLDS):
        test = fold == number
        train = ~test
        distances = (x[test] ** 2).sum(1)[:, None] + (x[train] ** 2).sum(1) - 2.0 * x[test] @ x[train].T
        nearest[test] = y[train][distances.argmin(1)]
        choosing = fold == (number + 1) % _FOLDS
        errors = [((part - y[choosing]) ** 2).sum() for part in _ridge(x, y, train & ~choosing, choosing, _RIDGES)]
        (linear[test],) = _ridge(x, y, train, test, (_RIDGES[int(np.argmin(errors))],))
    return nearest.reshape(targets.shape), linear.reshape(targets.shape)


def _ridge(
    x: np.ndarray, y: np.ndarray, train: np.ndarray, test: np.ndarray, weights: Sequence[float]
) -> list[np.ndarray]:
    """Return the predictions of ``y`` (n, k) for the samples in ``test``, one for each weight of the penalty.

    ``train`` and ``test`` are masks (n,) of the samples ``x`` (n, d).
    """
    mean = y[train].mean(0)
    values, vectors = np.linalg.eigh(x[train].T @ x[train])
    inputs = x[test] @ vectors
    outputs = vectors.T @ (x[train].T @ (y[train] - mean))
    penalties = [weight * train.sum() for weight in weights]
    return [mean + inputs @ (outputs / (np.maximum(values, 0.0) + penalty)[:, None]) for penalty in penalties]


def _nearest_task(guess: np.ndarray, pool: np.ndarray) -> np.ndarray:
    """Return the tasks of ``pool`` (tasks, k) that are nearest to guesses (episodes, n, k) of their hidden values."""
    scale = pool.std(0)
    scale = np.where(scale > 1e-12, scale, 1.0)
    gaps = (guess[..., None, :] - pool) / scale
    return (gaps**2).sum(-1).argmin(-1)


def _r2(guess: np.ndarray, values: np.ndarray) -> float:
    """Return the explained share of the variance, averaged over the columns that change."""
    left = ((values - guess) ** 2).mean((0, 1))
    all_of_it = values.var((0, 1))
    changing = all_of_it > 1e-12
    if not changing.any():
        return 0.0
    return float((1.0 - left[changing] / all_of_it[changing]).mean())
