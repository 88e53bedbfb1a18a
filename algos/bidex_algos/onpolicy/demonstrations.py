"""Demonstrations beside reinforcement: a term of behaviour cloning in the policy's loss, which fades.

As in DAPG (Rajeswaran et al. 2018, arXiv 1709.10087, equation 6), with normalised advantages in the place of their
weight by the largest one, and with standard deviations that demonstrations do not touch.
"""

from typing import Any

import torch
from torch import Tensor

from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import GaussianPolicy
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import own_seed, sum_gradients, world_size
from bidex_meta.train.learner import State

_OWN = 0xDE30
"""Told apart from the learner's other draws, which are the same with and without demonstrations."""
_CLONING_RATE = 1e-3
"""Adam's step size while the policy is cloned."""


class Demonstrations:
    """Transitions to be imitated, and how much they count; some tasks may have none."""

    def __init__(self, data: Joined, config: Any, seed: int, device: torch.device):
        self._config = config
        self._obs = data.observations.index_select(0, data.at).to(device)
        self._actions = data.actions.to(device)
        counts = torch.bincount(data.task)
        self._of_task = torch.argsort(data.task, stable=True).to(device)
        self._first = (counts.cumsum(0) - counts)[counts > 0].to(device)
        self._count = counts[counts > 0].to(device)
        self.generator = torch.Generator(device).manual_seed(own_seed(seed) ^ _OWN)
        self.fingerprint = data.fingerprint()

    def weight(self, env_steps: int) -> float:
        """Weight of the term after so many environment steps: halved every ``demonstration_half_life``."""
        return self._config.demonstration_weight * 0.5 ** (env_steps / self._config.demonstration_half_life)

    def draw(self) -> tuple[Tensor, Tensor]:
        """Raw observations (B, d) and actions (B, a), each task that has some equally often on average."""
        size, device = (self._config.demonstration_batch,), self._obs.device
        task = torch.randint(len(self._count), size, generator=self.generator, device=device)
        # The remainder of a number this large favours none by more than 1 in 2^40 / transitions.
        place = torch.randint(2**40, size, generator=self.generator, device=device) % self._count[task]
        chosen = self._of_task[self._first[task] + place]
        return self._obs[chosen], self._actions[chosen]

    def loss(self, policy: GaussianPolicy) -> Tensor:
        """Mean of (a - mean)^2 / (2 std^2), summed over actions; deviations, which rewards alone move, get no slope."""
        raw, actions = self.draw()
        obs = policy.observations(raw)
        with autocast(raw.device, policy.low_precision):
            means = policy.actor(obs)
        return imitation(actions, means.float(), policy.actor.log_std_of(obs).detach())

    def clone(self, policy: GaussianPolicy) -> None:
        """Behaviour cloning before anything is played: statistics of observations, then steps of the mean alone."""
        policy.observations.update(self._obs)
        weights = list(policy.actor.parameters())
        adam = torch.optim.Adam(weights, lr=_CLONING_RATE)
        for _ in range(self._config.demonstration_cloning):
            adam.zero_grad()
            loss = self.loss(policy) / world_size()
            loss.backward()
            sum_gradients(weights, loss.detach()[None])
            adam.step()

    def check(self, name: str, stored: State | None) -> None:
        """Refuses, by a BidexError, a checkpoint of other demonstrations, whose fingerprint is ``stored``."""
        if stored is not None and stored != self.fingerprint:
            raise BidexError(
                f"{name}: the checkpoint's demonstrations are others ({stored['transitions']:,.0f} transitions, here "
                f"{self.fingerprint['transitions']:,.0f}). Resume with the run's own data set."
            )


def imitation(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Half the mean squared distance, in standard deviations, of actions (B, a) from means (B, a): a scalar."""
    return 0.5 * ((actions - means) / log_std.exp()).square().sum(-1).mean()
