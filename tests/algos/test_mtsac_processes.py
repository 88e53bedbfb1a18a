"""MT-SAC in two processes on a toy world, joined by gloo."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from bidex_algos import learner as base
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_meta.train import distributed
from bidex_meta.train.runner import checkpoint, resume
from tests.algos.problems import opposite_bandits
from tests.algos.ranks import in_two_processes, same

CONFIG = MTSACConfig(
    hidden=(16,), replay_steps=60, cut_share=0.3, warmup_steps=3, updates_per_step=2, batch_size=32, autocast="off"
)
# Steps in proportion to the gradient: Adam as such would not see a sum in the place of a mean.
PLAIN = replace(
    CONFIG, adam_eps=10.0, max_grad_norm=1e9, learning_rate=0.5, critic_learning_rate=0.5, alpha_learning_rate=0.5
)


def learner(config: MTSACConfig = CONFIG) -> MTSAC:
    return MTSAC(opposite_bandits(rows=4, scale=10.0), config, seed=0)


def networks(one: MTSAC) -> torch.Tensor:
    return torch.cat(
        [p.detach().flatten() for p in [*one.policy.parameters(), *one.critic.parameters(), one.log_alpha]]
    )


def everything(rank: int) -> dict[str, Any]:
    """One start of two processes for all tests, since importing torch takes longer than the rest."""
    alone = learner(PLAIN)
    found: dict[str, Any] = {"start": networks(alone)}
    alone.iterate()
    found["alone"] = networks(alone)
    distributed.init_from_environment()

    # Twins: the same draws and noise in both. Sums over both must then be the means that one finds.
    original, base.own_seed = base.own_seed, lambda seed: seed
    twin = learner(PLAIN)
    twin.iterate()
    base.own_seed = original
    found["twin"] = networks(twin)

    one = learner()
    metrics = [one.iterate() for _ in range(2)]
    state = distributed.share(checkpoint(one, one.world))[0]
    metrics += [one.iterate()]
    again = learner()
    assert state is not None
    resume(again, again.world, state)
    again.iterate()
    found |= {"metrics": metrics, "whole": one.state_dict(), "parts": again.state_dict()}
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return in_two_processes(everything, tmp_path_factory.mktemp("ranks"))


def test_an_update_of_two_with_the_same_draws_is_that_of_one(found):
    for here in found:
        assert (here["alone"] - here["start"]).norm() > 0.01
        assert (here["twin"] - here["alone"]).norm() <= 1e-3 * (here["alone"] - here["start"]).norm()


def test_networks_stay_bit_equal_and_noise_and_replay_differ(found):
    a, b = (here["whole"] for here in found)
    own = MTSAC.per_process
    assert same({k: v for k, v in a.items() if k not in own}, {k: v for k, v in b.items() if k not in own})
    assert all(not same(a[name], b[name]) for name in own)
    assert a["env_steps"] == 2 * 3 * CONFIG.steps_per_iteration * 8


def test_metrics_are_those_of_all_processes(found):
    a, b = ([{k: v for k, v in m.items() if "Perf" not in k} for m in here["metrics"]] for here in found)
    assert a == b and "Loss/critic" in a[0]


def test_a_resumed_run_equals_an_unbroken_one_in_each_process(found):
    for here in found:
        assert same(here["whole"], here["parts"])
