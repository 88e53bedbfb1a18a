"""Small changes to an episode that make it succeed from more shifted starts, and with softer blows.

The planner looks at reward alone: an episode that solves its task may fail when its start is moved by 0.1 mm, or drive
a finger deep into an egg when it is caught. Here whole episodes are changed, played from several shifted starts, and
kept if more of them succeed, longer, at a higher return, with fewer deep contacts. The shifted starts are not those of
the replay.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from bidex_meta.witness.config import PlannerConfig
from bidex_meta.witness.mutants import mutants
from bidex_meta.witness.planner import interpolation, quantised
from bidex_meta.witness.simulator import Simulator

_STARTS, _CHANGES, _KEPT = 10, 12, 3
_STD = 0.15
_SPACING = 5
"""Control steps between knots of a change."""
_SHALLOW = 0.004
"""Contacts may be as deep as this, metres: a millimetre less than what the stability bar counts."""
_BLOW = 3.0
"""What a deeper state in every start costs; a start that succeeds is worth 1."""


def steadied(
    name: str,
    actions: np.ndarray,
    rounds: int,
    seed: int = 0,
    threads: int | None = None,
    report: Callable[[int, float, float], None] | None = None,
) -> np.ndarray:
    """The best episode found, (T, action_size), multiples of 1/127.

    Args:
        name: The class.
        actions: The episode to begin with, (T, action_size).
        rounds: Rounds of twelve changes, each played from ten shifted starts.
        seed: Of changes and starts.
        threads: Engine threads; None takes all CPUs.
        report: Called after every round with how many starts succeed, the mean return, and an episode's deep states.
    """
    simulator = Simulator(name, _STARTS * _CHANGES, threads)
    states = [s for s in simulator.starts(_STARTS - 1, seed=100 + seed) for _ in range(_CHANGES)]
    base, generator = torch.from_numpy(actions), torch.Generator().manual_seed(seed)
    knots = len(base) // _SPACING + 1
    weights, config = interpolation(len(base), knots), replace(PlannerConfig(), std=_STD)
    kept = torch.zeros(1, knots, base.shape[1])
    for _ in range(rounds):
        changes = mutants(kept, _CHANGES, config, generator)
        changes[0] = kept[0]
        simulator.load(states)
        depths: list[list[float]] = []
        trace = simulator.play(
            quantised(base[:, None] + torch.einsum("tk,nka->tna", weights, changes)).repeat(1, _STARTS, 1),
            partial(_measure, simulator, depths),
        )
        solved = trace.success.any(0).view(_STARTS, _CHANGES).double()
        lasting = trace.success.double().mean(0).view(_STARTS, _CHANGES)
        returns = trace.rewards.sum(0).view(_STARTS, _CHANGES)
        deep = (torch.tensor(depths) > _SHALLOW).double().sum(0).view(_STARTS, _CHANGES).mean(0)
        worth = solved.sum(0) + 4.0 * lasting.mean(0) + 0.01 * returns.mean(0) - _BLOW * deep
        order = worth.argsort(descending=True)
        kept = changes[order[:_KEPT]]
        if report is not None:
            report(int(solved.sum(0)[order[0]]), float(returns.mean(0)[order[0]]), float(deep[order[0]]))
    simulator.close()
    return quantised(base + weights @ kept[0]).numpy()


def _measure(simulator: Simulator, depths: list[list[float]]) -> None:
    """Adds the deepest contact of every row as it stands."""
    depths.append([simulator.contact_depth(row) for row in range(simulator.num)])
