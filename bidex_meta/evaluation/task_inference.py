"""Measures of whether a task class with hidden parts, such as its goal, is a valid test of adaptation.

The blind ceiling is the best success of a policy that does not know the hidden parts. Identifiability says whether
rewards are enough to infer the hidden parts. Neither needs a trained policy. Both assume that the hidden parts are
drawn independently and uniformly, as in ``TaskClass.variation_space``. For suites that list their tasks, use
``listed_ceiling`` instead of ``blind_ceiling``. The alignment of return and success is computed from the results of
policies.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.evaluation.results import ClassResult
from bidex_meta.tasks.aligned import Hidden
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import conjugate, multiply, random_orientation, rotation_angle
from bidex_meta.world import World

_CANDIDATES = 512
_STARTS = 24
_ROUNDS = 25
_MOST_CENTRES = 1000  # Final states among which a blind policy chooses.
_SCORING = 25  # Tasks that score the chosen state for each task that chooses it.
_STEPS = 40  # Number of an episode's steps whose rewards are fitted, evenly spread.
_HOLD = 10  # Number of steps for which an exploring action is held.
_NOISE = 0.3  # Weight of the rough action that is added to a policy's action.


@dataclass(frozen=True)
class Alignment:
    """The agreement of return and success in a class."""

    rank: float
    """Rank-biserial correlation of return and success over all episodes: for pairs of a successful and an unsuccessful
    episode, the share in which the successful one returns more minus the share in which it returns less. Unlike
    Spearman's correlation it can reach 1 for any share of successes."""
    solved: float  # Mean return of the successful episodes.
    unsolved: float  # Largest mean return among the policies that never succeed.


def alignment(results: Mapping[str, ClassResult]) -> Alignment | None:
    """Measure how well return and success agree in one class, from the results of several policies.

    ``results`` holds the results by name of the policy. The measure needs at least one successful episode and at least
    one policy that never succeeds. If either is missing, the result is None.
    """
    returns = np.concatenate([result.returns for result in results.values()])
    solved = np.concatenate([result.successes for result in results.values()])
    good = returns[solved > 0.0]
    failing = [result.mean_return for result in results.values() if not result.successes.any()]
    if not len(good) or not failing:
        return None
    pairs = len(good) * (len(returns) - len(good))
    wins = rankdata(returns)[solved > 0.0].sum() - len(good) * (len(good) + 1) / 2  # ties count half
    return Alignment(2.0 * wins / pairs - 1.0, float(good.mean()), max(failing))


def blind_ceiling(task: TaskClass, draws: int = 20_000, seed: int = 0) -> float:
    """Estimate the share of unseen tasks that one final state can solve at best; 1 if nothing is hidden.

    This is the highest success of a policy that does not know the hidden parts, if success counts at the end. The state
    is chosen on ``draws`` tasks and scored on others: the best of many states would look too good on the tasks that
    choose it.
    """
    space = task.variation_space
    values = torch.from_numpy(space.sample(np.random.default_rng(seed), (1 + _SCORING) * draws))
    choosing = values[:draws]
    scoring = values[draws:]
    share = 1.0
    for part in task.hides():
        columns = [space.names.index(name) for name in part.names]
        candidates = choosing[:_MOST_CENTRES, columns]
        best = max(candidates, key=lambda centre: _solved(part, choosing[:, columns], centre))
        share *= _solved(part, scoring[:, columns], best)
    return share


def listed_ceiling(task: TaskClass, tasks: np.ndarray) -> float:
    """Compute the largest share of the given tasks (n, size) that a final state solves; 1 if nothing is hidden.

    The candidates are each task's own goal and the points midway between two goals, where the tolerances of these goals
    overlap most. If tasks hide several numbers, another final state may solve more. All hidden parts of a task must be
    solved together, so goals that vary together stay together.
    """
    space = task.variation_space
    values = torch.from_numpy(tasks)
    first, second = torch.triu_indices(len(values), len(values))
    candidates = 0.5 * (values[first] + values[second])
    best = 0.0
    for candidate in candidates.unique(dim=0):
        solved = torch.ones(len(values), dtype=torch.bool)
        for part in task.hides():
            columns = [space.names.index(name) for name in part.names]
            solved &= distances(part, values[:, columns], candidate[columns]) < part.tolerance
        best = max(best, float(solved.double().mean()))
    return best


def _solved(part: Hidden, values: Tensor, centre: Tensor) -> float:
    """Return the share of hidden values (n, k) that a state at ``centre`` (k,) solves."""
    return float((distances(part, values, centre) < part.tolerance).double().mean())


def distances(part: Hidden, values: Tensor, centre: Tensor) -> Tensor:
    """Return distances (n,) of hidden values (n, k) from ``centre`` (k,) or (n, k), in m or rad.

    For a sign the distance is 0 or infinity.
    """
    if part.kind == "sign":
        return torch.where((values < 0.0) == (centre < 0.0), 0.0, math.inf)[:, 0]
    if part.kind == "orientation":
        own = random_orientation(*values.unbind(1))
        other = random_orientation(*centre.expand_as(values).unbind(1))
        return rotation_angle(multiply(own, conjugate(other)))
    return (values - centre).norm(dim=1)


@dataclass(frozen=True)
class Identified:
    """Errors of a task's hidden values, as inferred from the rewards of one exploring episode."""

    share: float  # Share of episodes in which every part is fitted within its tolerance.
    errors: np.ndarray  # Largest error of a part in units of its tolerance, (episodes,).


