"""HATRPO: agents that take TRPO's step one after another (Kuba et al. 2022; Bi-DexHands' appendix B.2.2).

The learner works like HAPPO, but takes MT-TRPO's step on each agent's own parameters, within the agent's share of the
trust region.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bidex_algos.multiagent.base import LIFT, PAPER, AgentBatch, InTurnConfig, MultiAgentConfig, Sequential
from bidex_algos.onpolicy.base import Batch
from bidex_algos.onpolicy.mttrpo import MTTRPOConfig, gaussian_step, kl_from_itself
from bidex_meta.utils.validation import Positive


@dataclass(frozen=True)
class HATRPOConfig(InTurnConfig, MTTRPOConfig, MultiAgentConfig):
    """All options of HATRPO; the defaults are the preset ``laptop``."""

    max_kl: Positive = 0.05
    """Upper bound of the mean KL between the sampling and the new joint policy. Each agent has an equal share."""


PRESETS: dict[str, HATRPOConfig] = {
    # There is no table for HATRPO. The values are HAPPO's (44), with the trust region of TRPO's preset of this name.
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
    """HATRPO, TRPO that updates agents one after another (Kuba et al. 2022, arXiv 2109.11251)."""

    name = "hatrpo"
    remedy = "lower max_kl or critic_learning_rate"
    config_type = HATRPOConfig
    presets = PRESETS
    task_presets = TASK_PRESETS
    config: HATRPOConfig  # type: ignore[assignment]

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        steps = [self._agent_step(agent, share) for agent, share in self._in_turn(batch)]
        reported = {name: torch.stack([step[name] for step in steps]).mean() for name in steps[0]}
        return reported | {
            "Loss/value": self._critic_epochs(batch, self.config.critic_epochs, self.config.num_minibatches)
        }

    def _agent_step(self, agent: int, share: AgentBatch) -> dict[str, Tensor]:
        actor = self.policy.actor
        cfg = self.config

        def of_taken(taken: Tensor) -> tuple[Tensor, Tensor]:
            seen = share.seen[taken].to(actor.log_stds[0].dtype)
            return actor.distribution_of(agent, seen, share.task[taken])

        own = kl_from_itself(of_taken, share.weights, self.world.num_envs, cfg.fisher_stride)
        distribution = partial(self._distribution, agent, share)
        bounds = partial(actor.clamp_std, *cfg.std_range)
        return gaussian_step(
            actor.parameters_of(agent), distribution, bounds, share, share.gain, share.old_log_std, own, cfg,
            self.kl_share * cfg.max_kl
        )  # fmt: skip
