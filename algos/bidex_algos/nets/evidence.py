"""What rewards tell of a goal: a model of what any goal would have paid, candidates, and a policy that acts on them.

The model is VariBAD's decoder of rewards (Zintgraf et al. 2020, arXiv 1910.08348) for a goal in numbers that are known
in training. With it belief is Bayes' rule: the memory holds the log-likelihood of each of some fixed candidates, to
which every rewarded step adds its own.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, linear
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy

_TAIL = 4.0  # degrees of freedom of the Student distribution that errors of the model are taken to have


def spread(count: int, size: int) -> Tensor:
    """Points (count, size) spread evenly over [-1, 1]: an additive recurrence (R_d of Roberts 2018)."""
    root = 1.5
    for _ in range(50):  # x^(size + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (size + 1.0))
    steps = torch.tensor([root ** -(axis + 1.0) for axis in range(size)], dtype=torch.float64)
    return (2.0 * ((0.5 + torch.arange(1.0, count + 1.0)[:, None] * steps) % 1.0) - 1.0).float()


class BeliefNet(nn.Module):
    """A model of rewards, and an actor that is given a goal. ``hidden``: layers that an observation passes there."""

    def __init__(
        self, seen: Inputs, hidden: Sequence[int], candidates: int, head: Sequence[int], goals: int, actions: int,
        generator: torch.Generator, activation: Activation = "elu"
    ):  # fmt: skip
        super().__init__()
        width = hidden[-1]
        self.encoder = MLP(seen, hidden[:-1], width, 1.0, generator, activation)
        self.goal, self.activation = linear(goals, width, 1.0, generator), ACTIVATIONS[activation]()
        self.paid = MLP(width, (max(1, width // 2),), 2, 0.01, generator, activation)
        self.head = MLP(seen.extended("believed", goals), head, actions, 0.01, generator, activation)
        self.candidates: Tensor
        self.register_buffer("candidates", spread(candidates, goals))

    def pays(self, seen: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-deviation (..., g) of the reward in a state (..., d) for goals (..., g, n); all normalised."""
        both = self.activation(self.encoder(seen)[..., None, :] + self.goal(goals))
        mean, log_std = self.paid(both).unbind(-1)
        return mean, log_std.clamp(-6.0, 2.0)

    def act(self, seen: Tensor, goal: Tensor) -> Tensor:
        """Mean actions (..., actions) for normalised observations and goals."""
        return self.head(torch.cat([seen, goal], dim=-1))


class BeliefPolicy(RecurrentPolicy):
    """A policy that acts on the mean of its belief of the goal, and where it explores, on a candidate drawn from it.

    ``actor`` is a :class:`BeliefNet`. Its memory (N, candidates) adds up log-likelihoods, each counted ``trust`` times:
    the model's errors in neighbouring steps are alike. A candidate is tried for ``try_steps`` steps in the mean.
    """

    actor: BeliefNet

    def __init__(
        self, inputs: Inputs, actions: int, candidates: int, goals: int, try_steps: int, trust: float, *rest: Any
    ):
        """``goals``: numbers of a goal; the others as of :class:`RecurrentPolicy`."""
        super().__init__(inputs, actions, candidates, *rest)
        self.goals, self.try_steps, self.trust = ObservationNormaliser(goals), try_steps, trust

    def drawn(self, last: Tensor | None, rows: int, generator: torch.Generator) -> Tensor:
        """Which candidate is tried: the place (rows, 1) in [0, 1) of the sum of their probabilities."""
        device = self.log_std.device
        new, again = torch.rand(2, rows, 1, generator=generator, device=device)
        return new if last is None else torch.where(again < 1.0 / self.try_steps, new, last)

    def evidence(self, obs: Tensor, reward: Tensor) -> Tensor:
        """Log-likelihoods (N, candidates) of the rewards (N,) that led to raw observations (N, d)."""
        mean, log_std = self.actor.pays(self.observations(obs), self.goals(self.actor.candidates))
        off = (self.earned(reward)[:, None] - mean) / log_std.exp()
        return self.trust * (-0.5 * (_TAIL + 1.0) * torch.log1p(off.square() / _TAIL) - log_std)

    def believed(self, state: Tensor) -> Tensor:
        """Means (N, n) of the beliefs in memories (N, candidates)."""
        return state.softmax(-1) @ self.actor.candidates

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Memory, drawn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As in the base; where ``drawn`` is negative nothing is tried."""
        known = memory.known & ~memory.done  # what the last step of an episode led to was not seen
        state = memory.state + self.evidence(obs, memory.reward).masked_fill(~known[:, None], 0.0)
        goal = self.believed(state)
        if drawn is not None:
            place = (state.softmax(-1).cumsum(-1) < drawn).sum(-1).clamp_max(self.memory - 1)
            goal = torch.where(drawn < 0.0, goal, self.actor.candidates[place])
        return self.actor.act(self.observations(obs), self.goals(goal)), state
