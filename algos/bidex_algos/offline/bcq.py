"""BCQ: values of actions that a model of the data proposes (Fujimoto et al. 2019; Bi-DexHands' appendix B.3.1).

The model G, a variational autoencoder, minimises |G(s, z) - a|^2 + KL, where z is the code of action a. A perturbation
xi changes the proposed actions by at most Phi and maximises Q_1(s, a + xi(s, a)). In the next state s' the proposals
are a'_j = G(s', z_j) + xi'(s', G(s', z_j)), j = 1...n, with random codes z_j. Q_i regresses to r + gamma (1 -
terminated) max_j [w min_i + (1 - w) max_i] Q'_i(s', a'_j). A prime after xi or Q denotes a target network.
"""

import copy
from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor, nn

from bidex_algos.nets.architecture import Critics, follow, network_bytes, network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import MLP, Layers, autocast, use_bfloat16
from bidex_algos.nets.normalise import observation_normaliser
from bidex_algos.nets.policy import DeterministicActor
from bidex_algos.nets.shape import Shape
from bidex_algos.offline.base import PAPER, CriticConfig, Offline
from bidex_algos.replay import Transitions
from bidex_meta.training.learner import NO_SOURCES, Parts, Sources
from bidex_meta.utils.validation import Count, Fraction, NonNegative, Positive
from bidex_meta.world.contract import VectorWorld

_FARTHEST = 0.5  # bound of the codes of proposed actions, because most of the data have codes near 0
_LOG_STD = (-4.0, 15.0)


@dataclass(frozen=True)
class BCQConfig(CriticConfig):
    """All options of BCQ; the defaults are the preset ``laptop``."""

    vae_hidden: Layers = (256, 256)  # Widths of the hidden layers of the variational autoencoder of actions.
    vae_learning_rate: Positive = 1e-3  # Adam's step size for the variational autoencoder.
    latent: Count = 2  # Size of the autoencoder's code, per entry of an action.
    kl_weight: NonNegative = 0.5  # Weight of the codes' divergence from a normal, relative to the actions' error.
    candidates: Count = 10  # Number of actions proposed in a state; the policy takes the best one.
    perturbation: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.05  # Largest change of a proposed action (Phi).
    lower_weight: Fraction = 0.75  # Weight of the lower critic's value in a target; the higher value has the rest.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, including the autoencoder."""
        return super().bytes_held(num_envs, width) + network_bytes(self.vae_hidden, width, 2)


# "paper": layers, step size, batch, Phi and the number of actions are from Table 46. The table omits the autoencoder's
# layers, its weight and lower_weight; these values are from Fujimoto et al. (2019, their code).
PRESETS: dict[str, BCQConfig] = {
    "paper": BCQConfig(
        hidden=(400, 300), vae_hidden=(750, 750), learning_rate=1e-3, critic_learning_rate=1e-3, batch_size=100,
        normalise_observations=False, **PAPER,
    ),
    "laptop": BCQConfig(),
}  # fmt: skip


