"""How often a learner's loop makes the host wait for an accelerator: for the metrics, and never within a step."""

import warnings
from dataclasses import replace

import pytest
import torch

from bidex_algos import rollout
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta import Benchmark
from bidex_meta.utils import maths
from tests.world.play import suite_world
from tests.world.test_masked import masked, no_looks

__all__ = ["masked"]
CONFIG = MTPPOConfig(hidden=(16,), rollout_steps=4, num_minibatches=2, epochs=2, autocast="off")


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
        rollout.collect(learner.world, learner.rollout, obs, learner._sample, learner._final_value, learner.episodes)
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
