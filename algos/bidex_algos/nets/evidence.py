"""A memory that adds up evidence, what it lets believe of a goal, and a policy that acts on that.

What a trial hides does not change in it, so the order of its steps does not matter: as log-likelihoods add up, so do a
step's notes. The memory holds weighted means of them, one for each head, as linear attention does (Katharopoulos et al.
2020, arXiv 2006.16236); all steps of a trial pass at once.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, linear
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy

NO_EVIDENCE = ("right_hand", "left_hand", "padding", "task_id")
"""Groups of an observation that are not noted: with the hands a memory learns fifty tasks by heart, not the rewards."""


class BeliefNet(nn.Module):
    """Notes of steps, belief of the normalised goal from their sum, and an actor that is given a goal."""

    def __init__(
        self, seen: Inputs, hidden: Sequence[int], heads: int, size: int, head: Sequence[int],
        goals: int, actions: int, generator: torch.Generator, activation: Activation = "elu"
    ):  # fmt: skip
        super().__init__()
        self.noted = seen.columns(*(group.name for group in seen.groups if group.name not in NO_EVIDENCE))
        self.heads, self.size = heads, size
        features = MLP(self.noted.size + 1, hidden[:-1], hidden[-1], 1.0, generator, activation)
        self.encoder = nn.Sequential(features, ACTIVATIONS[activation]())
        self.weigh, self.note = (linear(hidden[-1], n, 1.0, generator) for n in (heads, heads * size))
        memory, middle = heads * (size + 1), hidden[-1]
        self.belief, self.doubt = (MLP(memory, (middle,), goals, 0.01, generator, activation) for _ in range(2))
        self.head = MLP(seen.extended("believed", goals), head, actions, 0.01, generator, activation)

    def evidence(self, noted: Tensor, earned: Tensor, known: Tensor) -> Tensor:
        """What steps add to the memory, (..., heads * (1 + size)); nothing where no reward is known.

        Of normalised columns of the observation (..., n), the normalised reward that led there (...), and whether it is
        known.
        """
        features = self.encoder(torch.cat([noted, earned[..., None]], dim=-1))
        weight = self.weigh(features).clamp(-8.0, 8.0).exp() * known[..., None]
        notes = weight[..., None] * self.note(features).unflatten(-1, (self.heads, self.size))
        return torch.cat([weight, notes.flatten(-2)], dim=-1)

    def believe(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the goal, (..., goals) each, for memories (..., heads * (1 + size))."""
        weight, notes = memory[..., : self.heads] + 1e-6, memory[..., self.heads :]
        means = notes.unflatten(-1, (self.heads, self.size)) / weight[..., None]
        known = torch.cat([weight.log() / 3.0, means.flatten(-2)], dim=-1)
        # The deviation learns from what the memory is good for, and does not shape it.
        return self.belief(known), self.doubt(known.detach()).clamp(-5.0, 1.0).exp()

    def act(self, seen: Tensor, goal: Tensor) -> Tensor:
        """Mean actions (..., actions) for normalised observations and goals."""
        return self.head(torch.cat([seen, goal], dim=-1))


class BeliefPolicy(RecurrentPolicy):
    """A policy that acts on what it believes of the goal; where it explores, on one drawn from its belief.

    ``actor`` is a :class:`BeliefNet`; a goal is tried for ``try_steps`` steps in the mean.
    """

    actor: BeliefNet

    def __init__(self, inputs: Inputs, actions: int, memory: int, goals: int, try_steps: int, *rest: Any):
        """``goals``: numbers of a goal; the others as of :class:`RecurrentPolicy`."""
        super().__init__(inputs, actions, memory, *rest)
        self.goals, self.try_steps = ObservationNormaliser(goals), try_steps

    def drawn(self, last: Tensor | None, rows: int, generator: torch.Generator) -> Tensor:
        """Standard normals (rows, goals): deviations of the goal that is tried from the mean, in deviations."""
        device = self.log_std.device
        new = torch.randn(rows, self.goals.shift.numel(), generator=generator, device=device)
        again = torch.rand(rows, 1, generator=generator, device=device) < 1.0 / self.try_steps
        return new if last is None else torch.where(again, new, last)

    def evidence(self, noted: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """As of :class:`BeliefNet`, for raw columns and rewards."""
        columns = self.actor.noted
        return self.actor.evidence(
            self.observations.some(noted, columns), self.rewards(self._compressed(reward)).squeeze(-1), known
        )

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Memory, drawn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As in the base."""
        state = memory.state + self.evidence(self.actor.noted(obs), memory.reward, memory.known)
        goal, std = self.actor.believe(state)
        if drawn is not None:
            goal = goal + std * drawn
        return self.actor.act(self.observations(obs), goal), state
