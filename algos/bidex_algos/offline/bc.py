"""BC (behaviour cloning): an actor learns to repeat the data's action in each state, by the mean squared error."""

from dataclasses import dataclass

from torch import Tensor

from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import DeterministicPolicy, deterministic_policy
from bidex_algos.offline.base import Offline, OfflineConfig
from bidex_algos.replay import Transitions


@dataclass(frozen=True)
class BCConfig(OfflineConfig):
    """All options of BC; the defaults are the preset ``laptop``."""


# Bi-DexHands has results for BC but no table, so layers, step size and batch are TD3+BC's from Table 46.
PRESETS: dict[str, BCConfig] = {"paper": BCConfig(), "laptop": BCConfig()}


class BC(Offline):
    """Behaviour cloning on data sets (Pomerleau 1988): TD3+BC (arXiv 2106.06860) without its critics."""

    name = "bc"
    remedy = "lower learning_rate"
    config_type = BCConfig
    presets = PRESETS
    config: BCConfig
    policy: DeterministicPolicy
    policy_of = staticmethod(deterministic_policy)
    num_critics = 0

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        return self._fit_actor(self.policy.observations(draw.obs), draw)

    def _fit_actor(self, obs: Tensor, draw: Transitions) -> dict[str, Tensor]:
        with autocast(self.device, self.low_precision):
            actions = self.policy.actor(obs)
        imitation = (actions - draw.actions).square().mean()
        loss, reported = self._actor_loss(imitation, obs, actions)
        self._descend(loss, "actor", self.policy.actor)
        return reported | {"Loss/imitation": imitation.detach()}

    def _actor_loss(self, imitation: Tensor, obs: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return imitation, {}
