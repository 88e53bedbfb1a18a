"""What a class of a suite can measure: how well one does without knowing its hidden parts, and whether rewards tell.

Blind ceiling and identifiability need no policy. They assume that the hidden parts are drawn independently and
uniformly, as ``TaskClass.variation_space`` is. Whether return and success agree is known from what policies got.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

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
_MOST_CENTRES = 1000
"""Final states among which a blind policy chooses."""
_SCORING = 25
"""Tasks that score the chosen state for each task that chooses it."""
_STEPS = 40
"""Steps of an episode whose rewards are fitted, evenly spread."""
_HOLD = 10
"""Steps for which an exploring action is held."""
_NOISE = 0.3
"""Share of rough actions in those of a policy."""


@dataclass(frozen=True)
class Alignment:
    """Whether who returns more also succeeds more, in a class."""

    rank: float
    """Rank-biserial correlation of return and success over all episodes: of a successful and an unsuccessful one, how
    much more often the first returns more than less. It reaches 1 whatever the share of successes; Spearman's does
    not."""
    solved: float
    """Mean return of the successful episodes."""
    unsolved: float
    """Largest mean return of a policy that never succeeds."""


def alignment(results: Mapping[str, ClassResult]) -> Alignment | None:
    """Of policies' results in one class, by policy; None where no episode succeeds, or no policy always fails."""
    returns, solved = (
        np.concatenate([getattr(result, name) for result in results.values()]) for name in ("returns", "successes")
    )
    good = returns[solved > 0.0]
    failing = [each for each in results.values() if not each.successes.any()]
    if not len(good) or not failing:
        return None
    pairs = len(good) * (len(returns) - len(good))
    wins = rankdata(returns)[solved > 0.0].sum() - len(good) * (len(good) + 1) / 2  # ties count half
    return Alignment(2.0 * wins / pairs - 1.0, float(good.mean()), max(each.mean_return for each in failing))


def blind_ceiling(task: TaskClass, draws: int = 20_000, seed: int = 0) -> float:
    """Estimate the share of unseen tasks that one final state can solve at best; 1 if nothing is hidden.

    It is the most that a policy without knowledge of the hidden parts can reach if success counts at the end. The state
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


def _solved(part: Hidden, values: Tensor, centre: Tensor) -> float:
    """Return the share of hidden values (n, k) that a state at ``centre`` (k,) solves."""
    return float((distances(part, values, centre) < part.tolerance).double().mean())


def distances(part: Hidden, values: Tensor, centre: Tensor) -> Tensor:
    """How far hidden values (n, k) are from others (k,) or (n, k), (n,): metres, rad, or 0 and infinity for a sign."""
    if part.kind == "sign":
        return torch.where((values < 0.0) == (centre < 0.0), 0.0, math.inf)[:, 0]
    if part.kind == "orientation":
        turns = [random_orientation(*each.expand_as(values).unbind(1)) for each in (values, centre)]
        return rotation_angle(multiply(turns[0], conjugate(turns[1])))
    return (values - centre).norm(dim=1)


@dataclass(frozen=True)
class Identified:
    """How well hidden parts are identified from the rewards of one exploring episode."""

    share: float
    """Of episodes: every part is fitted within its tolerance."""
    errors: np.ndarray
    """Largest error of a part in units of its tolerance, (episodes,)."""


def identifiability(world: World, explorer: Agent | None = None, seed: int = 0) -> Identified:
    """Plays one exploring episode in each environment, and fits the hidden parts to its rewards.

    ``world`` has one class, in autoreset mode DISABLED, an environment for each task. Exploring actions are those of
    ``explorer`` with noise, else rough ones: uniform, held for ten steps. The fit searches the class's ranges for what
    gives the rewards seen, knowing all else of the task.
    """
    (part,) = world.parts
    (member,) = part.group.members
    sensors, rewards, alive = _explore(world, explorer, seed)
    pool = torch.from_numpy(world.pools[0])[world.task_index]
    errors = []
    for row in range(world.num_envs):
        steps = alive[:, row].nonzero().squeeze(1)
        steps = steps[torch.linspace(0, len(steps) - 1, _STEPS).round().long().unique()]
        errors.append(_fit(member.scene, sensors[steps, row], rewards[steps, row], pool[row], seed + row))
    worst = np.array(errors)
    return Identified(float((worst < 1.0).mean()), worst)


def _explore(world: World, explorer: Agent | None, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Sensors (T, n, s), rewards and whether the step was of a running episode, (T, n)."""
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
    """States of some steps (T, s), each with every one of k variations: rows are step by step."""

    def __init__(self, sensors: Tensor, scene: Scene, frozen: dict[str, Tensor], k: int) -> None:
        super().__init__(sensors, scene.sensors, {n: v.repeat(len(sensors), 1) for n, v in frozen.items()})
        self._k = k

    def __getitem__(self, name: str) -> Tensor:
        return super().__getitem__(name).repeat_interleave(self._k, dim=0)


def _fit(scene: Scene, sensors: Tensor, rewards: Tensor, truth: Tensor, seed: int) -> float:
    """Largest error of a hidden part in units of its tolerance (of a sign: infinite where it is wrong).

    Least squares by Levenberg-Marquardt from the best of many random starts, derivatives by differences.
    """
    task = scene.task
    space = scene.task.variation_space
    parts = [(part, [space.names.index(name) for name in part.names]) for part in task.hides()]
    columns = [i for _, where in parts for i in where]
    low, high = (torch.tensor(ends, dtype=torch.float64)[columns] for ends in (space.low, space.high))

    def residuals(tried: Tensor) -> Tensor:
        """What hidden values (k, d) miss of the rewards, (k, T)."""
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
    found = truth.clone()
    found[columns] = x[off.square().sum(dim=1).argmin()]
    offs = [(part, float(distances(part, found[None, where], truth[where])[0])) for part, where in parts]
    return max(miss if part.kind == "sign" else miss / part.tolerance for part, miss in offs)
