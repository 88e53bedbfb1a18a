"""TD3: DDPG with three changes (Fujimoto et al. 2018; Bi-DexHands' appendix B.1.4), on all tasks of a world at once.

    a' = mu'(s') + clip(noise, -c, c)            targets are smoothed over actions,
    y  = r + gamma (1 - terminated) min_i Q'_i(s', a')        taken from the lower of two critics,
    mu, mu', Q'  at every second update          and the actor waits for the critics

All else is as in ``ddpg.py``.
"""

from typing import Any

from torch import Tensor

from bidex_algos.offpolicy.ddpg import DDPG
from bidex_algos.offpolicy.td3_config import PRESETS, TD3Config
from bidex_meta.world.contract import VectorWorld

__all__ = ["PRESETS", "TD3", "TD3Config"]


class TD3(DDPG):
    """Multi-task TD3 (Fujimoto et al. 2018, arXiv 1802.09477) on a batched world.

    Arguments, errors and attributes are those of :class:`~bidex_algos.offpolicy.ddpg.DDPG`.

    Attributes:
        updates: Of the critics so far.
    """

    name = "td3"
    config_type = TD3Config
    config: TD3Config
    num_critics = 2

    def __init__(self, world: VectorWorld, config: TD3Config, seed: int):
        super().__init__(world, config, seed)
        self.updates = 0

    def _actor_is_due(self) -> bool:
        self.updates += 1
        return self.updates % self.config.policy_delay == 0

    def _target_action(self, next_obs: Tensor) -> Tensor:
        action, bound = super()._target_action(next_obs), self.config.target_bound
        noise = self.config.target_std * self._normal(action)
        return (action + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)

    def _place(self) -> dict[str, Any]:
        return {"updates": self.updates, **super()._place()}

    def _go_on_from(self, state: dict[str, Any]) -> None:
        super()._go_on_from(state)
        self.updates = int(state["updates"])
