"""The cross-entropy method over whole episodes, starting from an earlier episode.

It solves tasks on which a receding horizon gives up too early. In TwoCatchUnderarm one caught egg earns more reward
than two eggs in the air, so a plan of forty steps does not throw the other egg. Here a whole episode is scored by its
return and by the smallest of the reward's terms. A single caught egg does not raise the smallest term.
"""

import numpy as np
import torch
from torch import Tensor

from bidex_meta.witness.replay import SEED, Simulator, Trace
from bidex_meta.witness.store import quantised
from tools.witness_search.planner import interpolation

_SAMPLES, _ELITES, _KEPT = 256, 14, 10
_SPACING = 3
"""Control steps between knots."""
_STD, _LEAST_STD = 0.4, 0.12
_SUCCESS, _LASTING = 5.0, 0.2
"""Bonuses, in units of return, for an episode that succeeds and for each of its successful steps."""


def searched(name: str, actions: np.ndarray, rounds: int, seed: int = 0, threads: int | None = None) -> np.ndarray:
    """Return the last round's best episode, (T, action_size), in multiples of 1/127; print each round's best result.

    The search begins with ``actions`` (T, action_size), whose last action is held. A round plays 256 episodes; rounds
    alternate between the start and a shifted start.
    """
    simulator, generator = Simulator(name, _SAMPLES, threads), torch.Generator().manual_seed(seed)
    steps = simulator.episode_steps
    states = simulator.starts(1, seed=1 + SEED + seed)
    base = torch.from_numpy(actions)[torch.arange(steps).clamp(max=len(actions) - 1)]
    knots = steps // _SPACING + 1
    weights = interpolation(steps, knots)
    mean = torch.linalg.lstsq(weights, base).solution
    rest = base - weights @ mean  # the part that the knots cannot represent stays unchanged
    std, elites, best = torch.full_like(mean, _STD), mean[None], base
    for number in range(rounds):
        tried = _tries(mean, std, elites, generator)
        played = quantised(torch.einsum("tk,nka->tna", weights, tried) + rest[:, None])
        simulator.load([states[number % len(states)]])
        trace = simulator.play(played)
        order = _worth(trace).argsort(descending=True)
        chosen, elites = tried[order[:_ELITES]], tried[order[:_KEPT]]
        mean = 0.5 * (mean + chosen.mean(0))
        std = (0.6 * std + 0.4 * chosen.std(0)).clamp(min=_LEAST_STD)
        best = played[:, order[0]]
        total, least = (float(each[:, order[0]].sum()) for each in (trace.rewards, trace.least))
        solved = int(trace.success.any(0).sum())
        print(f"round {number}, return {total:.3f}, least term {least:.3f}, {solved} succeed", flush=True)
    simulator.close()
    return best.numpy()


def _worth(trace: Trace) -> Tensor:
    lasting = trace.success.double().sum(0)
    return (trace.rewards + trace.least).sum(0) + _SUCCESS * trace.success.any(0) + _LASTING * lasting


def _tries(mean: Tensor, std: Tensor, elites: Tensor, generator: torch.Generator) -> Tensor:
    """Return knots to try (samples, K, a): the elites, mutants of the elites, draws around the mean."""
    knots, size = mean.shape
    count = _SAMPLES - len(elites)
    scale = torch.logspace(0.0, -1.3, count)[:, None, None]
    drawn = mean + scale * std * torch.randn(count, knots, size, generator=generator)
    parents = elites[torch.randint(len(elites), (count * 2 // 3,), generator=generator)]
    drawn[: len(parents)] = _mutants(parents, generator)
    return torch.cat((elites, drawn.clamp(-1.0, 1.0)))


def _mutants(parents: Tensor, generator: torch.Generator) -> Tensor:
    """Return parents (n, K, a), each changed in some of its actions for some time."""
    count, knots, size = parents.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    middle, width = knots * uniform(count, 1), 1.0 + 6.0 * uniform(count, 1)
    within = (torch.arange(knots) - middle).abs() < width
    changed = within[:, :, None] & (uniform(count, 1, size) < 0.03 + 0.3 * uniform(count, 1, 1))
    far = (3.0 * uniform(count, 1, 1) - 3.5).exp()
    return torch.where(changed, parents + far * torch.randn(parents.shape, generator=generator), parents)
