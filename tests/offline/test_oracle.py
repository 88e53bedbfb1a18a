"""TD3+BC and IQL reach on a point mass what d3rlpy's do. Needs an interpreter with d3rlpy, named by D3RLPY_PYTHON."""

import os

import pytest
import torch

from tests.algos.problems import PointMass, discounted_return
from tests.offline.against_d3rlpy import against
from tests.offline.stored import as_data, noisy, played

PYTHON = os.environ.get("D3RLPY_PYTHON")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not PYTHON, reason="D3RLPY_PYTHON names no interpreter with d3rlpy")
def test_the_intervals_of_three_seeds_overlap() -> None:
    world = PointMass()
    data = as_data(played(world, noisy(world.best, 0.5, 0.4), 200))
    found = against(
        data, world, lambda agent: discounted_return(PointMass(rows=1024), agent.eval_action, 0.99, 20), str(PYTHON),
        updates=3000
    )  # fmt: skip
    behaviour = discounted_return(PointMass(rows=1024), noisy(world.best, 0.0, 0.4), 0.99, 20)
    print(found, behaviour, torch.get_num_threads())
    for algo, told in found.items():
        assert told["overlap"], algo
        assert min(told["theirs"] + told["ours"]) > behaviour, algo
