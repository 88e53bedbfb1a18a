"""DDPG: a deterministic actor that maximises a critic (Lillicrap et al. 2016), on all tasks of a world.

The critic Q regresses to r + gamma (1 - terminated) Q'(s', mu'(s')); the actor mu maximises Q(s, mu(s)). The critic's
gradient drives actions to the bounds, where tanh has almost no slope (on two hands 86 % of the actions exceeded 0.99
after 0.4 M steps); ``squash_price`` prevents this. The noise on actions is normal. Its standard deviation differs
between the environments of a task, as in Horgan et al. (2018). Bi-DexHands describes DDPG in appendix B.1.3.
"""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.nets.architecture import Options, follow
from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import DeterministicPolicy, deterministic_policy
from bidex_algos.offpolicy.base import OffPolicy, OffPolicyConfig
from bidex_algos.replay import Transitions
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import NonNegative, check_rising
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class DDPGConfig(OffPolicyConfig):
    """All options of DDPG; the defaults are the preset ``laptop``."""

    exploration_std: tuple[NonNegative, NonNegative] = (0.05, 0.5)
    """Standard deviations of the noise on actions in each task's first and last environment. The values of the other
    environments are evenly spaced between the two."""
    squash_price: NonNegative = 1.0  # Weight, in the actor's loss, of the mean square of the actions before tanh.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "exploration_std")


OF_PAPER: Options = {
    "hidden": (1024, 1024, 1024), "value_heads": False, "critic_layer_norm": False, "replay_steps": 5000,
    "warmup_steps": 32, "steps_per_iteration": 32, "updates_per_step": 4, "batch_per_task": 32, "gamma": 0.96,
    "tau": 0.01, "learning_rate": 3e-4, "critic_learning_rate": 3e-4, "max_grad_norm": 1.0,
    "normalise_observations": False, "per_task_rewards": False, "exploration_std": (0.1, 0.1), "squash_price": 0.0,
}  # fmt: skip
"""Values of the preset ``paper`` shared by DDPG and TD3. The Bi-DexHands appendix describes both (B.1.3, B.1.4) but has
no table for either. Layers, step size, discount, Polyak 0.99, gradient norm, 5000 steps of replay and 1 epoch of 4
mini-batches of 32 (here of each task) are from Table 43 (SAC, "other tasks"). The 32 steps between two reports are from
Table 49. The noise of 0.1 is from Fujimoto et al. (2018, section 6.1)."""
PRESETS: dict[str, DDPGConfig] = {"paper": DDPGConfig(**OF_PAPER), "laptop": DDPGConfig()}


class DDPG(OffPolicy):
    """Multi-task DDPG (Lillicrap et al. 2016, arXiv 1509.02971) on a batched world."""

    name = "ddpg"
    remedy = "lower critic_learning_rate"
    config_type = DDPGConfig
    presets = PRESETS
    config: DDPGConfig
    policy: DeterministicPolicy
    policy_of = staticmethod(deterministic_policy)
    num_critics = 1

    def __init__(self, world: VectorWorld, config: DDPGConfig, seed: int):
        super().__init__(world, config, seed)
        self.target_actor = copy.deepcopy(self.policy.actor)
        self.noise_std = spread(*config.exploration_std, world.task_id, world.num_tasks)[:, None]
        self.actor_loss = torch.zeros((), device=self.device)

    def _explore(self, obs: Tensor) -> Tensor:
        action = self.policy.eval_action(obs)
        return (action + self.noise_std * self._normal(action)).clamp(-1.0, 1.0)

    def _normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generator, device=self.device)

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        reported = self._fit_critics(obs, draw, self._target(draw, next_obs), weights, counts)
        if self._actor_is_due():
            self._policy_step(obs, draw, weights, counts)
            follow(self.target_actor, self.policy.actor, self.config.tau)
            follow(self.target_critic, self.critic, self.config.tau)
        return reported

    def _actor_is_due(self) -> bool:
        return True

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        following = self._values(self.target_critic, next_obs, self._target_action(next_obs))
        return self._bootstrapped(draw, self._pooled(following))

    def _target_action(self, next_obs: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            return self.target_actor(next_obs)

    def _policy_step(self, obs: Tensor, draw: Transitions, weights: Tensor, counts: Tensor) -> None:
        raw = self.policy.raw(obs)
        value = self._values(self.critic, obs, torch.tanh(raw))[0]
        price = self.config.squash_price * raw.square().mean(1)
        loss = (weights / counts.sum().clamp_min(1.0) * (price - value)).sum()
        actor = list(self.policy.actor.parameters())
        self.actor_loss = self._descend(loss, loss.detach()[None], "actor", actor=actor)[0]

    def _reported(self) -> dict[str, Tensor]:
        return {"Loss/actor": self.actor_loss}

    def _begin_targets(self) -> None:
        self.target_actor.load_state_dict(self.policy.actor.state_dict())

    def _own_parts(self) -> Parts:
        return {"target_actor": self.target_actor, "actor_loss": self.actor_loss}


def spread(low: float, high: float, task_id: Tensor, num_tasks: int) -> Tensor:
    """Return numbers (N,) that rise evenly from ``low`` in each task's first environment to ``high`` in its last.

    A single environment gets ``high``.
    """
    numbers = torch.empty(len(task_id), device=task_id.device)
    for task in range(num_tasks):
        rows = (task_id == task).nonzero().squeeze(1)
        if len(rows) > 1:
            share = torch.linspace(0.0, 1.0, len(rows))
        else:
            share = torch.ones(len(rows))
        numbers[rows] = (low + (high - low) * share).to(task_id.device)
    return numbers
