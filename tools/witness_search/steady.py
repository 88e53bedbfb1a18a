"""Make small changes to an episode so that it succeeds from more shifted starts, and with softer contacts.

The planner considers only reward: an episode that solves its task may fail when its start is moved by 0.1 mm, or may
drive a finger deep into an egg during a catch. Here whole episodes are changed and played from several shifted starts.
Changes are ranked by the number of starts that succeed, the duration of success, the return, and the number of deep
contacts. The shifted starts are not the starts that the replay uses.
"""

from itertools import product

import numpy as np
import torch

from bidex_meta.witness.replay import Simulator
from bidex_meta.witness.store import quantised
from tools.witness_search.mutants import mutants
from tools.witness_search.planner import interpolation

_STARTS, _CHANGES, _KEPT = 10, 12, 3
_STD, _MUTATED = 0.15, 0.15
_SPACING = 5
"""Control steps between knots of a change."""
_SHALLOW = 0.004
"""Depth of contacts beyond which a state is deep, metres; a millimetre less than in ``tools.bench stability``."""
_BLOW = 3.0
"""Cost of one deep state per start, in a score in which each start that succeeds is worth 1."""


def steadied(name: str, actions: np.ndarray, rounds: int, seed: int = 0, threads: int | None = None) -> np.ndarray:
    """Return the best episode, (T, action_size), in multiples of 1/127; print the result of each round's best episode.

    The search begins with ``actions`` (T, action_size). A round plays twelve changes from ten shifted starts.
    """
    simulator = Simulator(name, _STARTS * _CHANGES, threads)
    states = [state for state, _ in product(simulator.starts(_STARTS - 1, seed=100 + seed), range(_CHANGES))]
    base, generator = torch.from_numpy(actions), torch.Generator().manual_seed(seed)
    knots = len(base) // _SPACING + 1
    weights = interpolation(len(base), knots)
    kept = torch.zeros(1, knots, base.shape[1])
    depths: list[list[float]] = []

    def measure() -> None:
        depths.append([simulator.contact_depth(row) for row in range(simulator.num)])

    for _ in range(rounds):
        changes = mutants(kept, _CHANGES, _STD, _MUTATED, generator)
        changes[0] = kept[0]
        simulator.load(states)
        depths.clear()
        played = quantised(base[:, None] + torch.einsum("tk,nka->tna", weights, changes))
        trace = simulator.play(played.repeat(1, _STARTS, 1), measure)
        solved = trace.success.any(0).view(_STARTS, _CHANGES).double()
        lasting = trace.success.double().mean(0).view(_STARTS, _CHANGES)
        returns = trace.rewards.sum(0).view(_STARTS, _CHANGES)
        deep = (torch.tensor(depths) > _SHALLOW).double().sum(0).view(_STARTS, _CHANGES).mean(0)
        worth = solved.sum(0) + 4.0 * lasting.mean(0) + 0.01 * returns.mean(0) - _BLOW * deep
        order = worth.argsort(descending=True)
        kept = changes[order[:_KEPT]]
        best = order[0]
        starts = f"{solved.sum(0)[best]:.0f} of 10 shifted starts"
        print(f"{starts}, mean return {returns.mean(0)[best]:.3f}, deep states {deep[best]:.1f}", flush=True)
    simulator.close()
    return quantised(base + weights @ kept[0]).numpy()
