"""BC: an actor that does in each state what the data did (behaviour cloning), by the mean squared distance."""

import torch
from torch import Tensor

from bidex_algos.experience.replay import Transitions
from bidex_algos.nets.deterministic import DeterministicActor, DeterministicPolicy
from bidex_algos.nets.multitask.architecture import network_of
from bidex_algos.nets.normalise_tasks import observation_normaliser
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.nets.shape import Shape
from bidex_algos.offline.base import Offline
from bidex_algos.offline.bc_config import PRESETS, BCConfig

__all__ = ["BC", "PRESETS", "BCConfig"]


class BC(Offline):
    """Behaviour cloning on data sets (Pomerleau 1988): TD3+BC (arXiv 2106.06860) without its critics.

    Arguments, errors and attributes are those of :class:`~bidex_algos.offline.base.Offline`.
    """

    name, remedy = "bc", "lower learning_rate"
    config_type = BCConfig
    config: BCConfig
    policy: DeterministicPolicy
    num_critics = 0

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        return self._fit_actor(self.policy.observations(draw.obs), draw)

    def _fit_actor(self, obs: Tensor, draw: Transitions) -> dict[str, Tensor]:
        """One step of the actor, on normalised observations (B, d) of ``draw``."""
        with autocast(self.device, self.low_precision):
            actions = self.policy.actor(obs)
        imitation = (actions - draw.actions).square().mean()
        loss, told = self._actor_loss(imitation, obs, actions)
        self._descend(loss, "actor", self.policy.actor)
        return told | {"Loss/imitation": imitation.detach()}

    def _actor_loss(self, imitation: Tensor, obs: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """What the actor goes down, and what more is told, for its actions (B, a) and their distance to the data's."""
        return imitation, {}

    @classmethod
    def _make_policy(
        cls, config: BCConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> DeterministicPolicy:
        inputs, heads = cls._inputs(config, shape), shape.num_id_columns if config.policy_heads else 1
        network = network_of(config)
        actor = DeterministicActor(inputs, config.hidden, shape.actions, heads, init, config.activation, network)
        observations = observation_normaliser(config, inputs, shape.num_id_columns)
        return DeterministicPolicy(observations, actor, use_bfloat16(config.autocast, device)).to(device)