def identifiability(world: World, explorer: Agent | None = None, seed: int = 0) -> Identified:
    """Play one exploring episode in each environment, and infer the hidden values from its rewards.

    ``world`` has one class, one environment per task, and is in autoreset mode DISABLED. Exploring actions are those of
    ``explorer`` with noise; without an explorer they are uniform random actions, each held for ten steps. The fit
    searches the class's ranges for the hidden values that best explain the rewards. All other values of the task are
    given to the fit.
    """
    (part,) = world.parts
    (member,) = part.group.members
    sensors, rewards, alive = _explore(world, explorer, seed)
    pool = torch.from_numpy(world.pools[0])[world.task_index]
    errors = []
    for row in range(world.num_envs):
        steps = alive[:, row].nonzero().squeeze(1)
        if len(steps) == 0:  # the physics broke in the first step
            errors.append(math.inf)
            continue
        steps = steps[torch.linspace(0, len(steps) - 1, _STEPS).round().long().unique()]
        errors.append(_fit(member.scene, sensors[steps, row], rewards[steps, row], pool[row], seed + row))
    worst = np.array(errors)
    return Identified(float((worst < 1.0).mean()), worst)


def _explore(world: World, explorer: Agent | None, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return sensors (T, n, s), rewards (T, n), and the steps that belong to a running episode, bool (T, n)."""
    obs, _ = world.reset(seed=seed)
    if explorer is not None:
        explorer.reset(torch.ones(world.num_envs, dtype=torch.bool))
    generator = torch.Generator().manual_seed(seed)
    engine = world.parts[0].group.engine
    sensors = []
    rewards = []
    alive = []
    running = torch.ones(world.num_envs, dtype=torch.bool)
    action = rough = torch.zeros(world.num_envs, world.action_size)
    for step in range(int(world.max_episode_steps.max())):
        if step % _HOLD == 0:
            rough = 2.0 * torch.rand(action.shape, generator=generator) - 1.0
        if explorer is None:
            action = rough
        else:
            action = explorer.eval_action(obs) + _NOISE * rough
        obs, _, terminated, truncated, info = world.step(action)
        sensors.append(engine.sensordata.cpu().clone())
        rewards.append(info["reward_unscaled"].cpu())
        alive.append(running & ~info["unstable"].cpu())
        running = running & ~(terminated | truncated).cpu()
    return torch.stack(sensors), torch.stack(rewards), torch.stack(alive)


class _EachWith(TaskState):
    """Task state that combines the recorded sensors of T steps with each of k candidate variations of the task.

    Sensors are (T, s). A value of the state has the shape (T k, ...): all variations of the first step, then all
    variations of the second step, and so on.
    """

    def __init__(self, sensors: Tensor, scene: Scene, frozen: dict[str, Tensor], k: int) -> None:
        super().__init__(sensors, scene.sensors, {n: v.repeat(len(sensors), 1) for n, v in frozen.items()})
        self._k = k

    def __getitem__(self, name: str) -> Tensor:
        return super().__getitem__(name).repeat_interleave(self._k, dim=0)


def _fit(scene: Scene, sensors: Tensor, rewards: Tensor, truth: Tensor, seed: int) -> float:
    """Infer the hidden values of a task from the rewards of an episode, and return the error of the worst hidden part.

    The error is in units of the part's tolerance, and infinite for a wrong sign. ``sensors`` (T, s) and ``rewards``
    (T,) are those of the episode's steps; ``truth`` is the true variation. The fit minimises the sum of squared
    differences of the rewards by Levenberg-Marquardt, from the best of many random starts, with derivatives by finite
    differences.
    """
    task = scene.task
    space = scene.task.variation_space
    parts = [(part, [space.names.index(name) for name in part.names]) for part in task.hides()]
    columns = list(chain.from_iterable(where for _, where in parts))
    low, high = (torch.tensor(ends, dtype=torch.float64)[columns] for ends in (space.low, space.high))

    def residuals(tried: Tensor) -> Tensor:
        """Return the differences (k, T) between the rewards for hidden values (k, d) and the given rewards."""
        variations = truth.repeat(len(tried), 1)
        variations[:, columns] = tried
        state = _EachWith(sensors, scene, task.frozen(variations), len(tried))
        given = torch.stack(list(task.rewards(state).values())).sum(dim=0).view(len(sensors), -1)
        return (given - rewards[:, None]).T

    generator = torch.Generator().manual_seed(seed)
    tried = low + (high - low) * torch.rand(_CANDIDATES, len(columns), generator=generator, dtype=torch.float64)
    x = tried[residuals(tried).square().sum(dim=1).argsort()[:_STARTS]]
    off = residuals(x)
    damping = torch.ones(_STARTS, 1, 1, dtype=torch.float64)
    step = 1e-4 * torch.diag(high - low)
    for _ in range(_ROUNDS):
        moved = residuals((x[:, None] + step).flatten(0, 1)).unflatten(0, (_STARTS, -1))
        slope = (moved - off[:, None]) / step.diagonal()[:, None]  # (starts, d, T)
        square = slope @ slope.mT
        scale = torch.diag_embed(square.diagonal(dim1=1, dim2=2) + 1e-12)
        change = torch.linalg.solve(square + damping * scale, slope @ off[:, :, None])[:, :, 0]
        new = (x - change).clamp(low, high)
        new_off = residuals(new)
        better = new_off.square().sum(dim=1) < off.square().sum(dim=1)
        x = torch.where(better[:, None], new, x)
        off = torch.where(better[:, None], new_off, off)
        damping = torch.where(better[:, None, None], 0.3 * damping, 5.0 * damping).clamp(1e-6, 1e6)
    fitted = truth.clone()
    fitted[columns] = x[off.square().sum(dim=1).argmin()]
    errors = []
    for part, where in parts:
        error = float(distances(part, fitted[None, where], truth[where])[0])
        errors.append(error if part.kind == "sign" else error / part.tolerance)
    return max(errors)
