"""Demonstrations for PPO: a behaviour-cloning term in the loss, and behaviour cloning before training."""

import torch
from torch import Tensor

from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import GaussianPolicy
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import own_seed, sum_gradients, world_size

WEIGHT = 0.1  # initial weight of the term of behaviour cloning
HALF_LIFE = 500_000.0  # environment steps after which the weight has halved

_DEMONSTRATED = 0xDE30  # seeds a separate generator, so that demonstrations do not change the learner's draws


class Demonstrations:
    """Transitions that a policy imitates while it learns from rewards; some tasks may have no transitions.

    A term of behaviour cloning is added to the loss, and its weight fades, as in DAPG (Rajeswaran et al. 2018, arXiv
    1709.10087, equation 6). Normalised advantages replace DAPG's weighting by the largest advantage.
    """

    def __init__(self, data: Joined, batch_size: int, seed: int, device: torch.device):
        self.batch_size = batch_size
        self.fingerprint = data.fingerprint()
        self._obs = data.observations.index_select(0, data.at).to(device)
        self._actions = data.actions.to(device)
        counts = torch.bincount(data.task)
        self._of_task = torch.argsort(data.task, stable=True).to(device)
        self._first = (counts.cumsum(0) - counts)[counts > 0].to(device)
        self._count = counts[counts > 0].to(device)
        self.generator = torch.Generator(device).manual_seed(own_seed(seed) ^ _DEMONSTRATED)

    def weight(self, env_steps: int) -> float:
        """Return the weight of the behaviour-cloning term in the loss after ``env_steps`` environment steps.

        The weight is halved every ``HALF_LIFE`` steps.
        """
        return WEIGHT * 0.5 ** (env_steps / HALF_LIFE)

    def draw(self) -> tuple[Tensor, Tensor]:
        """Draw raw observations (B, d) and actions (B, a).

        All tasks that have transitions are drawn equally often on average.
        """
        size = (self.batch_size,)
        device = self._obs.device
        task = torch.randint(len(self._count), size, generator=self.generator, device=device)
        # A remainder of this large number favours no entry by more than 1 in 2^40 / transitions.
        place = torch.randint(2**40, size, generator=self.generator, device=device) % self._count[task]
        chosen = self._of_task[self._first[task] + place]
        return self._obs[chosen], self._actions[chosen]

    def loss(self, policy: GaussianPolicy) -> Tensor:
        """Return the mean of (a - mean)^2 / (2 std^2), summed over actions.

        Standard deviations get no gradient, because only rewards move them.
        """
        raw, actions = self.draw()
        obs = policy.observations(raw)
        with autocast(raw.device, policy.low_precision):
            means = policy.actor(obs)
        return imitation(actions, means.float(), policy.actor.log_std_of(obs).detach())

    def clone(self, policy: GaussianPolicy, steps: int) -> None:
        """Clone the demonstrated behaviour: update observation statistics, then train the mean for ``steps`` steps."""
        if not steps:
            return
        policy.observations.update(self._obs)
        weights = list(policy.actor.parameters())
        adam = torch.optim.Adam(weights, lr=1e-3)
        for _ in range(steps):
            adam.zero_grad()
            loss = self.loss(policy) / world_size()
            loss.backward()
            sum_gradients(weights, loss.detach()[None])
            adam.step()

    def check(self, learner: str, stored: dict[str, float] | None) -> None:
        """Raise BidexError if a checkpoint was made with demonstrations other than these.

        ``stored`` is the fingerprint of the demonstrations in the checkpoint, or None if the checkpoint has none.
        """
        if stored is not None and stored != self.fingerprint:
            raise BidexError(
                f"{learner}: the checkpoint's demonstrations are others ({stored['transitions']:,.0f} transitions, "
                f"here {self.fingerprint['transitions']:,.0f}). Resume with the run's own data set."
            )


def imitation(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Return half the mean squared distance, in standard deviations, of actions (B, a) from means (B, a): a scalar."""
    return 0.5 * ((actions - means) / log_std.exp()).square().sum(-1).mean()
