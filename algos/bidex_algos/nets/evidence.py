"""Inference of a goal from rewards by a reward model, and a policy that acts on the resulting belief.

The reward model is VariBAD's decoder of rewards (Zintgraf et al. 2020, arXiv 1910.08348), but it reads the goal, which
is known in training, instead of a latent variable. The belief is a probability for each goal in a fixed list of
candidates and follows from Bayes' rule. The memory holds the log-likelihood of each candidate; every rewarded step adds
the log-likelihood of its reward.
"""

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from bidex_algos.nets.borrowed import BorrowedPolicy
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Towers
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, Headed, head_of, linear
from bidex_algos.nets.normalise import ObservationNormaliser, TaskNormaliser
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy
from bidex_meta.utils import maths

_WHICH = 64  # width of the hidden layer of the network that classifies observations
_TAIL = 4.0  # degrees of freedom of the Student distribution assumed for the model's errors


def cumulated(shares: Tensor) -> Tensor:
    """Return cumulative sums along the last axis.

    In deterministic mode torch refuses ``cumsum`` of floats on a GPU, where the sums are therefore a product.
    """
    if maths.may_look(shares.device):  # on a CPU
        return shares.cumsum(-1)
    return (shares.double() @ _ones_above(shares.shape[-1], shares.device)).to(shares.dtype)


def _ones_above(size: int, device: torch.device) -> Tensor:
    return torch.ones(size, size, dtype=torch.float64, device=device).triu()


def spread(count: int, size: int) -> Tensor:
    """Return points (count, size) spread evenly over [-1, 1]: an additive recurrence (R_d of Roberts 2018)."""
    root = 1.5
    for _ in range(50):  # solves x^(size + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (size + 1.0))
    steps = torch.tensor([root ** -(axis + 1.0) for axis in range(size)], dtype=torch.float64)
    return (2.0 * ((0.5 + torch.arange(1.0, count + 1.0)[:, None] * steps) % 1.0) - 1.0).float()


