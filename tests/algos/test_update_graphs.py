"""MT-PPO's update as a recording, by a tape on the CPU, against plain updates; and how often it waits for a GPU."""

import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch

from bidex_algos import rollout
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta import Benchmark
from bidex_meta.utils import maths
from bidex_meta.world.graphs import GraphCache
from tests.world.play import suite_world
from tests.world.test_graphs import Tape
from tests.world.test_masked import masked, no_looks

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


__all__ = ["masked"]
OPTIONS = {
    "ppo": {}, "pcgrad": {"gradient_surgery": "pcgrad", "policy_heads": True},
    "cagrad": {"gradient_surgery": "cagrad", "architecture": "paco"},
    "famo": {"gradient_surgery": "famo", "architecture": "moore"},
    "soft_modules": {"architecture": "soft_modules", "hidden": (16, 16)},
}  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_collecting_and_learning_look_at_no_number(masked, monkeypatch: pytest.MonkeyPatch, options: dict[str, object]):
    monkeypatch.setattr(maths, "may_look", lambda device: False)
    learner = MTPPO(suite_world("MT4", 8), replace(CONFIG, **options), seed=0)
    learner.iterate()  # constants are brought to the device once
    obs = learner.obs
    assert obs is not None
    with no_looks(monkeypatch):
        rollout.collect_rollout(
            learner.world, learner.rollout, obs, learner._sample, learner._final_value, learner.episodes
        )
        learner._update(learner._prepare()[0])
        learner.policy.observations.update(learner.rollout.obs)


@pytest.mark.gpu
def test_an_iteration_waits_no_more_often_with_four_times_the_steps():
    waits = []
    for steps in (4, 16):
        world = Benchmark("MT4").make_world("train", num_envs=64, device="cuda:0", seed=0)
        learner = MTPPO(world, replace(CONFIG, rollout_steps=steps), seed=0)
        for _ in range(3):
            learner.iterate()
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                learner.iterate()
            finally:
                torch.cuda.set_sync_debug_mode("default")
        waits.append(sum("synchronizing" in str(w.message) for w in found))
    assert waits[1] <= waits[0] <= 4, waits
