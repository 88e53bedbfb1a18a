"""HATRPO: agents that take TRPO's step one after another (Kuba et al. 2022; appendix B.2.2).

For each agent, in an order drawn anew in each iteration, MT-TRPO's step on its own parameters, within its share of the
trust region, with the advantage times the ratios of the agents before it. Then the critic of all.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bidex_algos.multiagent.base import LIFT, PAPER, AgentBatch, InTurnConfig, MultiAgentConfig, Sequential
from bidex_algos.nets.networks import gaussian_kl, gaussian_log_prob
from bidex_algos.onpolicy.base import Batch
from bidex_algos.onpolicy.mttrpo import MTTRPOConfig
from bidex_algos.trust_region import trust_region_step
from bidex_meta.train.distributed import all_sum
from bidex_meta.utils.validation import Positive
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class HATRPOConfig(InTurnConfig, MTTRPOConfig, MultiAgentConfig):
    """Everything that can be set about HATRPO; the defaults are the preset ``laptop``."""

    max_kl: Positive = 0.05
    """Mean KL of the new policy from the sampling one, of all agents together, that an update may not exceed; each
    agent's has an even share."""


PRESETS: dict[str, HATRPOConfig] = {
    # There is no table for HATRPO: HAPPO's (44), with the trust region of our TRPO's preset of this name.
    "paper": HATRPOConfig(
        **PAPER, max_kl=0.01, damping=0.1, cg_iterations=10, fisher_stride=1, backtracks=10, backtrack_factor=0.5,
        accept_ratio=0.1, critic_learning_rate=1e-4, critic_epochs=5, num_minibatches=1, max_grad_norm=1.0,
        init_std=1.0, max_factor=0.0,
    ),
    "laptop": HATRPOConfig(),
}  # fmt: skip
TASK_PRESETS = {
    "LiftUnderarm": {"paper": replace(PRESETS["paper"], rollout_steps=LIFT["rollout_steps"], critic_epochs=10)}
}


class HATRPO(Sequential):
    """HATRPO, agents in turn (Kuba et al. 2022, arXiv 2109.11251)."""

    name, remedy = "hatrpo", "lower max_kl or critic_learning_rate"
    config_type, presets, task_presets = HATRPOConfig, PRESETS, TASK_PRESETS
    config: HATRPOConfig  # type: ignore[assignment]

    def __init__(self, world: VectorWorld, config: Any, seed: int):
        super().__init__(world, config, seed)
        self.region = replace(config, max_kl=self.kl_share * config.max_kl)

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """All agents in turn, then the critic; returns means over agents of what it measured."""
        steps = [self._agent_step(agent, share) for agent, share in self._in_turn(batch)]
        told = {name: torch.stack([step[name] for step in steps]).mean() for name in steps[0]}
        return told | {"Loss/value": self._critic_epochs(batch, self.config.critic_epochs, self.config.num_minibatches)}

    def _agent_step(self, agent: int, share: AgentBatch) -> dict[str, Tensor]:
        cfg, actor = self.config, self.policy.actor
        weight = share.weights / all_sum(share.weights.sum()).clamp_min(1.0)

        def surrogate_and_kl() -> tuple[Tensor, Tensor]:
            """This process's part of the surrogate objective and of the KL from the sampling policy, scalars."""
            mean, log_std = self._distribution(agent, share)
            ratio = torch.exp(gaussian_log_prob(share.actions, mean, log_std) - share.old_log_probs)
            kl = gaussian_kl(share.old_means, share.old_log_std, mean, log_std)
            return (weight * ratio * share.gain).sum(), (weight * kl).sum()

        @torch.no_grad()
        def measure() -> tuple[float, float]:
            # The bounds are part of the policy: what is measured is what will act.
            actor.clamp_std(*cfg.std_range)
            objective, kl = all_sum(torch.stack(surrogate_and_kl())).tolist()
            return objective, kl

        objective, _ = surrogate_and_kl()
        kl = self._kl_from_itself(agent, share)
        stepped = trust_region_step(
            actor.parameters_of(agent), objective, kl, measure, self.region, accept_ratio=cfg.accept_ratio
        )
        return stepped.told("Policy/kl", self.device)

    def _kl_from_itself(self, agent: int, share: AgentBatch) -> Tensor:
        """The part of an agent's mean KL that its Fisher matrix is made of: 0, but with a curvature."""
        actor, rows = self.policy.actor, self.world.num_envs
        sample = torch.arange(len(share.seen), device=self.device)
        # As in MT-TRPO: a later step begins at a later row, else rows between would never be taken.
        taken = (sample + sample // rows) % self.config.fisher_stride == 0
        seen, weight = share.seen[taken].to(actor.log_stds[0].dtype), share.weights[taken]
        mean, log_std = actor.distribution_of(agent, seen, share.task[taken])
        kl = gaussian_kl(mean.detach(), log_std.detach(), mean, log_std)
        return (weight / all_sum(weight.sum()).clamp_min(1.0) * kl).sum()
