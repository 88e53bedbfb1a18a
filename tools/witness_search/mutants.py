"""Changed copies of good plans, which a search tries in addition to draws around the mean."""

import torch
from torch import Tensor

from bidex_meta.hands.hand import hand

FINEST = 0.05
"""Standard deviation of the finest changes, as a share of the standard deviation of the coarsest changes. Large changes
find a way, small changes improve it."""


def mutants(elites: Tensor, count: int, std: float, mutated: float, generator: torch.Generator) -> Tensor:
    """Return ``count`` mutants (count, K, a), that is, changed copies of good plans, ``elites`` (E, K, a).

    A plan has K knots: points in time for which it gives the actions (a,). Three properties of each mutant are random,
    with probability 1/2 each:

    1. It takes the left hand's actions from another elite, because good actions of one hand seldom depend on the other.
    2. It changes each action with probability ``mutated``. Otherwise it changes all actions of one part of the hands,
       so that a grip can be carried somewhere, or a base stays while its fingers close.
    3. It changes a random half of the knots, each by its own amount. Otherwise it changes all knots from a random time
       on by the same amount.

    ``std`` is the standard deviation of the coarsest changes.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    knots, size = elites.shape[1:]
    parents, others = (elites[torch.randint(len(elites), (count,), generator=generator)] for _ in range(2))
    crossed = (uniform(1, 1) < 0.5) & (torch.arange(size) >= size // 2)
    parents = torch.where(crossed, others, parents)
    parts = parts_of_the_hands(size)
    part = parts[torch.randint(len(parts), (count,), generator=generator)][:, None]
    which = torch.where(uniform(1, 1) < 0.5, uniform(1, size) < mutated, part)
    noise = torch.randn(count, knots, size, generator=generator)
    since = torch.arange(knots)[:, None] >= torch.randint(knots, (count, 1, 1), generator=generator)
    change = torch.where(uniform(1, 1) < 0.5, noise * (uniform(knots, 1) < 0.5), noise[:, :1] * since)
    return parents + std * FINEST ** uniform(1, 1) * which * change


def parts_of_the_hands(size: int) -> Tensor:
    """Return masks of actions, bool (parts, size).

    There is one mask for each hand's fingers, each base's force, each base's torque, and both bases' forces together.
    """
    joints, one = len(hand().control_low), size // 2
    place = torch.arange(size)
    finger, force = place % one < joints, (place % one >= joints) & (place % one < joints + 3)
    hands = (place < one, place >= one)
    parts = [finger & side for side in hands]
    if one > joints:
        for side in hands:
            parts += [force & side, ~finger & ~force & side]
        parts.append(force)
    return torch.stack(parts)
