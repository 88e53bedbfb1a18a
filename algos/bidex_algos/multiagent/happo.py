"""HAPPO: agents that take PPO's update one after another (Kuba et al. 2022; Bi-DexHands' appendix B.2.3).

The order of agents is random in each iteration. Each agent maximises PPO's clipped surrogate. The advantage in the
surrogate is multiplied by the likelihood ratios of the agents updated before, so that the agent's step improves the
joint policy. Afterwards the common critic learns.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bidex_algos.multiagent.base import (
    LIFT,
    PAPER_PPO,
    AgentBatch,
    InTurnConfig,
    MultiAgentPPOConfig,
    OwnAdams,
    Sequential,
)
from bidex_algos.onpolicy.base import Batch
from bidex_algos.onpolicy.ppo import mini_batches, policy_loss
from bidex_meta.training.distributed import sum_gradients


@dataclass(frozen=True)
class HAPPOConfig(InTurnConfig, MultiAgentPPOConfig):
    """All options of HAPPO; the defaults are the preset ``laptop``."""


PRESETS: dict[str, HAPPOConfig] = {
    # These values are from Table 44. An on-policy learner does not use its replay, Polyak factor and reward scale.
    "paper": HAPPOConfig(
        **PAPER_PPO, learning_rate=1e-4, critic_learning_rate=1e-4, max_grad_norm=1.0, init_std=1.0,
        max_factor=0.0,
    ),
    "laptop": HAPPOConfig(),
}  # fmt: skip
TASK_PRESETS = {"LiftUnderarm": {"paper": replace(PRESETS["paper"], **LIFT)}}


class HAPPO(OwnAdams, Sequential):
    """HAPPO, PPO that updates agents one after another (Kuba et al. 2022, arXiv 2109.11251)."""

    name = "happo"
    remedy = "lower learning_rate"
    config_type = HAPPOConfig
    presets = PRESETS
    task_presets = TASK_PRESETS
    config: HAPPOConfig

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        cfg = self.config
        measured = [self._agent_epochs(agent, share) for agent, share in self._in_turn(batch)]
        value = self._critic_epochs(batch, cfg.epochs, cfg.num_minibatches, cfg.value_loss_weight)
        surrogate, kl, outside = torch.stack(measured).mean(0)
        rate = torch.stack([adam.rate for adam in self.adams]).mean()
        reported = {"Loss/surrogate": surrogate, "Loss/value": value, "Policy/kl": kl, "Policy/clip_fraction": outside}
        return reported | {"Policy/lr": rate}

    def _agent_epochs(self, agent: int, share: AgentBatch) -> Tensor:
        cfg = self.config
        adam = self.adams[agent]
        parameters = self.policy.actor.parameters_of(agent)
        measured: list[Tensor] = []
        for first, index, count in mini_batches(share.weights, cfg.epochs, cfg.num_minibatches, self.generator):
            part = share.select(index)
            loss = policy_loss(
                part.actions, *self._distribution(agent, part), part.old_means, part.old_log_std, part.old_log_probs,
                part.gain, weights=part.weights / count, clip=cfg.clip
            )  # fmt: skip
            adam.zero_grad()
            (loss.surrogate - cfg.entropy_weight * loss.entropy).backward(inputs=parameters)
            numbers = torch.stack([loss.surrogate.detach(), loss.kl, loss.outside])
            measured.append(sum_gradients(parameters, numbers))
            adam.descend(None if first else measured[-1][1], cfg.max_grad_norm)
            self.policy.actor.clamp_std(*cfg.std_range)
        return torch.stack(measured).mean(0)
