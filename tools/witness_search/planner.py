"""A sampling planner: the cross-entropy method with a receding horizon, which maximises the class's reward.

A plan gives the actions at a few points in time, the knots; actions in between are interpolated. From the present state
the planner samples action sequences, keeps the best sequences as elites, and moves mean and standard deviation towards
the elites. After some rounds the planner plays the first steps of the best sequence; the rest warm-starts the next
plan.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.witness.controller import rest_action
from bidex_meta.witness.replay import Simulator, State, Trace
from bidex_meta.witness.store import quantised
from tools.witness_search.mutants import FINEST, mutants, parts_of_the_hands

RIVALS = 16
"""Number of unsuccessful sequences of each plan that are played to the end of the episode."""


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of the planner."""

    samples: int = 128  # Number of action sequences per round.
    copies: int = 1
    """Number of slightly shifted states, a divisor of ``samples``. Each sequence is played from one of these states.
    The best sequences of a plan are played from all of them, and their mean counts, so that no plan wins by luck."""
    rounds: int = 3  # Number of rounds per plan.
    first_rounds: int = 10  # Number of rounds of the first plan, which has no predecessor.
    rounds_after: int = 1  # Number of rounds per plan once the task has been solved.
    elite_share: float = 0.08  # Share of the sequences towards which mean and standard deviation move.
    kept_elites: int = 8  # Number of elites that are tried again in the next round, and become parents of mutants.
    mutants: float = 0.5
    """Share of the sequences that are an elite with some of its knots changed; the rest is drawn around the mean."""
    mutated: float = 0.15  # Probability that a mutant changes an action, unless it changes one part of the hands.
    horizon: int = 41  # Number of control steps that a plan looks ahead.
    knots: int = 9  # Number of knots of a plan; actions between knots are interpolated linearly.
    execute: int = 10
    """Number of control steps that are played before the next plan. If they end at a knot, the rest of the plan does
    not change."""
    std: float = 0.5
    """Standard deviation of the knots in the first round of a plan. It is scaled by a random factor for each sequence,
    between 0.05 and 1."""
    min_std: float = 0.12  # Lower bound of the standard deviation.
    gamma: float = 0.97  # Discount factor per control step.
    effort: float = 0.05
    """Price of a control step of a base's full force or torque, in units of reward. A full force is up to 800 N.
    Without a price, a hand soon presses on its table so hard that nothing moves it any more."""
    seed: int = 0  # Seed of the samples.


@dataclass(frozen=True)
class Plan:
    """The episode that a search found: its actions and their rewards."""

    actions: np.ndarray  # Actions of the whole episode, (T, action_size), multiples of 1/127.
    rewards: np.ndarray  # Unscaled rewards of these actions, (T,).
    first_success: int | None  # Index of the first successful step, None if there is none.
    rival: float | None
    """Highest return of the unsuccessful episodes that the search saw, or None if it saw none. Before the first success
    these are the best unsuccessful sequences of each plan, with the last action held to the end of the episode. If
    ``rival`` is above ``total``, reward and success disagree."""

    @property
    def total(self) -> float:
        """Return the sum of the rewards."""
        return float(self.rewards.sum())


