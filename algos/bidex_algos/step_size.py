"""Step sizes that follow the KL, and Adam for an actor and its critic with one."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from bidex_meta.train.learner import Parts, State


def factor_of(kl: Tensor, desired_kl: float) -> Tensor:
    """What to multiply a step size by: 1 / 1.5 above twice the desired KL, 1.5 below half of it, else 1."""
    factor = torch.where(kl > 2.0 * desired_kl, 1.0 / 1.5, 1.0)
    return torch.where(kl < 0.5 * desired_kl, 1.5, factor)


class _Adam(torch.optim.Adam):
    """Adam whose step size stays the tensor that it was given, so that adapting it reaches also a loaded optimiser."""

    def load_state_dict(self, state_dict: State) -> None:
        rates = [group["lr"] for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, rate in zip(self.param_groups, rates, strict=True):
            group["lr"] = rate


def _weights(optimiser: torch.optim.Optimizer) -> list[nn.Parameter]:
    """What an optimiser moves."""
    return [weight for group in optimiser.param_groups for weight in group["params"]]


class AdaptiveAdam:
    """Adam whose step size is divided by 1.5 above twice the desired KL, multiplied below half of it.

    The step size is a tensor: adapting it needs no wait for the device. ``share`` is the part of the config's
    ``desired_kl`` that is these parameters' own: of several agents', each has one.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], config: Any, device: torch.device, eps: float = 1e-8,
        share: float = 1.0
    ):  # fmt: skip
        self.desired_kl = share * config.desired_kl if config.adaptive_learning_rate else None
        self.bounds = config.learning_rate_range
        self.rate = torch.tensor(config.learning_rate, device=device)
        self.actor = _Adam(parameters, lr=self.rate, eps=eps, fused=True)

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        self.actor.zero_grad()

    def descend(self, kl: Tensor | None, max_grad_norm: float) -> None:
        """One step along gradients of at most this norm, its size adapted to the last one's KL (None: none yet)."""
        if kl is not None:
            self.follow(kl)
        nn.utils.clip_grad_norm_(_weights(self.actor), max_grad_norm)
        self.actor.step()

    def follow(self, kl: Tensor) -> None:
        """Adapts the step size to the KL of its last step, a scalar."""
        if self.desired_kl is None:
            return
        self.rate.mul_(factor_of(kl, self.desired_kl)).clamp_(*self.bounds)

    def parts(self) -> Parts:
        """Optimiser and step size, by their names in a checkpoint."""
        return {"actor_adam": self.actor, "learning_rate": self.rate}


class AdaptiveAdams(AdaptiveAdam):
    """One for the actor, one for the critic: of ``critic_learning_rate``, fixed, or None, which follows the actor's."""

    def __init__(
        self, actor: Iterable[nn.Parameter], critic: Iterable[nn.Parameter], config: Any, device: torch.device
    ):
        super().__init__(actor, config, device)
        fixed = config.critic_learning_rate
        self.critic_rate = self.rate if fixed is None else torch.tensor(fixed, device=device)
        self.critic = _Adam(critic, lr=self.critic_rate, fused=True)

    def zero_grad(self) -> None:
        """Forgets the gradients of both."""
        super().zero_grad()
        self.critic.zero_grad()

    def descend(self, kl: Tensor | None, max_grad_norm: float, apart: bool = True, critic_alone: bool = False) -> None:
        """One step of both; ``apart``: each has a norm of its own; ``critic_alone``: the actor stays as it is."""
        if kl is not None and not critic_alone:
            self.follow(kl)
        actor, critic = _weights(self.actor), _weights(self.critic)
        for weights in [actor, critic] if apart else [actor + critic]:
            nn.utils.clip_grad_norm_(weights, max_grad_norm)
        if not critic_alone:
            self.actor.step()
        self.critic.step()

    def parts(self) -> Parts:
        """Both optimisers and the step size, by their names in a checkpoint."""
        return super().parts() | {"critic_adam": self.critic}
