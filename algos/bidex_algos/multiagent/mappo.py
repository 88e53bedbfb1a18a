"""MAPPO: PPO of several agents with one critic that sees everything (Yu et al. 2022; Bi-DexHands' appendix B.2.4).

MAPPO with one agent equals MT-PPO. In each mini-batch every agent maximises its own clipped surrogate. All agents share
one advantage, which is normalised per task, as the returns are.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bidex_algos.multiagent.base import LIFT, PAPER_PPO, MultiAgentPPOConfig, OwnAdams
from bidex_algos.nets.architecture import Options
from bidex_algos.nets.networks import autocast, gaussian_log_prob
from bidex_algos.onpolicy.base import Batch
from bidex_algos.onpolicy.ppo import NAMES, PolicyLoss, mini_batches, policy_loss
from bidex_meta.training.distributed import sum_gradients


@dataclass(frozen=True)
class MAPPOConfig(MultiAgentPPOConfig):
    """All options of MAPPO; the defaults are the preset ``laptop``."""

    share_parameters: bool = False
    """Share one network between agents with equal sizes of observation groups and actions. The input of this network
    includes a one-hot of the agent."""


# The std of Table 45 is 0.5 sigmoid(s), initially with s = 1 (std y and x coef).
TABLE_45: Options = PAPER_PPO | {
    "learning_rate": 5e-4, "critic_learning_rate": 5e-4, "max_grad_norm": 10.0, "adam_eps": 5e-4, "init_std": 0.3655,
    "std_range": (0.01, 0.5),
}  # fmt: skip
PRESETS: dict[str, MAPPOConfig] = {
    "paper": MAPPOConfig(**TABLE_45, share_parameters=True),  # B.2.4 describes one policy for all agents
    "laptop": MAPPOConfig(),
}
TASK_PRESETS = {"LiftUnderarm": {"paper": replace(PRESETS["paper"], **LIFT)}}


class MAPPO(OwnAdams):
    """MAPPO, multi-agent PPO (Yu et al. 2022, arXiv 2103.01955)."""

    name = "mappo"
    remedy = "lower learning_rate"
    config_type = MAPPOConfig
    presets = PRESETS
    task_presets = TASK_PRESETS
    config: MAPPOConfig

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        cfg = self.config
        actor = self.policy.actor
        old_values = self._old_values(batch)
        old_log_std = actor.log_std_of(batch.obs).detach().expand(batch.actions.shape)
        given = zip(*(actor.parts(x) for x in (batch.actions, batch.old_means, old_log_std)), strict=True)
        old_log_probs = torch.stack([gaussian_log_prob(*each) for each in given], dim=1)  # log-densities of each agent
        measured: list[Tensor] = []
        for first, index, count in mini_batches(batch.weights, cfg.epochs, cfg.num_minibatches, self.generator):
            part = batch.select(index)
            part.old_log_probs = old_log_probs.index_select(0, index)
            reported = self._gradients(
                part, count, old_log_std.index_select(0, index), old_values.index_select(0, index)
            )
            measured.append(reported[:4])
            for k, adam in enumerate(self.adams):
                adam.descend(None if first else reported[4 + k], cfg.max_grad_norm)
            self._critic_step()
            actor.clamp_std(*cfg.std_range)
        rate = torch.stack([adam.rate for adam in self.adams]).mean()
        return {**dict(zip(NAMES, torch.stack(measured).mean(0), strict=True)), "Policy/lr": rate}

    def _gradients(self, b: Batch, count: Tensor, old_log_std: Tensor, old_values: Tensor) -> Tensor:
        cfg = self.config
        actor = self.policy.actor
        weights = b.weights / count
        losses = self._agent_losses(b, weights, old_log_std)
        value = self._value_loss(b, old_values, weights)
        # Agents that share a network get the mean of their losses (B.2.4), other agents their own loss.
        shares = [1.0 / actor.net_of.count(net) for net in actor.net_of]
        surrogate = _weighted_sum(shares, [loss.surrogate for loss in losses])
        entropy = _weighted_sum(shares, [loss.entropy for loss in losses])
        kls_of_net: list[list[Tensor]] = [[] for _ in self.adams]
        for net, loss in zip(actor.net_of, losses, strict=True):
            kls_of_net[net].append(loss.kl)
        numbers = [
            torch.stack([loss.surrogate.detach() for loss in losses]).mean(),
            value.detach() / self.num_critics,
            torch.stack([loss.kl for loss in losses]).mean(),
            torch.stack([loss.outside for loss in losses]).mean(),
        ]
        numbers += [torch.stack(kls).mean() for kls in kls_of_net]
        for adam in self.adams:
            adam.zero_grad()
        self.critic_adam.zero_grad()
        (surrogate - cfg.entropy_weight * entropy + cfg.value_loss_weight * value).backward()
        return sum_gradients([*actor.parameters(), *self.critic.parameters()], torch.stack(numbers))

    def _agent_losses(self, b: Batch, weights: Tensor, old_log_std: Tensor) -> list[PolicyLoss]:
        actor = self.policy.actor
        task = self.policy.actor.one_hot(b.obs)
        with autocast(self.device, self.low_precision):
            means = actor.means(b.obs)
        if b.advantages.dim() == 2:
            advantages = b.advantages
        else:
            advantages = b.advantages[:, None].expand(-1, len(self.views))
        given = zip(*(actor.parts(x) for x in (b.actions, b.old_means, old_log_std)), strict=True)
        losses = []
        for agent, (actions, old_means, old_std) in enumerate(given):
            log_std = actor.own_log_std(agent, task)
            old_log_probs = b.old_log_probs[:, agent]
            loss = policy_loss(
                actions, means[agent], log_std, old_means, old_std, old_log_probs, advantages[:, agent],
                weights=weights, clip=self.config.clip
            )  # fmt: skip
            losses.append(loss)
        return losses


def _weighted_sum(weights: list[float], terms: list[Tensor]) -> Tensor:
    """Return the sum of scalars, each times its weight."""
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)]).sum()