class Planner:
    """Searches for an episode that solves one class, as the module describes.

    Raises BidexError if ``samples`` is not a multiple of ``copies``.
    """

    def __init__(self, name: str, config: PlannerConfig, threads: int | None = None):
        if config.samples % config.copies:
            raise BidexError(f"Expected samples that copies divide, got {config.samples} and {config.copies}.")
        self.config = config
        self.simulator = Simulator(name, config.samples, threads)
        self._judge = Simulator(name, RIVALS, threads)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._weights = interpolation(config.horizon, config.knots)
        self._of_bases = ~parts_of_the_hands(self.simulator.action_size)[:2].any(0)

    def search(self, earlier: np.ndarray | None = None) -> Plan:
        """Play one episode with replanning, and print the return so far after every plan.

        Every plan also tries the actions (T, action_size) of an ``earlier`` search, at the steps at which they were
        played.
        """
        cfg, sim = self.config, self.simulator
        states = sim.starts(cfg.copies - 1, seed=1 + cfg.seed)  # the starts differ from those of the replay
        mean = rest_action(sim.action_size).repeat(cfg.knots, 1)
        if earlier is not None:
            mean = knots_of(earlier, 0, cfg)
        elites = mean[None]
        actions: list[Tensor] = []
        rewards: list[float] = []
        success: list[bool] = []
        rivals: list[float] = []
        solved = torch.zeros(cfg.copies, dtype=torch.bool)
        while len(rewards) < sim.episode_steps:
            if not actions:
                rounds = cfg.first_rounds
            else:
                rounds = cfg.rounds_after if solved.all() else cfg.rounds
            mean, elites, unsuccessful = self._plan(states, mean, elites, rounds)
            if not any(success):
                rivals += [sum(rewards) + more for more in self._to_the_end(states[0], unsuccessful, len(rewards))]
            best = quantised(self._weights @ elites[0])
            steps = min(cfg.execute, sim.episode_steps - len(rewards))
            states, trace = self._execute(states, best[:steps])
            actions.append(best[:steps])
            rewards += trace.rewards[:, 0].tolist()
            success += trace.success[:, 0].tolist()
            solved |= trace.success.any(0)
            print(f"step {len(rewards)}, return {sum(rewards):.3f}{', success' if any(success) else ''}", flush=True)
            if not trace.alive[0]:
                break
            mean = shifted(mean, steps, cfg.horizon)
            elites = torch.stack([shifted(knots, steps, cfg.horizon) for knots in elites])
            if earlier is not None:
                elites = torch.cat((knots_of(earlier, len(rewards), cfg)[None], elites))
        played = torch.cat(actions)[: len(rewards)].numpy()
        first = success.index(True) if any(success) else None
        return Plan(played, np.array(rewards), first, max(rivals, default=None))

    def _plan(self, states: list[State], mean: Tensor, elites: Tensor, rounds: int) -> tuple[Tensor, Tensor, Tensor]:
        """Improve a plan in some rounds of sampling.

        Returns the new mean of the knots (K, a), the best sequences (E, K, a), and the best sequences that did not
        succeed.
        """
        cfg = self.config
        knots, order, won = elites, torch.arange(len(elites)), torch.zeros(len(elites), dtype=torch.bool)
        std = torch.full_like(mean, cfg.std)
        for _ in range(rounds):
            knots = self._sample(mean, std, elites)
            # Each sequence starts from one copy of the state; every round draws the copies again.
            knots = knots[torch.randperm(len(knots), generator=self._generator)]
            scores, won = self._try(states, knots)
            order = scores.argsort(descending=True)
            chosen = knots[order[: max(2, round(cfg.elite_share * cfg.samples))]]
            mean, std = chosen.mean(0), chosen.std(0).clamp(min=cfg.min_std)
            elites = chosen[: cfg.kept_elites]
        if cfg.copies > 1:
            best = knots[order[: cfg.samples // cfg.copies]]
            scores, _ = self._try(states, best.repeat(cfg.copies, 1, 1))
            elites = best[scores.view(cfg.copies, -1).mean(0).argsort(descending=True)[: cfg.kept_elites]]
        return mean, elites, knots[order[~won[order]]][:RIVALS]

    def _try(self, states: list[State], knots: Tensor) -> tuple[Tensor, Tensor]:
        """Play an equal number of sequences from each state; return scores and successes of sequences, (samples,) each.

        The score is the discounted sum of reward minus effort.
        """
        self.simulator.load(states)
        actions = quantised(torch.einsum("hk,nka->hna", self._weights, knots))
        trace = self.simulator.play(actions)
        effort = self.config.effort * actions[:, :, self._of_bases].square().sum(2)
        discount = self.config.gamma ** torch.arange(self.config.horizon, dtype=torch.float64)
        return (discount[:, None] * (trace.rewards - effort)).sum(0), trace.success.any(0)

    def _to_the_end(self, state: State, knots: Tensor, played: int) -> list[float]:
        """Return the reward that sequences of knots (n, K, a) earn from ``state`` to the end of the episode.

        The last action of a sequence is held to the end. Sequences that succeed on the way are left out. ``played`` is
        the number of steps of the episode before ``state``.
        """
        sim, rest = self._judge, self.simulator.episode_steps - played
        if not len(knots):
            return []
        actions = torch.einsum("hk,nka->hna", self._weights, knots[torch.arange(sim.num) % len(knots)])
        actions = quantised(actions)[torch.arange(rest).clamp(max=self.config.horizon - 1)]
        sim.load([state])
        trace = sim.play(actions)
        return trace.rewards.sum(0)[~trace.success.any(0)].tolist()

    def _sample(self, mean: Tensor, std: Tensor, elites: Tensor) -> Tensor:
        """Return knots to try (samples, K, a): the mean, the elites, mutants of the elites, draws around the mean."""
        cfg, random = self.config, self._generator
        changed = mutants(elites, round(cfg.mutants * cfg.samples), cfg.std, cfg.mutated, random)
        count = cfg.samples - len(changed)
        scale = FINEST ** torch.rand(count, 1, 1, generator=random)
        drawn = mean + std * scale * torch.randn(count, *mean.shape, generator=random)
        knots = torch.cat((changed, drawn))
        # Kept sequences go first, so that the best sequence of a round is never worse than in the round before.
        kept = torch.cat((elites, mean[None]))[: cfg.samples]
        knots[: len(kept)] = kept
        return knots.clamp(-1.0, 1.0)

    def _execute(self, states: list[State], actions: Tensor) -> tuple[list[State], Trace]:
        """Play actions (T, a) from every copy of the state; return the resulting states and the trace.

        The trace has a column for each copy.
        """
        sim = self.simulator
        sim.load(states)
        trace = sim.play(actions[:, None].expand(-1, sim.num, -1))
        rows = range(0, sim.num, sim.num // self.config.copies)
        one_each = Trace(trace.rewards[:, rows], trace.least[:, rows], trace.success[:, rows], trace.alive[rows])
        return [sim.save(row) for row in rows], one_each


def interpolation(horizon: int, knots: int) -> Tensor:
    """Return weights (horizon, knots) of linear interpolation; first and last knot are at the first and last step."""
    return _weights(torch.linspace(0.0, knots - 1.0, horizon), knots)


def _weights(place: Tensor, knots: int) -> Tensor:
    """Return the weights (n, knots) of linear interpolation at places (n,), in units of the space between knots."""
    return (1.0 - (place[:, None] - torch.arange(knots)).abs()).clamp(min=0.0)


def shifted(knots: Tensor, steps: int, horizon: int) -> Tensor:
    """Return the knots (K, a) of a plan after ``steps`` steps have been played; the last value is held."""
    place = torch.linspace(0.0, horizon - 1.0, len(knots)) + steps
    weights = _weights(place * (len(knots) - 1) / (horizon - 1), len(knots))
    weights[place >= horizon - 1] = 0.0
    weights[place >= horizon - 1, -1] = 1.0
    return weights @ knots


def knots_of(actions: np.ndarray, start: int, config: PlannerConfig) -> Tensor:
    """Return the knots (K, a) of a plan that plays actions (T, a) from step ``start`` on; the last action is held."""
    steps = start + torch.linspace(0.0, config.horizon - 1.0, config.knots).round().long()
    return torch.from_numpy(actions)[steps.clamp(max=len(actions) - 1)]
