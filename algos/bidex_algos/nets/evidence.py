"""What rewards tell of a goal: a model of what any goal would have paid, candidates, and a policy that acts on them.

The model is VariBAD's decoder of rewards (Zintgraf et al. 2020, arXiv 1910.08348) for a goal in numbers that are known
in training. With it belief is Bayes' rule: the memory holds the log-likelihood of each of some fixed candidates, to
which every rewarded step adds its own.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Towers
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, Headed, head_of, linear
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy
from bidex_meta.utils import maths

_WHICH = 64  # width of the hidden layer of the network that tells classes apart
_TAIL = 4.0  # degrees of freedom of the Student distribution that errors of the model are taken to have


def spread(count: int, size: int) -> Tensor:
    """Points (count, size) spread evenly over [-1, 1]: an additive recurrence (R_d of Roberts 2018)."""
    root = 1.5
    for _ in range(50):  # x^(size + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (size + 1.0))
    steps = torch.tensor([root ** -(axis + 1.0) for axis in range(size)], dtype=torch.float64)
    return (2.0 * ((0.5 + torch.arange(1.0, count + 1.0)[:, None] * steps) % 1.0) - 1.0).float()


class BeliefNet(nn.Module):
    """A model of rewards, and an actor that is given a goal. ``hidden``: layers that an observation passes there.

    With more than one of ``classes``, whose numbers the observation does not show, a third network says which it is
    of. A goal's numbers enter the model by weights of the class's own, and behind the first layer so does the actor.
    """

    def __init__(
        self, seen: Inputs, hidden: Sequence[int], candidates: int, head: Sequence[int], goals: int, actions: int,
        generator: torch.Generator, activation: Activation = "elu", classes: int = 1
    ):  # fmt: skip
        super().__init__()
        width, self.classes = hidden[-1], classes
        self.encoder = MLP(seen, hidden[:-1], width, 1.0, generator, activation)
        # One layer of all classes: of each, the columns have length 1.
        self.goal = linear(goals, classes * width, math.sqrt(classes), generator)
        self.activation = ACTIVATIONS[activation]()
        self.paid = MLP(width, (max(1, width // 2),), 2, 0.01, generator, activation)
        given = seen.extended("believed", goals)
        if classes == 1:
            self.head: Headed = MLP(given, head, actions, 0.01, generator, activation)
        else:
            given = given.extended("task_id", classes)
            self.head = Towers(given, head, classes * actions, 0.01, generator, activation, modules=1, shared=1)
            self.which = MLP(seen, (_WHICH,), classes, 0.01, generator, activation)
        self.candidates: Tensor
        self.register_buffer("candidates", spread(candidates, goals))

    def class_of(self, seen: Tensor) -> Tensor:
        """The class (B,) that normalised observations (B, d) look like."""
        if self.classes == 1:
            return torch.zeros(len(seen), dtype=torch.int64, device=seen.device)
        return self.which(seen).argmax(-1)

    def pays(self, seen: Tensor, goals: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-deviation (B, g) of the reward in states (B, d) of classes (B,), for goals (B, g, n) or (g, n).

        All normalised.
        """
        if self.classes == 1:
            wanted = self.goal(goals)
        else:
            weight, bias = (x.unflatten(0, (self.classes, -1))[task] for x in (self.goal.weight, self.goal.bias))
            wanted = goals @ weight.mT + bias[:, None]
        both = self.activation(self.encoder(seen)[:, None] + wanted)
        mean, log_std = self.paid(both).unbind(-1)
        return mean, log_std.clamp(-6.0, 2.0)

    def act(self, seen: Tensor, goal: Tensor, task: Tensor) -> Tensor:
        """Mean actions (B, actions) for normalised observations and goals, in states of classes (B,)."""
        given = torch.cat([seen, goal], dim=1)
        if self.classes == 1:
            return self.head(given)
        one_hot = nn.functional.one_hot(task, self.classes).to(given.dtype)
        given = torch.cat([given, one_hot], dim=1)
        if maths.may_look(given.device):
            return self.head.of_head(given, task, self.classes)
        return head_of(one_hot, self.head(given), self.classes)


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

    def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """Log-likelihoods (N, candidates) of the rewards (N,) that led to raw observations (N, d); 0 if not ``known``.

        They take most of a step's time: where looking costs nothing, unknown ones are left out.
        """
        if maths.may_look(known.device):
            found = torch.zeros(len(obs), self.memory)
            if known.any():
                found[known] = self._likelihood(obs[known], reward[known])
            return found
        return self._likelihood(obs, reward).masked_fill(~known[:, None], 0.0)

    def _likelihood(self, obs: Tensor, reward: Tensor) -> Tensor:
        seen, actor = self.observations(obs), self.actor
        mean, log_std = actor.pays(seen, self.goals(actor.candidates), actor.class_of(seen))
        off = (self.earned(reward)[:, None] - mean) / log_std.exp()
        return self.trust * (-0.5 * (_TAIL + 1.0) * torch.log1p(off.square() / _TAIL) - log_std)

    def believed(self, state: Tensor) -> Tensor:
        """Means (N, n) of the beliefs in memories (N, candidates)."""
        return state.softmax(-1) @ self.actor.candidates

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Memory, drawn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As in the base; where ``drawn`` is negative nothing is tried."""
        known = memory.known & ~memory.done  # what the last step of an episode led to was not seen
        state = memory.state + self.evidence(obs, memory.reward, known)
        goal = self.believed(state)
        if drawn is not None:
            place = (state.softmax(-1).cumsum(-1) < drawn).sum(-1).clamp_max(self.memory - 1)
            goal = torch.where(drawn < 0.0, goal, self.actor.candidates[place])
        seen = self.observations(obs)
        return self.actor.act(seen, self.goals(goal), self.actor.class_of(seen)), state
