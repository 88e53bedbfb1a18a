"""MT-TRPO: trust-region policy optimisation (Schulman et al. 2015) on all tasks of a world at once.

An update moves by sqrt(2 max_kl / s^T F s) along s = F^-1 g, computed by conjugate gradients; g is the gradient of the
mean of ratio x advantage, and F is the Fisher matrix of means and standard deviations. A line search then shortens the
step until surrogate and KL satisfy their conditions. Finally the critic learns in some epochs of mini-batches.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.nets.networks import Autocast, autocast, gaussian_kl, gaussian_log_prob
from bidex_algos.onpolicy.base import Batch, OnPolicy, OnPolicyConfig
from bidex_algos.onpolicy.ppo import mini_batches
from bidex_algos.trust_region import trust_region_step
from bidex_meta.training.distributed import all_sum, sum_gradients
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Count, Fraction, NonNegative, Positive
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class MTTRPOConfig(OnPolicyConfig):
    """All options of MT-TRPO; the defaults are the preset ``laptop``."""

    max_kl: Positive = 0.1  # Upper bound of the mean KL between the sampling and the new policy in an update.
    damping: NonNegative = 0.1  # Added to the Fisher matrix's diagonal; shortens steps along poorly known directions.
    cg_iterations: Count = 10  # Conjugate-gradient iterations.
    fisher_stride: Count = 4  # Every fisher_stride-th sample enters the Fisher matrix, which needs few.
    backtracks: Count = 10  # Points that the line search tries.
    backtrack_factor: Fraction = 0.8  # Factor by which the line search shortens the step at each try.
    accept_ratio: Fraction = 0.1
    """Share of the improvement predicted by the gradient that a step must reach to be accepted. With a larger share
    only steps along which the surrogate is almost linear are accepted."""
    critic_learning_rate: Positive = 1e-3  # Adam's step size of the critic.
    critic_epochs: Count = 4  # The critic's passes over the rollout per update.
    num_minibatches: Count = 4  # The critic's mini-batches per epoch.
    max_grad_norm: Positive = 1.0  # Gradients of the critic are clipped to this norm.
    autocast: Autocast = "off"  # Use bfloat16 in hidden layers; off, because it is too coarse for the Fisher matrix.


PRESETS: dict[str, MTTRPOConfig] = {
    # The Bi-DexHands appendix has no table for TRPO. Networks, rollouts and returns are from the most similar one,
    # Table 47 (MT-PPO); trust region and line search are the defaults of Bi-DexHands' MTTRPO class.
    "paper": MTTRPOConfig(
        hidden=(2048, 1024, 512), value_heads=False, init_std=0.8, rollout_steps=8, num_minibatches=4, gamma=0.96,
        lam=0.95, normalise_observations=False, max_kl=0.01, damping=0.1, cg_iterations=10, fisher_stride=1,
        backtracks=10, backtrack_factor=0.5, accept_ratio=0.1, critic_learning_rate=3e-4, critic_epochs=5,
    ),
    "laptop": MTTRPOConfig(),
}  # fmt: skip


def gaussian_step(
    parameters: list[nn.Parameter], distribution: Callable[[], tuple[Tensor, Tensor]], keep_bounds: Callable[[], None],
    b: Any, gain: Tensor, old_log_std: Tensor, own_kl: Tensor, config: Any, max_kl: float
) -> dict[str, Tensor]:  # fmt: skip
    """Take a trust-region step of a Gaussian policy that increases the mean of likelihood ratio times ``gain`` (B,).

    ``b`` are the samples. ``distribution`` returns the policy's mean and log standard deviation for these samples.
    ``keep_bounds`` clamps the standard deviations to their bounds. ``own_kl`` is the result of :func:`kl_from_itself`.
    Returns scalars to be logged.
    """
    weight = b.weights / all_sum(b.weights.sum()).clamp_min(1.0)

    def surrogate_and_kl() -> tuple[Tensor, Tensor]:
        mean, log_std = distribution()
        ratio = torch.exp(gaussian_log_prob(b.actions, mean, log_std) - b.old_log_probs)
        return (weight * ratio * gain).sum(), (weight * gaussian_kl(b.old_means, old_log_std, mean, log_std)).sum()

    @torch.no_grad()
    def measure() -> tuple[float, float]:
        keep_bounds()  # the bounds are part of the policy that will act, so they hold when it is measured
        objective, kl = all_sum(torch.stack(surrogate_and_kl())).tolist()
        return objective, kl

    surrogate = surrogate_and_kl()[0]
    ratio = config.accept_ratio
    return trust_region_step(parameters, surrogate, own_kl, measure, config, max_kl, "Policy/kl", ratio)


def kl_from_itself(
    distribution: Callable[[Tensor], tuple[Tensor, Tensor]], weights: Tensor, rows: int, stride: int
) -> Tensor:
    """Return this process's part of the mean KL divergence of the policy from itself, over every ``stride``-th sample.

    The divergence is 0, but its second derivative is the Fisher matrix.
    """
    sample = torch.arange(len(weights), device=weights.device)
    # The samples are steps by rows. Each later step starts at a later row, because otherwise some rows would never be
    # used.
    taken = (sample + sample // rows) % stride == 0
    mean, log_std = distribution(taken)
    kl = gaussian_kl(mean.detach(), log_std.detach(), mean, log_std)
    weight = weights[taken]
    return (weight / all_sum(weight.sum()).clamp_min(1.0) * kl).sum()


class MTTRPO(OnPolicy):
    """Multi-task TRPO (Schulman et al. 2015, arXiv 1502.05477) on a batched world."""

    name = "mttrpo"
    remedy = "lower max_kl or critic_learning_rate"
    config_type = MTTRPOConfig
    presets = PRESETS
    config: MTTRPOConfig

    def __init__(self, world: VectorWorld, config: MTTRPOConfig, seed: int):
        super().__init__(world, config, seed)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=config.critic_learning_rate, fused=True)

    def _optimisers(self) -> Parts:
        return {"critic_adam": self.critic_adam}

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        actor = self.policy.actor
        cfg = self.config

        def distribution() -> tuple[Tensor, Tensor]:
            with autocast(self.device, self.low_precision):
                mean = actor(batch.obs)
            return mean, actor.log_std_of(batch.obs)

        def keep_bounds() -> None:
            actor.log_std.clamp_(*(math.log(std) for std in cfg.std_range))

        old_log_std = actor.log_std_of(batch.obs).detach().clone()
        given = batch, batch.advantages, old_log_std
        own = self._kl_from_itself(batch)
        reported = gaussian_step(list(actor.parameters()), distribution, keep_bounds, *given, own, cfg, cfg.max_kl)
        return reported | {"Loss/value": self._critic_epochs(batch)}

    def _kl_from_itself(self, batch: Batch) -> Tensor:
        actor = self.policy.actor

        def distribution(taken: Tensor) -> tuple[Tensor, Tensor]:
            obs = batch.obs[taken].to(actor.log_std.dtype)
            return actor(obs), actor.log_std_of(obs)

        return kl_from_itself(distribution, batch.weights, self.world.num_envs, self.config.fisher_stride)

    def _critic_epochs(self, batch: Batch) -> Tensor:
        cfg = self.config
        parameters = list(self.critic.parameters())
        losses: list[Tensor] = []
        for _, index, count in mini_batches(batch.weights, cfg.critic_epochs, cfg.num_minibatches, self.generator):
            b = batch.select(index)
            loss = (b.weights / count * (self._critic(b.obs, b.task_id) - b.targets).square()).sum()
            self.critic_adam.zero_grad()
            loss.backward()
            losses.append(sum_gradients(parameters, loss.detach()[None])[0])
            nn.utils.clip_grad_norm_(parameters, cfg.max_grad_norm)
            self.critic_adam.step()
        return torch.stack(losses).mean()


class TRPO(MTTRPO):
    """Single-task TRPO (Schulman et al. 2015, arXiv 1502.05477) on a batched world.

    The class is MT-TRPO with another preset ``paper``, which is for a single task. Its networks are from Table 42 of
    the Bi-DexHands appendix. All other values are those of MT-TRPO, because the appendix has no table for TRPO.
    """

    presets = PRESETS | {"paper": replace(PRESETS["paper"], hidden=(1024, 1024, 512))}