class BeliefNet(nn.Module):
    """A reward model and an actor, which both read an observation and a goal.

    ``hidden`` are the layers with which the reward model encodes the observation; ``head`` are the actor's layers. The
    observation does not show the class, so a third network predicts it if ``classes`` is above 1. In the reward model
    each class has its own layers for the observation and its own weights for the goal. In the actor each class has its
    own layers after the first.
    """

    def __init__(
        self, seen: Inputs, hidden: Sequence[int], candidates: int, head: Sequence[int], goals: int, actions: int,
        generator: torch.Generator, activation: Activation = "elu", classes: int = 1
    ):  # fmt: skip
        super().__init__()
        width = hidden[-1]
        self.classes = classes
        if classes == 1:
            self.encoder: Headed = MLP(seen, hidden[:-1], width, 1.0, generator, activation)
        else:
            own = seen.extended("task_id", classes)
            self.encoder = Towers(own, hidden[:-1], classes * width, 1.0, generator, activation, modules=1, shared=0)
        # One layer holds all classes; the columns of each class have unit norm.
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

    def class_of_normalised(self, seen: Tensor) -> Tensor:
        """Predict the class (B,) of observations (B, d) that are normalised by the statistics of all classes."""
        if self.classes == 1:
            return torch.zeros(len(seen), dtype=torch.int64, device=seen.device)
        return self.which(seen).argmax(-1)

    def decode_reward(self, seen: Tensor, goals: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Predict mean and log standard deviation (B, g) of the rewards for goals (B, g, n) or (g, n).

        ``seen`` are observations (B, d), ``task`` are their classes (B,). Observations, by statistics of their class,
        goals and rewards are normalised.
        """
        if self.classes == 1:
            wanted = self.goal(goals)
        else:
            weight, bias = (x.unflatten(0, (self.classes, -1))[task] for x in (self.goal.weight, self.goal.bias))
            wanted = goals @ weight.mT + bias[:, None]
        both = self.activation(self._of_class(self.encoder, seen, task)[:, None] + wanted)
        mean, log_std = self.paid(both).unbind(-1)
        return mean, log_std.clamp(-6.0, 2.0)

    def act(self, seen: Tensor, goal: Tensor, task: Tensor) -> Tensor:
        """Return mean actions (B, actions) for observations (B, d), goals (B, n) and classes (B,).

        Observations, by statistics of their class, and goals are normalised.
        """
        return self._of_class(self.head, torch.cat([seen, goal], dim=1), task)

    def _of_class(self, net: Headed, inputs: Tensor, task: Tensor) -> Tensor:
        """Return the outputs of a network for inputs (B, d) of the classes ``task`` (B,)."""
        if self.classes == 1:
            return net(inputs)
        one_hot = nn.functional.one_hot(task, self.classes).to(inputs.dtype)
        inputs = torch.cat([inputs, one_hot], dim=1)
        if maths.may_look(inputs.device):
            return net.of_head(inputs, task, self.classes)
        return head_of(one_hot, net(inputs), self.classes)


class Belief(Protocol):
    """Infers the goal, n numbers in [-1, 1], from rewards, as a belief over a fixed list of candidates."""

    @property
    def candidates(self) -> Tensor:
        """Return the candidate goals (C, n)."""
        ...

    def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """Return log-likelihoods (N, C) of the last rewards (N,); 0 if a reward is not ``known``.

        ``obs`` are the raw observations (N, d) after the rewarded step.
        """
        ...

    def believed(self, state: Tensor) -> Tensor:
        """Return the goals (N, n) to act on, given the sums (N, C) of the evidence of a trial."""
        ...


class ModelBelief:
    """The belief about the goal that follows from the reward model of a policy, over the candidates of its actor.

    Each log-likelihood is multiplied by ``trust``, because the model's errors in successive steps are correlated.
    """

    def __init__(self, policy: "BeliefPolicy", trust: float):
        self._policy = policy
        self._trust = trust

    @property
    def candidates(self) -> Tensor:
        """Return the candidates of the actor, (C, n)."""
        return self._policy.actor.candidates

    def evidence(self, obs: Tensor, reward: Tensor, known: Tensor) -> Tensor:
        """Return the log-likelihood of each reward (N,) under each candidate, (N, C); 0 if a reward is not ``known``.

        This takes most of a step's time. On the CPU, where a host sync is free, unknown rewards are therefore skipped.
        """
        if maths.may_look(known.device):
            found = torch.zeros(len(obs), len(self.candidates))
            if known.any():
                found[known] = self._likelihood(obs[known], reward[known])
            return found
        return self._likelihood(obs, reward).masked_fill(~known[:, None], 0.0)

    def believed(self, state: Tensor) -> Tensor:
        """Return the means (N, n) of the beliefs."""
        return state.softmax(-1) @ self.candidates

    def _likelihood(self, obs: Tensor, reward: Tensor) -> Tensor:
        policy = self._policy
        task = policy.class_of(obs)
        mean, log_std = policy.actor.decode_reward(policy.seen(obs, task), policy.goals(self.candidates), task)
        off = (policy.earned(reward)[:, None] - mean) / log_std.exp()
        return self._trust * (-0.5 * (_TAIL + 1.0) * torch.log1p(off.square() / _TAIL) - log_std)


class BeliefPolicy(RecurrentPolicy):
    """A policy that acts on its belief about the goal; an exploring policy acts on a candidate drawn from the belief.

    ``actor`` is a :class:`BeliefNet`. The memory (N, candidates) sums the evidence of the steps. A drawn candidate is
    kept for ``try_steps`` steps on average.
    """

    actor: BeliefNet

    def __init__(
        self, inputs: Inputs, actions: int, candidates: int, goals: int, try_steps: int, trust: float, *rest: Any,
        belief: Belief | None = None
    ):  # fmt: skip
        """Make the networks and the belief.

        Args:
            inputs: Inputs of the networks, as for :class:`RecurrentPolicy`.
            actions: Number of actions.
            candidates: Number of candidates of the actor.
            goals: Number of entries of a goal.
            try_steps: Mean number of steps for which exploration keeps a candidate.
            trust: Weight of the evidence of a :class:`ModelBelief`.
            rest: The other arguments of :class:`RecurrentPolicy`.
            belief: Infers the goal. Default: a :class:`ModelBelief` of this policy.
        """
        super().__init__(inputs, actions, candidates if belief is None else len(belief.candidates), *rest)
        self.goals = ObservationNormaliser(goals)
        self.own: TaskNormaliser | None = None
        """Statistics of each class's observations, for the reward model and the actor; None if there is one class."""
        if self.observations.enabled and self.actor.classes > 1:
            self.own = TaskNormaliser(inputs, self.actor.classes)
        self.borrowed: BorrowedPolicy | None = None
        """Acts instead of the actor, which then predicts entries of the observation that show a goal."""
        self.try_steps = try_steps
        self.belief: Belief = belief or ModelBelief(self, trust)

    def seen(self, obs: Tensor, task: Tensor) -> Tensor:
        """Normalise raw observations (B, d) of the classes ``task`` (B,) for the reward model and the actor."""
        if self.own is None:
            return self.observations(obs)
        return self.own(obs, task)

    def class_of(self, obs: Tensor) -> Tensor:
        """Predict the class (B,) of raw observations (B, d)."""
        return self.actor.class_of_normalised(self.observations(obs))

    def drawn(self, last: Tensor | None, rows: int, generator: torch.Generator) -> Tensor:
        """Draw the candidate on which each of ``rows`` environments acts when it explores.

        The result (rows, 1) is a position in [0, 1) within the cumulative probabilities of the candidates. A row keeps
        its ``last`` position with a probability of 1 - 1 / ``try_steps``.
        """
        device = self.log_std.device
        new, again = torch.rand(2, rows, 1, generator=generator, device=device)
        if last is None:
            return new
        return torch.where(again < 1.0 / self.try_steps, new, last)

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Memory, drawn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return mean actions (N, a) and the memory's next state (N, candidates) for raw observations (N, d).

        ``drawn`` (N, 1) is the result of :meth:`drawn`; the policy does not explore in environments with a negative
        entry. With None the policy explores in no environment.
        """
        known = memory.known & ~memory.done  # the state after the last step of an episode was not seen
        state = memory.state + self.belief.evidence(obs, memory.reward, known)
        goal = self.belief.believed(state)
        if drawn is not None:
            place = (cumulated(state.softmax(-1)) < drawn).sum(-1).clamp_max(self.memory - 1)
            goal = torch.where(drawn < 0.0, goal, self.belief.candidates[place])
        task = self.class_of(obs)
        found = self.actor.act(self.seen(obs, task), self.goals(goal), task)
        if self.borrowed is not None:
            return self.borrowed.eval_action(obs, found, task), state
        return found, state