class ActionModel(nn.Module):
    """A conditional variational autoencoder of the data's actions in a state; its latent code has ``codes`` entries."""

    def __init__(self, inputs: Inputs, config: BCQConfig, actions: int, generator: torch.Generator):
        super().__init__()
        self.codes = config.latent * actions
        encoded = inputs.extended("action", actions)
        decoded = inputs.extended("code", self.codes)
        self.encoder = MLP(encoded, config.vae_hidden, 2 * self.codes, 1.0, generator, config.activation)
        self.decoder = MLP(decoded, config.vae_hidden, actions, 1.0, generator, config.activation)

    def encode(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation, (B, z) each, of the codes of actions (B, a) in states (B, d)."""
        mean, log_std = self.encoder(torch.cat([obs, actions], 1)).chunk(2, 1)
        return mean, log_std.clamp(*_LOG_STD)

    def decode(self, obs: Tensor, codes: Tensor) -> Tensor:
        """Decode codes (B, z) to actions (B, a) in [-1, 1], given normalised observations (B, d)."""
        return torch.tanh(self.decoder(torch.cat([obs, codes], 1)))


def bounded(codes: Tensor) -> Tensor:
    """Clamp standard normal codes to the range in which the model is reliable."""
    return codes.clamp(-_FARTHEST, _FARTHEST)


class BCQPolicy(nn.Module):
    """A policy on raw observations that takes the proposed action to which the first critic gives the highest value.

    ``model`` proposes actions and ``actor`` changes them. The codes of the proposals are drawn when the policy is
    created and are equal in every state, so that the policy is a function of the observation.
    """

    def __init__(
        self, config: BCQConfig, inputs: Inputs, shape: Shape, generator: torch.Generator, device: torch.device
    ):
        super().__init__()
        self.perturbation = config.perturbation
        self.low_precision = use_bfloat16(config.autocast, device)
        self.observations = observation_normaliser(config, inputs, shape.num_id_columns)
        judged = inputs.extended("action", shape.actions)
        heads = shape.num_id_columns
        self.actor = DeterministicActor(
            judged, config.hidden, shape.actions, heads if config.policy_heads else 1, generator, config.activation,
            network_of(config)
        )  # fmt: skip
        # A policy knows its task only by the one-hot; without a one-hot, one value serves all tasks.
        if config.value_heads and heads:
            judges = heads
        else:
            judges = 1
        self.critic = Critics(judged, judges, config, config.critic_layer_norm, generator)
        self.model = ActionModel(inputs, config, shape.actions, generator)
        self.task = inputs.columns(*["task_id"] * (self.critic.heads > 1))
        self.codes: Tensor
        self.register_buffer("codes", bounded(torch.randn(config.candidates, self.model.codes, generator=generator)))

    def propose(self, actor: nn.Module, obs: Tensor, codes: Tensor) -> Tensor:
        """Decode codes (B, z) to actions (B, a), changed by ``actor``, for normalised observations (B, d)."""
        return self.changed(actor, obs, self.model.decode(obs, codes))

    def changed(self, actor: nn.Module, obs: Tensor, actions: Tensor) -> Tensor:
        """Move each of the actions (B, a) by at most ``perturbation``, within [-1, 1]."""
        moved = actions + self.perturbation * actor(torch.cat([obs, actions], 1))
        return moved.clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Do nothing, because the policy has no state; the argument is part of the Agent protocol."""

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the action for raw observations (N, d): (N, a) in [-1, 1]."""
        # No size is read as a number: in an exported policy, the number of observations stays variable.
        count = len(self.codes)
        many = self.observations(obs)[:, None].expand(-1, count, -1).flatten(0, 1)
        codes = self.codes.expand(obs.shape[0], -1, -1).flatten(0, 1)
        with autocast(obs.device, self.low_precision):
            actions = self.propose(self.actor, many, codes)
            if self.critic.heads > 1:
                task = self.task(many).argmax(1)
            else:
                task = torch.zeros_like(many[:, 0], dtype=torch.int64)
            values = self.critic(many, actions, task)[0]
        best = values.unflatten(0, (-1, count)).argmax(1)
        actions = actions.unflatten(0, (-1, count))
        return actions.gather(1, best[:, None, None].expand(-1, 1, actions.shape[2])).squeeze(1)


class BCQ(Offline):
    """Batch-constrained deep Q-learning on data sets (Fujimoto et al. 2019, arXiv 1812.02900)."""

    name = "bcq"
    remedy = "lower critic_learning_rate"
    config_type = BCQConfig
    presets = PRESETS
    config: BCQConfig
    policy: BCQPolicy
    policy_of = BCQPolicy

    def __init__(self, world: VectorWorld, config: BCQConfig, seed: int, sources: Sources = NO_SOURCES):
        super().__init__(world, config, seed, sources)
        self.target_actor = copy.deepcopy(self.policy.actor)
        self.adams["model"] = self._adam(self.policy.model.parameters(), config.vae_learning_rate)

    def _make_critics(self) -> Critics:
        return self.policy.critic

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        reported = self._fit_model(obs, draw.actions)
        reported |= self._fit_critics(obs, draw, self._target(draw, next_obs))
        reported |= self._fit_actor(obs)
        follow(self.target_critic, self.critic, self.config.tau)
        follow(self.target_actor, self.policy.actor, self.config.tau)
        return reported

    def _fit_model(self, obs: Tensor, actions: Tensor) -> dict[str, Tensor]:
        model = self.policy.model
        with autocast(self.device, self.low_precision):
            mean, log_std = model.encode(obs, actions)
            again = model.decode(obs, mean + log_std.exp() * self._normal(mean))
        error = (again - actions).square().mean()
        divergence = (0.5 * ((2.0 * log_std).exp() + mean.square() - 1.0) - log_std).mean()
        self._descend(error + self.config.kl_weight * divergence, "model", model)
        return {"Loss/reconstruction": error.detach(), "Loss/divergence": divergence.detach()}

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        count = self.config.candidates
        many = next_obs.repeat_interleave(count, 0)
        task = self.task_of_draw.repeat_interleave(count)
        codes = bounded(self._normal(many.new_empty(len(many), self.policy.model.codes)))
        with autocast(self.device, self.low_precision):
            values = self.target_critic(many, self.policy.propose(self.target_actor, many, codes), task)
        return self._bootstrapped(draw, best_of(values, count, self.config.lower_weight))

    def _fit_actor(self, obs: Tensor) -> dict[str, Tensor]:
        policy = self.policy
        with autocast(self.device, self.low_precision):
            with torch.no_grad():
                proposed = policy.model.decode(obs, bounded(self._normal(obs.new_empty(len(obs), policy.model.codes))))
            changed = policy.changed(policy.actor, obs, proposed)
        loss = -self._values(self.critic, obs, changed)[0].mean()
        self._descend(loss, "actor", policy.actor)
        return {"Loss/actor": loss.detach()}

    def _begin_targets(self) -> None:
        self.target_actor.load_state_dict(self.policy.actor.state_dict())
        self.target_critic.load_state_dict(self.policy.critic.state_dict())

    def _parts(self) -> Parts:
        parts = super()._parts()
        del parts["critic"]  # the critic is a part of the policy
        return parts

    def _own_parts(self) -> Parts:
        return {"target_actor": self.target_actor}


def best_of(values: Tensor, count: int, lower_weight: float) -> Tensor:
    """Return the value of the best of ``count`` proposed actions in each state, (B,).

    ``values`` (2, B * count) are both critics' values of all proposals, ordered by state. The value of a proposal is a
    weighted mean of both values, in which the lower value has the weight ``lower_weight``.
    """
    mixed = lower_weight * values.amin(0) + (1.0 - lower_weight) * values.amax(0)
    return mixed.view(-1, count).amax(1)
