"""MT-TRPO: trust-region policy optimisation (Schulman et al. 2015) on all tasks of a world at once.

One policy reads the task's one-hot in its observation. An update, in the order of the code below:

1. g, the gradient of the surrogate, the mean of ratio x advantage;
2. s = F^-1 g by conjugate gradients, F the Fisher matrix of means and standard deviations alike;
3. the step sqrt(2 max_kl / s^T F s) s, whose KL is max_kl to second order;
4. back along it until surrogate and KL, measured against the policy that sampled, are what was asked for;
5. some epochs of mini-batches for the critic.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.gradients.trust_region import trust_region_step
from bidex_algos.nets.networks import gaussian_kl, gaussian_log_prob
from bidex_algos.nets.precision import autocast
from bidex_algos.onpolicy.base import Batch, OnPolicy
from bidex_algos.onpolicy.mttrpo_config import PRESETS, MTTRPOConfig
from bidex_meta.train.distributed import all_sum, sum_gradients
from bidex_meta.world.contract import VectorWorld

__all__ = ["MTTRPO", "PRESETS", "MTTRPOConfig"]


class MTTRPO(OnPolicy):
    """Multi-task TRPO (Schulman et al. 2015, arXiv 1502.05477) on a batched world.

    Arguments and attributes are those of :class:`~bidex_algos.onpolicy.base.OnPolicy`.

    Attributes:
        critic_adam: Moves the critic; the actor has no optimiser.
    """

    name, remedy = "mttrpo", "lower max_kl or critic_learning_rate"
    config_type = MTTRPOConfig
    config: MTTRPOConfig

    def __init__(self, world: VectorWorld, config: MTTRPOConfig, seed: int):
        super().__init__(world, config, seed)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=config.critic_learning_rate, fused=True)

    def _optimisers(self) -> dict[str, Any]:
        return {"critic_adam": self.critic_adam}

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """TRPO's update: returns what it measured, among it the KL after the step."""
        measured = self._policy_step(batch)
        measured["Loss/value"] = self._critic_epochs(batch)
        return measured

    def _policy_step(self, batch: Batch) -> dict[str, Tensor]:
        cfg, actor = self.config, self.policy.actor
        parameters = list(actor.parameters())
        old_log_std = actor.log_std_of(batch.obs).detach().clone()
        weight = batch.weights / all_sum(batch.weights.sum()).clamp_min(1.0)
        objective, _ = self._surrogate_and_kl(batch, weight, old_log_std)

        @torch.no_grad()
        def measure() -> tuple[float, float]:
            # The bounds are part of the policy: what is measured is what will act.
            actor.log_std.clamp_(*(math.log(std) for std in cfg.std_range))
            numbers = torch.stack(self._surrogate_and_kl(batch, weight, old_log_std))
            objective, kl = all_sum(numbers).tolist()
            return objective, kl

        stepped = trust_region_step(
            parameters, objective, self._kl_from_itself(batch), measure, cfg, accept_ratio=cfg.accept_ratio
        )
        return stepped.told("Policy/kl", self.device)

    def _surrogate_and_kl(self, batch: Batch, weight: Tensor, old_log_std: Tensor) -> tuple[Tensor, Tensor]:
        """This process's part of the surrogate objective and of the KL from the sampling policy, scalars."""
        actor = self.policy.actor
        with autocast(self.device, self.low_precision):
            mean = actor(batch.obs)
        log_std = actor.log_std_of(batch.obs)
        ratio = torch.exp(gaussian_log_prob(batch.actions, mean, log_std) - batch.old_log_probs)
        kl = gaussian_kl(batch.old_means, old_log_std, mean, log_std)
        return (weight * ratio * batch.advantages).sum(), (weight * kl).sum()

    def _kl_from_itself(self, batch: Batch) -> Tensor:
        """The part of the mean KL that the Fisher matrix is made of: 0, but with a curvature."""
        actor, rows = self.policy.actor, self.world.num_envs
        sample = torch.arange(len(batch.obs), device=self.device)
        # The samples are steps by rows. A later step begins at a later row, else rows between would never be taken.
        taken = (sample + sample // rows) % self.config.fisher_stride == 0
        obs, weight = batch.obs[taken].to(actor.log_std.dtype), batch.weights[taken]
        mean, log_std = actor(obs), actor.log_std_of(obs)
        kl = gaussian_kl(mean.detach(), log_std.detach(), mean, log_std)
        return (weight / all_sum(weight.sum()).clamp_min(1.0) * kl).sum()

    def _critic_epochs(self, batch: Batch) -> Tensor:
        """Fits the critic to its targets; the mean loss over all mini-batches, a scalar."""
        cfg, parameters = self.config, list(self.critic.parameters())
        losses: list[Tensor] = []
        for _ in range(cfg.critic_epochs):
            order = torch.randperm(len(batch.obs), generator=self.generator, device=self.device)
            for index in order.chunk(cfg.num_minibatches):
                b = batch.select(index)
                count = all_sum(b.weights.sum()).clamp_min(1.0)
                loss = (b.weights / count * (self._critic(b.obs, b.task_id) - b.targets).square()).sum()
                self.critic_adam.zero_grad()
                loss.backward()
                losses.append(sum_gradients(parameters, loss.detach()[None])[0])
                nn.utils.clip_grad_norm_(parameters, cfg.max_grad_norm)
                self.critic_adam.step()
        return torch.stack(losses).mean()
