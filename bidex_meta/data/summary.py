"""What a data set holds, in numbers: episodes, returns, successes, and how much of the tasks and states it covers."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bidex_meta.data.dataset import Dataset
from bidex_meta.evaluation.references import Reference


@dataclass(frozen=True)
class ClassSummary:
    """One slot of a data set.

    Attributes:
        name: Its name.
        episodes: Episodes.
        steps: Transitions.
        length: Mean length of an episode, steps.
        returns: Unscaled returns: least, median, mean, largest.
        success: Share of episodes that met their goal.
        score: Mean normalised score, 0 what a policy that learned nothing gets, 100 the expert's; None where a
            reference is missing.
        tasks: Different tasks that were played.
        broken: Episodes that broken physics ended.
    """

    name: str
    episodes: int
    steps: int
    length: float
    returns: tuple[float, float, float, float]
    success: float
    score: float | None
    tasks: int
    broken: int


def summary(dataset: Dataset) -> list[ClassSummary]:
    """A summary of each slot that has episodes, from the tables alone."""
    table, found = dataset.table, []
    for number, name in enumerate(dataset.metadata["tasks"]):
        own = table["task"] == number
        if not own.any():
            continue
        returns, steps = table["return_unscaled"][own], table["steps"][own]
        scores = None
        if known := dataset.metadata.get("references", {}).get(name.partition("/")[0]):
            scores = Reference(known["random"], known.get("expert"), known.get("zero")).scores(returns)
        found.append(
            ClassSummary(
                name=name,
                episodes=int(own.sum()),
                steps=int(steps.sum()),
                length=float(steps.mean()),
                returns=(returns.min(), float(np.median(returns)), returns.mean(), returns.max()),
                success=float(table["success"][own].mean()),
                score=None if scores is None else float(scores.mean()),
                tasks=len(np.unique(table["task_index"][own])),
                broken=int(table["broken"][own].sum()),
            )
        )
    return found


def coverage(dataset: Dataset, most: int = 2000) -> dict[str, Any]:
    """How widely states and actions are spread, over episodes evenly spread over the data set.

    Args:
        dataset: The data set.
        most: Episodes to look at at most, from 1 on.

    Returns:
        ``observation_std`` by group of the observation: mean over its entries of the standard deviation over all
        states; ``constant``: share of its entries that never change; ``action_std``: mean over actions;
        ``action_at_bounds``: share of actions at -1 or 1.
    """
    every = max(1, math.ceil(dataset.num_episodes / most))
    d, a = dataset.observation_size, dataset.action_size
    count, taken = 0, 0
    sums, squares = np.zeros(d + a), np.zeros(d + a)
    low, high, bounds = np.full(d, np.inf), np.full(d, -np.inf), 0
    first = np.zeros(0)
    for number, episode in enumerate(dataset.episodes()):
        if number % every:
            continue
        values = np.concatenate([episode.observations[:-1], episode.actions], 1).astype(np.float64)
        if len(first) == 0:
            first = values[0].copy()
        values -= first  # sums of squares lose fewer digits
        sums, squares, count = sums + values.sum(0), squares + (values**2).sum(0), count + len(values)
        low = np.minimum(low, values[:, :d].min(0))
        high = np.maximum(high, values[:, :d].max(0))
        bounds, taken = bounds + int((np.abs(episode.actions) >= 1.0).sum()), taken + episode.actions.size
    std = np.sqrt(np.maximum(squares / count - (sums / count) ** 2, 0.0))
    groups = dataset.metadata.get("observation_groups", [["state", [[0, d]]]])
    where = {name: np.concatenate([np.arange(*part) for part in parts]) for name, parts in groups}
    return {
        "observation_std": {name: float(std[:d][own].mean()) for name, own in where.items()},
        "constant": {name: float((low[own] == high[own]).mean()) for name, own in where.items()},
        "action_std": float(std[d:].mean()),
        "action_at_bounds": bounds / max(taken, 1),
    }
