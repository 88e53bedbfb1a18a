"""FastTD3: TD3 with categorical critics and large batches (Seo et al. 2025, arXiv 2505.22642), on all tasks of a world.

After each step of all environments, the learner makes a few updates with large batches. Targets use the current actor's
actions, and target networks follow fast. The actor maximises min_i E Z_i, targets may sum rewards over several steps,
and weights decay. Rewards are divided by max(standard deviation, largest absolute value / bound) of their task's
returns. The distributions are described in ``categorical.py``; see ``docs/learners/fasttd3.md``.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.nets.architecture import follow
from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import DeterministicPolicy, deterministic_policy
from bidex_algos.offpolicy.categorical import Categorical, CategoricalConfig
from bidex_algos.offpolicy.ddpg import spread
from bidex_algos.replay import Transitions
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Count, NonNegative, Share, check_rising
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class FastTD3Config(CategoricalConfig):
    """All options of FastTD3; the defaults are the preset ``laptop``."""

    exploration_std: tuple[NonNegative, NonNegative] = (0.05, 0.5)
    """Standard deviations of the noise on actions in each task's first and last environment. The values of the other
    environments are evenly spaced between the two."""
    squash_price: NonNegative = 1.0  # Weight, in the actor's loss, of the mean square of the actions before tanh.
    target_std: NonNegative = 0.2  # Standard deviation of the noise on the next actions in targets.
    target_bound: NonNegative = 0.5  # The noise in targets is clipped to plus and minus this value.
    policy_delay: Count = 2  # Updates of the critics and of their targets for each update of the actor.
    value_heads: bool = False  # Give each critic one distribution per task instead of one for all.
    n_steps: Count = 3  # Number of steps whose rewards a target sums before it adds the value of the next state.
    tau: Share = 0.05  # Share of the critics that enters the target critics in each update (1 - Polyak's factor).
    weight_decay: NonNegative = 0.1  # Weight decay of AdamW, relative to the step size; 0: Adam.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "exploration_std")


PRESETS: dict[str, FastTD3Config] = {
    # The values are from the authors' code (github.com/younggyoseo/FastTD3, fast_td3/hyperparams.py and fast_td3.py,
    # 2025), because the paper has no complete table. Replay, discount, steps, bound and scaled rewards are from its
    # class for several tasks (MTBenchArgs, MetaWorldMT10Args). The rest are its defaults (BaseArgs), whose gradient
    # norm of 0 means no limit. replay_memory holds these steps of its 4,096 environments, with MT20's 466 columns.
    "paper": FastTD3Config(
        hidden=(512, 256, 128), critic_hidden=(1024, 512, 256), critic_layer_norm=False, task_embedding=32,
        replay_steps=2048, replay_memory=19.0, warmup_steps=10, updates_per_step=2, batch_size=32_768, gamma=0.97,
        n_steps=8, tau=0.1, learning_rate=3e-4, critic_learning_rate=3e-4, weight_decay=0.1, max_grad_norm=1e9,
        atoms=101, value_bound=10.0, exploration_std=(0.001, 0.4), target_std=0.001, target_bound=0.5, policy_delay=2,
        squash_price=0.0,
    ),
    "laptop": FastTD3Config(),
    # This preset is for Meta-World's suites on one core. Discount, steps and bound are from the authors' class for
    # these suites. Layers are narrower and there is one update of fewer transitions, because a vector step has 4 rows
    # per class here instead of hundreds.
    "metaworld": FastTD3Config(
        hidden=(256, 256, 128), critic_hidden=(256, 256, 128), replay_steps=100_000, warmup_steps=500,
        steps_per_iteration=500, updates_per_step=1, batch_per_task=256, gamma=0.97, n_steps=8, tau=0.05,
        exploration_std=(0.05, 0.4), squash_price=0.1,
    ),
}  # fmt: skip


class FastTD3(Categorical):
    """Multi-task FastTD3 (Seo et al. 2025, arXiv 2505.22642) on a batched world."""

    name = "fasttd3"
    remedy = "lower critic_learning_rate"
    config_type = FastTD3Config
    presets = PRESETS
    config: FastTD3Config
    policy: DeterministicPolicy
    policy_of = staticmethod(deterministic_policy)
    going_on = ("updates", *Categorical.going_on)

    def __init__(self, world: VectorWorld, config: FastTD3Config, seed: int):
        super().__init__(world, config, seed)
        self.noise_std = spread(*config.exploration_std, world.task_id, world.num_tasks)[:, None]
        self.actor_loss = torch.zeros((), device=self.device)
        self.updates = 0

    def _explore(self, obs: Tensor) -> Tensor:
        action = self.policy.eval_action(obs)
        return (action + self.noise_std * self._normal(action)).clamp(-1.0, 1.0)

    def _normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generator, device=self.device)

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        # Step 1: the critics' distributions move towards the projected targets, by cross-entropy.
        reported = self._fit_critics(obs, draw, self._target(draw, next_obs), weights, counts)
        # Step 2: the actor learns in every policy_delay-th update.
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self._climb(obs, weights, counts)
        # Step 3: the target critics follow in each update; there is no target actor.
        follow(self.target_critic, self.critic, self.config.tau)
        return reported

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """Return the critics' targets (B, atoms), for the current actor's actions with clipped noise."""
        with autocast(self.device, self.low_precision):
            action = self.policy.actor(next_obs)
        bound = self.config.target_bound
        noise = self.config.target_std * self._normal(action)
        action = (action + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)
        return self._projected(draw, self._following(next_obs, action), torch.zeros_like(draw.rewards))

    def _climb(self, obs: Tensor, weights: Tensor, counts: Tensor) -> None:
        """Take one step of the actor towards higher values, with a penalty on actions before tanh."""
        raw = self.policy.raw(obs)
        value = self._pooled(self._values(self.critic, obs, torch.tanh(raw)))
        price = self.config.squash_price * raw.square().mean(1)
        loss = (weights / counts.sum().clamp_min(1.0) * (price - value)).sum()
        actor = list(self.policy.actor.parameters())
        self.actor_loss = self._descend(loss, loss.detach()[None], "actor", actor=actor)[0]

    def _reported(self) -> dict[str, Tensor]:
        return {"Loss/actor": self.actor_loss}

    def _own_parts(self) -> Parts:
        return {"actor_loss": self.actor_loss}
