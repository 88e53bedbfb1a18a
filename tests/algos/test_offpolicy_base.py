"""A second learner on the off-policy base, the skeleton of TD3 (Fujimoto et al. 2018): the base suffices for it."""

import copy
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from bidex_algos.experience.replay import Transitions
from bidex_algos.nets.networks import MLP
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.shape import Shape
from bidex_algos.offpolicy.base import OffPolicy
from bidex_algos.offpolicy.config import OffPolicyConfig
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import VectorWorld
from tests.algos.problems import PointMass, discounted_return, one_step_bandit, opposite_bandits
from tests.algos.resume import resumed
from tests.algos.toy import ToyWorld

# The learner, complete.


@dataclass(frozen=True)
class TwinConfig(OffPolicyConfig):
    algo: ClassVar[str] = "twin"

    exploration_std: float = 0.2
    target_std: float = 0.2
    target_bound: float = 0.5
    policy_delay: int = 2


class DeterministicPolicy(nn.Module):
    def __init__(self, observations: ObservationNormaliser, actor: nn.Module):
        super().__init__()
        self.observations, self.actor = observations, actor

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        return torch.tanh(self.actor(self.observations(obs)))

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget."""


class Twin(OffPolicy):
    """Deterministic actor, clipped double Q, smoothed targets, delayed policy updates."""

    name, remedy = "twin", "lower critic_learning_rate"
    config_type = TwinConfig
    config: TwinConfig
    policy: DeterministicPolicy

    def __init__(self, world: VectorWorld, config: TwinConfig, seed: int):
        super().__init__(world, config, seed)
        self.target_actor = copy.deepcopy(self.policy.actor)
        self.updates = 0
        self.actor_loss = torch.zeros((), device=self.device)

    def _noise(self, like: Tensor, std: float) -> Tensor:
        return std * torch.randn(like.shape, generator=self.generator, device=self.device)

    def _explore(self, obs: Tensor) -> Tensor:
        action = self.policy.eval_action(obs)
        return (action + self._noise(action, self.config.exploration_std)).clamp(-1.0, 1.0)

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        obs, next_obs = self.policy.observations(draw.obs), self.policy.observations(draw.next_obs)
        told = self._fit_critics(obs, draw, self._target(draw, next_obs), weights, counts)
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            action = torch.tanh(self.policy.actor(obs))
            loss = -(weights / counts.sum().clamp_min(1.0) * self._values(self.critic, obs, action)[0]).sum()
            actor = list(self.policy.actor.parameters())
            self.actor_loss = self._descend(loss, loss.detach()[None], "actor", actor=actor)[0]
            self._follow(self.target_actor, self.policy.actor)
            self._follow(self.target_critic, self.critic)
        return told

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        action, bound = torch.tanh(self.target_actor(next_obs)), self.config.target_bound
        action = (action + self._noise(action, self.config.target_std).clamp(-bound, bound)).clamp(-1.0, 1.0)
        return self._bootstrapped(draw, self._values(self.target_critic, next_obs, action).amin(0))

    def _told(self) -> dict[str, Tensor]:
        return {"Loss/actor": self.actor_loss}

    @classmethod
    def _make_policy(
        cls, config: TwinConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> DeterministicPolicy:
        inputs = cls._inputs(config, shape)
        actor = MLP(inputs, config.hidden, shape.actions, 0.01, init, config.activation)
        observations = ObservationNormaliser(inputs, config.normalise_observations)
        return DeterministicPolicy(observations, actor).to(device)

    def _own_parts(self) -> dict[str, Any]:
        return {"target_actor": self.target_actor, "actor_loss": self.actor_loss}

    def _place(self) -> dict[str, Any]:
        return {"updates": self.updates, **super()._place()}

    def _go_on_from(self, state: dict[str, Any]) -> None:
        super()._go_on_from(state)
        self.updates = int(state["updates"])


# What it does.

SMALL = TwinConfig(
    hidden=(32, 32),
    replay_steps=200,
    cut_share=0.3,
    warmup_steps=4,
    batch_size=128,
    critic_layer_norm=False,
    gamma=0.8,
    tau=0.05,
    learning_rate=3e-3,
    critic_learning_rate=5e-3,
    autocast="off",
)


def trained(world: Any, config: TwinConfig, iterations: int) -> Twin:
    learner = Twin(world, config, seed=0)
    for _ in range(iterations):
        learner.iterate()
    return learner


def test_two_tasks_at_odds_are_learned_though_one_pays_a_thousandfold() -> None:
    learner = trained(opposite_bandits(0.5, scale=1000.0), SMALL, 14)
    obs, _ = learner.world.reset(seed=1)
    action = learner.eval_action(obs)
    for k, target in enumerate((0.5, -0.5)):
        assert (action[learner.world.task_id == k] - target).abs().mean() < 0.15


def test_a_point_mass_is_moved_better_than_at_random() -> None:
    learner, test = trained(PointMass(), SMALL, 18), PointMass(rows=256)
    generator = torch.Generator().manual_seed(0)
    random = discounted_return(test, lambda obs: 2.0 * torch.rand(len(obs), 2, generator=generator) - 1.0, 0.8, 30)
    best = discounted_return(test, test.best, 0.8, 30)
    assert random < 1.5 * best
    assert discounted_return(test, learner.eval_action, 0.8, 30) > 1.15 * best


@pytest.mark.parametrize(("terminal", "value"), [(False, 5.0), (True, 1.0)])
def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(terminal: bool, value: float) -> None:
    world = ToyWorld([lambda action: torch.ones(len(action))], horizon=1, terminal=terminal)
    learner = trained(world, replace(SMALL, cut_share=1.0, per_task_rewards=False, tau=0.1), 14)
    obs = learner.policy.observations(learner.replay.obs)
    values = learner.critic(obs, torch.zeros(32, 2), world.task_id)
    assert_close(values.detach(), torch.full((2, 32), value), rtol=0.05, atol=0)


def test_save_load_resume_is_bit_equal() -> None:
    resumed(lambda seed: Twin(opposite_bandits(rows=8), SMALL, seed))


def test_the_policy_alone_is_loaded_by_the_base() -> None:
    learner = trained(opposite_bandits(), SMALL, 2)
    policy, obs = Twin.load_policy(learner.policy_state_dict()), torch.randn(5, 3)
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))


def test_metrics_and_errors_carry_its_name() -> None:
    learner = trained(one_step_bandit(), SMALL, 1)
    assert {"Loss/critic", "Loss/actor", "Value/q/task0", "Train/weightless"} <= learner.iterate().keys()
    with torch.no_grad():
        next(learner.critic.parameters()).fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=r"twin: the loss is not finite after \d+ steps; lower critic_"):
        learner.iterate()
    with pytest.raises(BidexError, match="twin: tau"):
        replace(SMALL, tau=0.0)
