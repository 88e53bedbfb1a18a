"""BCQ's policy: a model of the data's actions, small changes of what it proposes, and a critic that chooses."""

import torch
from torch import Tensor, nn

from bidex_algos.nets.deterministic import DeterministicActor
from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.multitask.architecture import network_of
from bidex_algos.nets.networks import MLP
from bidex_algos.nets.normalise_tasks import observation_normaliser
from bidex_algos.nets.precision import autocast
from bidex_algos.nets.shape import Shape
from bidex_algos.offline.bcq_config import BCQConfig
from bidex_algos.offpolicy.critics import Critics

_FARTHEST = 0.5
"""Codes are cut to this when actions are proposed: near the middle the model has seen most."""
_LOG_STD = (-4.0, 15.0)


class ActionModel(nn.Module):
    """A conditional variational autoencoder: which actions the data hold in a state.

    Args:
        inputs: The groups of the (normalised) observation.
        config: Layers and size of the code.
        actions: Number of actions, a.
        generator: CPU generator of the initial weights.

    Attributes:
        codes: Entries of a code, z.
    """

    def __init__(self, inputs: Inputs, config: BCQConfig, actions: int, generator: torch.Generator):
        super().__init__()
        self.codes = config.latent * actions
        seen, told = inputs.extended("action", actions), inputs.extended("code", self.codes)
        self.encoder = MLP(seen, config.vae_hidden, 2 * self.codes, 1.0, generator, config.activation)
        self.decoder = MLP(told, config.vae_hidden, actions, 1.0, generator, config.activation)

    def encode(self, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the standard deviation of the codes of actions (B, a): (B, z) each."""
        mean, log_std = self.encoder(torch.cat([obs, actions], 1)).chunk(2, 1)
        return mean, log_std.clamp(*_LOG_STD)

    def decode(self, obs: Tensor, codes: Tensor) -> Tensor:
        """Actions (B, a) in [-1, 1] of codes (B, z)."""
        return torch.tanh(self.decoder(torch.cat([obs, codes], 1)))


def bounded(codes: Tensor) -> Tensor:
    """Standard normal codes, cut to where the model is sure."""
    return codes.clamp(-_FARTHEST, _FARTHEST)


class BCQPolicy(nn.Module):
    """The best, by the first critic, of some proposals on raw observations.

    The codes of the proposals are the same in every state, drawn when the policy is made: so the policy is a function
    of the observation.

    Args:
        config: Layers, number and change of the proposals.
        inputs: The groups of the observation.
        shape: Sizes of the world.
        generator: CPU generator of the initial weights and of the codes.
        low_precision: Whether hidden layers run in bfloat16.

    Attributes:
        model: Proposes.
        actor: Changes: a network of observation and action.
        critic: Two networks; chooses by its first.
    """

    def __init__(
        self, config: BCQConfig, inputs: Inputs, shape: Shape, generator: torch.Generator, low_precision: bool
    ):
        super().__init__()
        self.perturbation, self.low_precision = config.perturbation, low_precision
        self.observations = observation_normaliser(config, inputs, shape.num_id_columns)
        judged, heads = inputs.extended("action", shape.actions), shape.num_id_columns
        self.actor = DeterministicActor(
            judged,
            config.hidden,
            shape.actions,
            heads if config.policy_heads else 1,
            generator,
            config.activation,
            network_of(config),
        )
        # A policy knows its task by the one-hot alone: without it, one value serves all.
        self.critic = Critics(judged, heads if config.value_heads and heads else 1, config, generator)  # pyright: ignore[reportArgumentType]
        self.model = ActionModel(inputs, config, shape.actions, generator)
        self.task = inputs.columns(*["task_id"] * (self.critic.heads > 1))
        self.codes: Tensor
        codes = bounded(torch.randn(config.candidates, self.model.codes, generator=generator))
        self.register_buffer("codes", codes)

    def propose(self, actor: nn.Module, obs: Tensor, codes: Tensor) -> Tensor:
        """Actions (B, a) of codes (B, z), changed by ``actor``, for normalised observations (B, d)."""
        return self.changed(actor, obs, self.model.decode(obs, codes))

    def changed(self, actor: nn.Module, obs: Tensor, actions: Tensor) -> Tensor:
        """Actions (B, a), each moved by no more than ``perturbation``, within [-1, 1]."""
        moved = actions + self.perturbation * actor(torch.cat([obs, actions], 1))
        return moved.clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget between episodes; the argument is part of the Agent protocol."""

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """The action for raw observations (N, d): (N, a) in [-1, 1]."""
        count, rows = len(self.codes), len(obs)
        many = self.observations(obs).repeat_interleave(count, 0)
        with autocast(obs.device, self.low_precision):
            actions = self.propose(self.actor, many, self.codes.repeat(rows, 1))
            task = self.task(many).argmax(1) if self.critic.heads > 1 else many.new_zeros(len(many), dtype=torch.int64)
            values = self.critic(many, actions, task)[0]
        best = values.view(rows, count).argmax(1)
        return actions.view(rows, count, -1)[torch.arange(rows, device=obs.device), best]
