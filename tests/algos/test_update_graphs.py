"""MT-PPO's update as a recording, by a tape on the CPU, against plain updates."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.world.graphs import GraphCache
from tests.world.play import suite_world
from tests.world.test_graphs import Tape

CONFIG = MTPPOConfig(hidden=(16,), rollout_steps=5, num_minibatches=3, epochs=2, autocast="off")


def taped(learner: MTPPO, count: list[str]) -> GraphCache:
    """Recordings as CUDA makes them: the work is written down and not done."""

    def record(work: Any) -> Any:
        adam = learner.adams
        places = [*adam.weights, *adam.critic_weights, adam.rate]
        places += [value for one in (adam.actor, adam.critic) for kept in one.state.values() for value in kept.values()]
        before = [place.detach().clone() for place in places]
        with Tape() as tape:
            result = work()
        with torch.no_grad():
            for place, value in zip(places, before, strict=True):
                place.copy_(value)
        count.append("recorded")

        def replay() -> None:
            with torch.no_grad():
                tape.replay()

        return replay, result

    return GraphCache(dict, lambda _: None, record)


@pytest.mark.parametrize("options", [{}, {"critic_first": 100}], ids=["plain", "critic-first"])
def test_replayed_updates_are_plain_updates(options: dict[str, Any]) -> None:
    plain, recorded = (MTPPO(suite_world("MT4", 8), replace(CONFIG, **options), seed=0) for _ in range(2))
    count: list[str] = []
    recorded._graphs = taped(recorded, count)
    for _ in range(6):
        a, b = plain.iterate(), recorded.iterate()
        assert {k: v for k, v in a.items() if "Perf" not in k} == {k: v for k, v in b.items() if "Perf" not in k}
    for x, y in zip(plain.policy.parameters(), recorded.policy.parameters(), strict=True):
        assert torch.equal(x, y)
    assert len(count) >= 3  # the first mini-batch has no KL to follow, the last one of an epoch fewer samples


def test_a_loaded_state_is_recorded_anew() -> None:
    learner = MTPPO(suite_world("MT4", 8), CONFIG, seed=0)
    count: list[str] = []
    learner._graphs = taped(learner, count)
    for _ in range(4):
        learner.iterate()
    state = learner.state_dict()
    made = len(count)
    learner.load_state_dict(state)
    for _ in range(4):
        learner.iterate()
    assert len(count) == 2 * made
