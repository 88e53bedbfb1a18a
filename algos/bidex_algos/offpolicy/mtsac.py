"""MT-SAC: soft actor-critic (Haarnoja et al. 2018) on all tasks of a world at once, with a temperature for each task.

Q_i regresses to r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha_k log pi(a'|s')). pi minimises alpha_k log pi -
min_i Q_i. log alpha_k minimises -log alpha_k (log pi + H), averaged over task k only. A single temperature would be set
by the mean entropy of all tasks, although a solved task and an exploring task need different temperatures. The loss is
linear in log alpha, so its gradient is the entropy gap for any alpha. Deviations from the paper:
``docs/learners/mtsac.md``.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from bidex_algos.nets.architecture import Options, follow
from bidex_algos.nets.policy import SquashedPolicy, squashed_policy
from bidex_algos.offpolicy.base import OffPolicy, OffPolicyConfig
from bidex_algos.replay import Transitions
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Finite, Positive
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class MTSACConfig(OffPolicyConfig):
    """All options of MT-SAC; the defaults are the preset ``laptop``."""

    init_std: Positive = 0.5  # Initial standard deviation of the actions before squashing.
    std_range: tuple[Positive, Positive] = (0.02, 2.0)  # Bounds of the standard deviation before squashing.
    alpha_learning_rate: Positive = 3e-3  # Adam's step size for the logarithms of the temperatures.
    init_alpha: Positive = 0.001  # Initial temperature of every task.
    target_entropy_per_action: Finite = -1.0
    """Target of the temperatures: entropy of the squashed policy per entry of the action. Uniform actions have 0.69."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.std_range
        if not 0.0 < low < self.init_std < high:
            raise BidexError(
                f"mtsac: std_range must be two positive numbers with init_std between them, got {low} {high} and "
                f"{self.init_std}."
            )


# The published settings share these values; log standard deviations range from -20 to 2.
_PLAIN = MTSACConfig(
    value_heads=False, critic_layer_norm=False, init_std=1.0, std_range=(2e-9, 7.4), learning_rate=3e-4,
    critic_learning_rate=3e-4, alpha_learning_rate=3e-4, max_grad_norm=1.0, normalise_observations=False,
    per_task_rewards=False,
)  # fmt: skip

PRESETS: dict[str, MTSACConfig] = {
    # These values are from Table 43 of the Bi-DexHands appendix (SAC, "other tasks"), because there is no table for
    # MT-SAC. Its entropy coefficient 0.2 is the initial value of each temperature; its 4 mini-batches of 32 follow
    # every vector step, for each task. The 32 steps between two reports are from Table 49 (SAC on Humanoid). Both
    # tables omit non-linearity, bounds of the standard deviation, target entropy and warm-up, and learn no temperature.
    "paper": replace(
        _PLAIN, hidden=(1024, 1024, 1024), replay_steps=5000, warmup_steps=32, steps_per_iteration=32,
        updates_per_step=4, batch_per_task=32, gamma=0.96, tau=0.01, init_alpha=0.2,
    ),
    "laptop": MTSACConfig(),
    # This preset is MT-SAC as in Meta-World's baselines, with one environment per task.
    "metaworld": replace(
        _PLAIN, hidden=(400, 400, 400), replay_steps=100_000, warmup_steps=4000, steps_per_iteration=500,
        updates_per_step=1, batch_per_task=128, gamma=0.99, tau=0.005, adam_eps=1e-5, init_alpha=1.0,
    ),
}  # fmt: skip

# These values are from Table 49. Its 2 epochs of one mini-batch follow every vector step; its replay of 40,000 counts
# vector steps.
_TABLE_49: Options = {
    "replay_steps": 40_000, "steps_per_iteration": 32, "updates_per_step": 2, "batch_per_task": 64, "gamma": 0.99,
    "tau": 0.005, "learning_rate": 3e-4, "critic_learning_rate": 3e-4, "init_alpha": 0.2, "max_grad_norm": 1.0,
}  # fmt: skip
TASK_PRESETS: dict[str, dict[str, MTSACConfig]] = {
    "gymnasium/Humanoid-v5": {
        "paper": replace(PRESETS["paper"], hidden=(1024, 1024, 1024), **_TABLE_49),
        "laptop": replace(PRESETS["laptop"], hidden=(256, 256, 256), **_TABLE_49),
    }
}


class MTSAC(OffPolicy):
    """Multi-task SAC (Haarnoja et al. 2018, arXiv 1812.05905) on a batched world."""

    name = "mtsac"
    remedy = "lower critic_learning_rate"
    config_type = MTSACConfig
    presets = PRESETS
    config: MTSACConfig
    policy: SquashedPolicy
    policy_of = staticmethod(squashed_policy)

    def __init__(self, world: VectorWorld, config: MTSACConfig, seed: int):
        super().__init__(world, config, seed)
        self.log_alpha = nn.Parameter(torch.full((world.num_tasks,), math.log(config.init_alpha), device=self.device))
        self.target_entropy = config.target_entropy_per_action * self.shape.actions
        self.adams["alpha"] = self._adam([self.log_alpha], config.alpha_learning_rate, decay=0.0)

    def _explore(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self.policy.observations(obs), self.generator)[0]

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        reported = self._fit_critics(obs, draw, self._target(draw, next_obs), weights, counts)
        reported |= self._policy_step(obs, *self.policy.sample(obs, self.generator), weights, counts)
        follow(self.target_critic, self.critic, self.config.tau)
        return reported

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        next_actions, log_prob = self.policy.sample(next_obs, self.generator)
        following = self._pooled(self._values(self.target_critic, next_obs, next_actions))
        return self._bootstrapped(draw, following - self.log_alpha.exp()[self.task_of_draw] * log_prob)

    def _policy_step(
        self, obs: Tensor, actions: Tensor, log_prob: Tensor, weights: Tensor, counts: Tensor
    ) -> dict[str, Tensor]:
        weight = weights / counts.sum().clamp_min(1.0)
        alpha = self.log_alpha.detach().exp()[self.task_of_draw]
        actor_loss = (weight * (alpha * log_prob - self._pooled(self._values(self.critic, obs, actions)))).sum()
        gap = self._per_task(weights * (log_prob.detach() + self.target_entropy)) / counts.clamp_min(1.0)
        alpha_loss = -(self.log_alpha * self._gap_that_counts(gap)).sum()
        entropy = -(weight * log_prob.detach()).sum()
        numbers = torch.stack([actor_loss.detach(), entropy])
        actor = list(self.policy.actor.parameters())
        numbers = self._descend(actor_loss + alpha_loss, numbers, "actor", actor=actor, alpha=[self.log_alpha])
        return dict(zip(["Loss/actor", "Policy/entropy"], numbers, strict=True))

    def _gap_that_counts(self, gap: Tensor) -> Tensor:
        return gap

    def _reported(self) -> dict[str, Tensor]:
        alphas = self.log_alpha.detach().exp()
        return {f"Policy/alpha/{name}": alpha for name, alpha in zip(self.world.task_names, alphas, strict=True)}

    def _own_parts(self) -> Parts:
        return {"log_alpha": self.log_alpha}


class SAC(MTSAC):
    """Single-task SAC (Haarnoja et al. 2018, arXiv 1812.05905) on a batched world.

    The class is MT-SAC with additional presets for Humanoid-v5 (Table 49 of the Bi-DexHands appendix). The preset
    ``paper`` is from the appendix's Table 43 for SAC, which has the same numbers in all columns.
    """

    task_presets = TASK_PRESETS
