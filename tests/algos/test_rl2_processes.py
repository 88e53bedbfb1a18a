"""RL² in two processes on point goals, joined by gloo."""

from typing import Any

import pytest
import torch

from bidex_algos import learner as base
from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_meta.train import distributed
from bidex_meta.train.runner import checkpoint, resume
from tests.algos.families import PointClass, PointGoals
from tests.algos.ranks import in_two_processes, same

CONFIG = RL2Config(hidden=(8,), memory=8, episodes_per_trial=2, chunk=5, num_minibatches=2, epochs=2)


def learner(goals: int = 3) -> RL2:
    world = PointGoals(6, classes=(PointClass("Short", steps=4, count=3), PointClass("Long", steps=7, count=goals)))
    return RL2(world, CONFIG, seed=0)


def everything(rank: int) -> dict[str, Any]:
    """One start of two processes for all tests, since importing torch takes longer than the rest."""
    alone = learner()
    found: dict[str, Any] = {"alone": [alone.iterate() for _ in range(3)][-1]}
    distributed.init_from_environment()

    # Twins: the same noise in both. What is summed over both must then be what one finds.
    original, base.own_seed = base.own_seed, lambda seed: seed
    twin = learner()
    found["twin"] = [twin.iterate() for _ in range(3)][-1]
    base.own_seed = original

    one = learner(goals=8)
    metrics = [one.iterate() for _ in range(2)]
    state = distributed.share(checkpoint(one, one.world))[0]
    metrics += [one.iterate()]
    found["goals"] = one.world.goal.clone()
    again = learner(goals=8)
    assert state is not None
    resume(again, again.world, state)
    again.iterate()
    found |= {"metrics": metrics, "whole": one.state_dict(), "parts": again.state_dict()}
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return in_two_processes(everything, tmp_path_factory.mktemp("ranks"))


def test_an_update_of_two_with_the_same_noise_is_that_of_one(found):
    for here in found:
        for name in ("Loss/surrogate", "Loss/value", "Policy/kl", "Policy/clip_fraction", "Policy/std"):
            assert here["twin"][name] == pytest.approx(here["alone"][name], rel=1e-3, abs=1e-6)


def test_networks_stay_bit_equal_and_noise_and_tasks_differ(found):
    a, b = (here["whole"] for here in found)
    own = RL2.per_process
    assert same({k: v for k, v in a.items() if k not in own}, {k: v for k, v in b.items() if k not in own})
    assert all(not same(a[name], b[name]) for name in own)
    assert not torch.equal(found[0]["goals"], found[1]["goals"])
    assert a["env_steps"] == 2 * 3 * 2 * (3 * 4 + 3 * 7)


def test_metrics_are_those_of_all_processes(found):
    a, b = ([{k: v for k, v in m.items() if "Perf" not in k} for m in here["metrics"]] for here in found)
    assert a == b and "Loss/value" in a[-1]


def test_a_resumed_run_equals_an_unbroken_one_in_each_process(found):
    for here in found:
        assert same(here["whole"], here["parts"])
