"""Collecting in the way of an accelerator: a whole trial, or a step of FlashSAC, looks at no number."""

from typing import Any

import pytest
import torch
from torch import Tensor

from bidex_algos.meta.icl import ICL, ICLConfig, _Pupil
from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_algos.meta.trials import Sampling
from bidex_algos.meta.varibad import VariBAD, VariBADConfig
from bidex_algos.offpolicy.flashsac import FlashSAC, FlashSACConfig
from bidex_meta.training.learner import Sources
from bidex_meta.utils import maths
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.world.play import suite_world
from tests.world.test_masked import masked, no_looks

__all__ = ["masked"]
SMALL = {"hidden": (8,), "memory": 8, "episodes_per_trial": 2, "max_adapt_steps": 3, "num_minibatches": 2}


class Still:
    """A teacher that moves nothing."""

    def eval_action(self, obs: Tensor) -> Tensor:
        return torch.zeros(len(obs), 52)

    def reset(self, env_mask: Tensor) -> None:
        pass


def learner_of(name: str) -> Any:
    if name == "flashsac":
        return FlashSAC(suite_world("MT1-v2", 4), FlashSACConfig(batch_size=8, warmup_steps=2, replay_steps=20), seed=0)
    world = suite_world("ML1-v2", 50, "DISABLED")  # one of each task: with fewer, each trial brings other tasks
    if name == "rl2":
        return RL2(world, RL2Config(**SMALL), seed=0)  # type: ignore[arg-type]
    if name == "varibad":
        return VariBAD(world, VariBADConfig(**SMALL), seed=0)  # type: ignore[arg-type]
    config = ICLConfig(hidden=(8,), head=(8,), candidates=4, max_adapt_steps=3, updates_per_iteration=1, batch_size=8)
    teachers = Teachers(world, [Tutor(Still(), torch.arange(50), 52)], privileged=world)
    return ICL(world, config, 0, Sources(teachers=teachers))


@pytest.mark.parametrize("name", ["rl2", "varibad", "icl", "flashsac"])
def test_collecting_looks_at_no_number(name: str, masked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maths, "may_look", lambda device: False)
    learner = learner_of(name)
    learner.iterate()  # constants are brought to the device once
    with no_looks(monkeypatch):
        if name == "flashsac":
            learner._step()
        elif name == "icl":
            learner._play(learner.data.trials, _Pupil(learner, learner.data))
        else:
            learner._play(learner.trials, Sampling(learner.policy, learner.generator), 0.5)
