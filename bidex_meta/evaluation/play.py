"""How good is a policy: success and return per class, over a fixed number of episodes of every task.

The protocol: the world keeps each row on one task of its slot and does not reset by itself (autoreset DISABLED). Every
task is played ``episodes_per_task`` times, whole episodes, by the mean action; a task that ends early is not played
more often, so easy tasks cannot crowd out hard ones. An episode is a success if ``info["success"]`` was true at any
step; its return is the sum of the unscaled reward. An episode in which the physics broke is no success and counts with
the return of random actions, or its own if that is lower (``bidex_meta.evaluation.scores``).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.scores import Reference, counted_returns

Interval = tuple[float, float]
"""Lower and upper end of a 95 % bootstrap interval."""

EVALUATION_SEED = 1_000_000
"""Seed of the starts in evaluation: not a seed anybody trains with, so that they are new to the policy."""

RESAMPLES = 2000
BOOTSTRAP_SEED = 0
MANY_TASKS = 10
"""From so many tasks on, intervals resample tasks instead of episodes."""


class ZeroAgent:
    """Does nothing: action 0 everywhere.

    Args:
        action_space: The world's batched action space, shape ``(num_envs, action)``.
    """

    def __init__(self, action_space: Any):
        self._shape = action_space.shape

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Zeros ``(num_envs, action)`` on the device of ``obs``."""
        return torch.zeros(self._shape, device=obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Nothing is remembered."""


class RandomAgent:
    """Uniform actions, the same on every device.

    Args:
        action_space: The world's batched action space, a Box of shape ``(num_envs, action)``.
        seed: Of this agent's own generator.
    """

    def __init__(self, action_space: Any, seed: int = 0):
        self._low = torch.as_tensor(action_space.low)
        self._range = torch.as_tensor(action_space.high) - self._low
        self._generator = torch.Generator().manual_seed(seed)

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Uniform in the action space, ``(num_envs, action)`` on the device of ``obs``."""
        # Drawn on the CPU: a generator on a GPU gives other numbers for the same seed.
        return (self._low + self._range * torch.rand(self._range.shape, generator=self._generator)).to(obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Nothing is remembered."""


@dataclass(frozen=True)
class ClassResult:
    """The episodes of one class; arrays of shape ``(episodes,)``, in the order they were played."""

    returns: np.ndarray
    """Sum of the unscaled reward, float64; of broken episodes what they count with."""
    successes: np.ndarray
    """Success at any step, float64 0 or 1; 0 of broken episodes."""
    lengths: np.ndarray
    """Steps, int64."""
    tasks: np.ndarray
    """Index of the played task in the class's pool, int64."""
    unstable: int
    """Episodes that ended because the physics broke."""
    reference: Reference | None = None
    """What the normalised score and broken episodes are measured against, where it is known."""

    @property
    def episodes(self) -> int:
        """How many episodes were played."""
        return len(self.returns)

    @property
    def success(self) -> float:
        """Success rate in [0, 1]."""
        return float(self.successes.mean())

    @property
    def mean_return(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def score(self) -> float | None:
        """100 · (R − R_floor) / (R_expert − R_floor), the floor the better of random and zero actions.

        None where a reference is missing.
        """
        scores = self.scores
        return None if scores is None else float(scores.mean())

    @property
    def scores(self) -> np.ndarray | None:
        """The normalised score of every episode, ``(episodes,)``."""
        return None if self.reference is None else self.reference.scores(self.returns)

    def drawn(self, values: np.ndarray) -> np.ndarray:
        """``values`` (episodes,) as a bootstrap may resample them: means of tasks; of few tasks as they are.

        Episodes of a task are alike; where a class draws no starts (doors, Switch) a policy's are all the same, and
        counted singly they would feign precision.
        """
        names, task = np.unique(self.tasks, return_inverse=True)
        return values if len(names) < MANY_TASKS else np.bincount(task, values) / np.bincount(task)

    def to_json(self) -> dict[str, Any]:
        """Numbers of this class, ready for JSON."""
        return {
            "success": self.success,
            "success_interval": bootstrap_interval(_mean, self.drawn(self.successes)),
            "return": self.mean_return,
            "return_interval": bootstrap_interval(_mean, self.drawn(self.returns)),
            "length": float(self.lengths.mean()),
            "score": self.score,
            "episodes": self.episodes,
            "tasks": len(np.unique(self.tasks)),
            "unstable": self.unstable,
        }


@dataclass(frozen=True)
class Evaluation:
    """What ``evaluate`` found."""

    classes: dict[str, ClassResult]
    """Per class, by name, in the world's order of slots."""
    episodes_per_task: int
    """Episodes of every task."""

    def to_json(self) -> dict[str, Any]:
        """Everything but the single episodes, ready for JSON."""
        return {
            "episodes_per_task": self.episodes_per_task,
            "classes": {name: result.to_json() for name, result in self.classes.items()},
            "aggregate": {
                "success": aggregate([result.drawn(result.successes) for result in self.classes.values()]),
                "score": aggregate([_drawn_scores(result) for result in self.classes.values()]),
            },
        }


@dataclass(frozen=True)
class Difference:
    """Mean return of one policy above another's, in one class."""

    value: float
    """Difference of the means."""
    interval: Interval | None
    """95 % bootstrap interval, both policies' tasks (of few tasks: episodes) resampled; None with fewer than two."""

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)


def evaluate(
    agent: Agent,
    world: Any,
    episodes_per_task: int = 4,
    *,
    seed: int | None = None,
    references: Mapping[str, Reference] | None = None,
) -> Evaluation:
    """Play every task of ``world`` ``episodes_per_task`` times and report per class.

    Args:
        agent: The policy.
        world: A world in autoreset mode DISABLED with at least one row for each task. Rows that share a task share
            its episodes.
        episodes_per_task: Episodes of each task.
        seed: Passed to the world's reset; None keeps the world's own.
        references: Per class name, what the normalised score and broken episodes are measured against.

    Raises:
        BidexError: The world resets by itself, lacks rows, or ``episodes_per_task`` is not positive.
    """
    check_world(world, episodes_per_task)
    episodes = play_tasks(agent, world, episodes_per_task, seed)
    return Evaluation(results_by_class(world.task_names, episodes, references), episodes_per_task)


def play_tasks(agent: Agent, world: Any, episodes_per_task: int, seed: int | None) -> dict[str, np.ndarray]:
    """``episodes_per_task`` episodes of every task, as ``evaluate`` plays them.

    Returns:
        Arrays ``(episodes,)``: ``slot``, ``task`` (index in the slot's pool), ``return``, ``success``, ``length``,
        ``unstable``. The same world and seed give the same slots, tasks and starts in the same order.
    """
    obs, _ = world.reset(seed=seed)
    tasks = world.task_index.clone()
    remaining = quota(world, episodes_per_task)
    rounds: list[dict[str, torch.Tensor]] = []
    while bool((playing := remaining > 0).any()):
        if rounds:
            obs, _ = world.reset(options={"reset_mask": playing})
        agent.reset(playing)
        rounds.append({"row": torch.nonzero(playing).squeeze(1), **_play(agent, world, obs, playing)})
        remaining -= playing.long()
    episodes = {key: torch.cat([played[key] for played in rounds]).cpu().numpy() for key in rounds[0]}
    row = episodes.pop("row")
    return {"slot": world.task_id.cpu().numpy()[row], "task": tasks.cpu().numpy()[row], **episodes}


def results_by_class(
    names: Sequence[str],
    episodes: dict[str, np.ndarray],
    references: Mapping[str, Reference] | None = None,
    compared: Sequence[dict[str, np.ndarray]] = (),
) -> dict[str, ClassResult]:
    """Episodes by the names of their slots, broken ones as they count.

    Args:
        names: Of the slots.
        episodes: As ``play_tasks`` gives them.
        references: By name.
        compared: Episodes of the policies that this one is compared with: where there is no reference, a broken episode
            counts with the worst finished one of all of them.
    """
    classes = {}
    for slot, name in enumerate(names):
        own = {key: values[episodes["slot"] == slot] for key, values in episodes.items()}
        finished = [
            each["return"][(each["slot"] == slot) & ~each["unstable"].astype(bool)] for each in (episodes, *compared)
        ]
        broken, reference = own["unstable"].astype(bool), (references or {}).get(name)
        classes[name] = ClassResult(
            returns=counted_returns(own["return"], broken, reference, np.concatenate(finished)),
            successes=(own["success"] & ~broken).astype(np.float64),
            lengths=own["length"],
            tasks=own["task"],
            unstable=int(broken.sum()),
            reference=reference,
        )
    return classes


def compare(a: Evaluation, b: Evaluation) -> dict[str, Difference]:
    """Mean return of ``a`` minus that of ``b`` for every class both have, with a bootstrap interval.

    Args:
        a: For example the trained policy.
        b: For example a random one, over the same tasks.
    """
    differences = {}
    for name in (name for name in a.classes if name in b.classes):
        ours, theirs = (result.drawn(result.returns) for result in (a.classes[name], b.classes[name]))
        interval = bootstrap_interval(_mean_difference, ours, theirs)
        differences[name] = Difference(float(ours.mean() - theirs.mean()), interval)
    return differences


def aggregate(samples: list[np.ndarray | None]) -> dict[str, Any] | None:
    """Mean and interquartile mean over classes of the classes' means, the mean with a bootstrap interval.

    Args:
        samples: One array per class, of tasks or episodes (``ClassResult.drawn``); None in any of them gives None,
            since a mean over some of the classes would pass for one over all.
    """
    known = [sample for sample in samples if sample is not None]
    if not known or len(known) < len(samples):
        return None
    from scipy.stats import trim_mean

    means = np.array([sample.mean() for sample in known])
    return {
        "mean": float(means.mean()),
        "interval": bootstrap_interval(_mean_of_means, *known),
        "iqm": float(trim_mean(means, 0.25)),
    }


def bootstrap_interval(statistic: Callable[..., Any], *samples: np.ndarray) -> Interval | None:
    """The 95 % percentile bootstrap interval of ``statistic``, each sample resampled by itself.

    Args:
        statistic: Takes the samples and ``axis``, works along it.
        samples: Arrays ``(tasks,)`` or ``(episodes,)``.

    Returns:
        Lower and upper end; None where a sample has fewer than two episodes. The same for the same input.
    """
    if min(len(sample) for sample in samples) < 2:
        return None
    from scipy.stats import bootstrap

    result = bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLES,
        batch=200,  # bounds memory: all resamples at once would be 2000 times the episodes
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(BOOTSTRAP_SEED),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _drawn_scores(result: ClassResult) -> np.ndarray | None:
    scores = result.scores
    return None if scores is None else result.drawn(scores)


def _mean(sample: np.ndarray, axis: int = -1) -> Any:
    return np.mean(sample, axis=axis)


def _mean_difference(a: np.ndarray, b: np.ndarray, axis: int = -1) -> Any:
    return np.mean(a, axis=axis) - np.mean(b, axis=axis)


def _mean_of_means(*samples: np.ndarray, axis: int = -1) -> Any:
    return sum(np.mean(sample, axis=axis) for sample in samples) / len(samples)


def check_world(world: Any, episodes_per_task: int) -> None:
    """Refuse what cannot be evaluated on.

    Raises:
        BidexError: The world resets by itself or its names are not unique, or ``episodes_per_task`` is not positive.
    """
    if episodes_per_task < 1:
        raise BidexError(f"Episodes per task must be at least 1, not {episodes_per_task}.")
    mode = str(getattr(world.metadata["autoreset_mode"], "name", world.metadata["autoreset_mode"])).upper()
    if mode != "DISABLED":
        raise BidexError(f"Evaluation needs a world in autoreset mode DISABLED, but this one is in {mode}.")
    if len(set(world.task_names)) != len(world.task_names):
        raise BidexError(f"Results are kept by name, but the world's names are not unique: {world.task_names}.")


def quota(world: Any, episodes_per_task: int) -> torch.Tensor:
    """Episodes each row has to play, ``(num_envs,)``: those of a task are split over the rows that play it.

    Raises:
        BidexError: A task has no row.
    """
    tasks = world.task_index
    shares = torch.zeros_like(tasks)
    for slot, name in enumerate(world.task_names):
        for task in range(world.num_slot_tasks[slot]):
            rows = torch.nonzero((world.task_id == slot) & (tasks == task)).squeeze(1)
            if len(rows) == 0:
                needed = max(world.num_slot_tasks) * world.num_tasks
                raise BidexError(
                    f"No row plays task {task} of {name}: {world.num_envs} rows are too few for "
                    f"{sum(world.num_slot_tasks)} tasks. Use num_envs={needed}, or several times that."
                )
            share, extra = divmod(episodes_per_task, len(rows))
            shares[rows] = share
            shares[rows[:extra]] += 1
    return shares


@torch.no_grad()
def _play(agent: Agent, world: Any, obs: torch.Tensor, playing: torch.Tensor) -> dict[str, torch.Tensor]:
    """One episode in each row of ``playing``; its return, success, length, unstable, each ``(rows that played,)``."""
    running = playing.clone()
    returns = torch.zeros(world.num_envs, dtype=torch.float64, device=running.device)
    lengths = torch.zeros(world.num_envs, dtype=torch.int64, device=running.device)
    success, unstable = torch.zeros_like(running), torch.zeros_like(running)
    for _ in range(int(world.max_episode_steps.max())):
        obs, reward, terminated, truncated, info = world.step(agent.eval_action(obs))
        gained = info.get("reward_unscaled", reward).double()
        returns += torch.where(running, gained, torch.zeros_like(gained))
        lengths += running
        success |= running & info["success"]
        unstable |= running & info.get("unstable", torch.zeros_like(running))
        running &= ~(terminated | truncated)
        if not bool(running.any()):
            break
    else:
        raise RuntimeError(f"{int(running.sum())} rows did not end within their time limit; the world is at fault.")
    played = {"return": returns, "success": success, "length": lengths, "unstable": unstable}
    return {key: value[playing] for key, value in played.items()}
