"""What every learner must do: go on from a saved state as if it had never stopped."""

import io
from collections.abc import Callable
from typing import Any

import torch

from tests.algos.ranks import same


def resumed(make: Callable[[int], Any], iterations: int = 3) -> tuple[Any, Any]:
    """Two learners after twice as many iterations: one without a break, one saved and loaded half-way.

    ``make``: A learner of a seed, with its world as ``learner.world``; ``iterations``: before the break, and after it.
    Raises AssertionError: their metrics differ after the break, or their states at the end.
    """
    unbroken = make(0)
    for _ in range(iterations):
        unbroken.iterate()
    file = io.BytesIO()
    torch.save({"learner": unbroken.state_dict(), "env": unbroken.world.state_dict()}, file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    again = make(77)
    again.world.load_state_dict(state["env"])
    again.load_state_dict(state["learner"])
    for _ in range(iterations):
        a, b = ({k: v for k, v in each.iterate().items() if "Perf" not in k} for each in (unbroken, again))
        assert a == b
    ends = [each.state_dict() for each in (unbroken, again)]
    for end in ends:
        end["policy"].pop("seed", None)  # of the learner's making, which the test lets differ
    assert same(*ends)
    return unbroken, again
