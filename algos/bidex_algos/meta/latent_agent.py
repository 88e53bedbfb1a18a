"""The agent of a policy that acts on a latent variable, which describes the task (PEARL)."""

import torch
from torch import Tensor

from bidex_algos.nets.latent import LatentPolicy
from bidex_meta.agents import Timestep


class LatentAgent:
    """An adapting agent (``bidex_meta.agents``) of a latent-variable policy; ``seed`` seeds its exploration.

    Each environment sums the evidence of its own exploring episodes. The next exploring episode acts on a latent
    variable drawn from the posterior; an evaluation acts on the posterior's mean. No weight changes.
    """

    def __init__(self, policy: LatentPolicy, seed: int = 0):
        self.policy = policy
        self.device = policy.rewards.shift.device
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.init()

    def assign(self, task_of_row: Tensor | None) -> None:
        """Do nothing: each environment learns from its own episodes."""

    def init(self) -> None:
        """Reset the posterior of every environment to the prior."""
        self._sums = self._latent = self._fresh = torch.zeros(0, device=self.device)

    def _fit(self, rows: int) -> None:
        if len(self._sums) != rows:
            self._sums, self._latent = (torch.zeros(rows, n * self.policy.size, device=self.device) for n in (2, 1))
            self._fresh = torch.ones(rows, dtype=torch.bool, device=self.device)

    def reset(self, env_mask: Tensor) -> None:
        """Begin episodes in the rows of ``env_mask`` (N,); exploring episodes draw a new latent variable."""
        self._fit(len(env_mask))
        self._fresh = self._fresh | env_mask

    @torch.no_grad()
    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Sample actions (N, a) in [-1, 1] for raw observations (N, d)."""
        self._fit(len(obs))
        mean, std = self.policy.posterior(self._sums)
        drawn = mean + std * torch.randn(mean.shape, generator=self.noise, device=self.device)
        self._latent = torch.where(self._fresh[:, None], drawn, self._latent)
        self._fresh = torch.zeros_like(self._fresh)
        return self.policy.sample(self.policy.seen(obs, self._latent), self.noise)[0], {}

    @torch.no_grad()
    def step(self, timestep: Timestep) -> None:
        """Add the evidence of one transition to the posterior of each environment; invalid transitions are left out."""
        # Meta-World's evaluation passes neither next observations nor valid environments.
        if timestep.next_observation is None:
            following = timestep.observation
        else:
            following = timestep.next_observation
        valid = timestep.valid_mask
        reward = timestep.reward.masked_fill(~valid, 0.0)
        added = self.policy.evidence(timestep.observation, timestep.action, reward, following)
        self._sums = self._sums + added.masked_fill(~valid[:, None], 0.0)

    def adapt(self) -> None:
        """Do nothing: :meth:`step` has already added the evidence."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return squashed mean actions (N, a) in [-1, 1] for raw observations (N, d)."""
        self._fit(len(obs))
        return self.policy.latent_action(obs, self.policy.posterior(self._sums)[0])
