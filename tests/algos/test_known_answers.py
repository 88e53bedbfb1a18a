"""On-policy learners on problems whose optimum is known: LQR, a point mass, tasks of a one-hot, one to remember."""

from dataclasses import replace
from typing import Any

import pytest

from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from tests.algos.families import Recall
from tests.algos.problems import (
    LQR,
    OFF_POLICY,
    is_near_the_optimum,
    opposite_bandits,
    trained,
)

GAMMA = 0.8
SHARED: dict[str, Any] = {"hidden": (32, 32), "rollout_steps": 16, "gamma": GAMMA, "init_std": 0.5, "autocast": "off"}
PPO = MTPPOConfig(**SHARED, learning_rate=3e-3, learning_rate_range=(1e-4, 5e-3), critic_learning_rate=3e-3)
TRPO = MTTRPOConfig(**SHARED, fisher_stride=1, max_kl=0.03, damping=0.01, critic_learning_rate=3e-3)
both = pytest.mark.parametrize(("learner_type", "config"), [(MTPPO, PPO), (MTTRPO, TRPO)], ids=["ppo", "trpo"])


def mean_actions(learner: Any) -> list[float]:
    obs, _ = learner.world.reset(seed=1)
    action = learner.eval_action(obs)
    return [float(action[learner.world.task_id == k].mean()) for k in range(learner.world.num_tasks)]


@both
def test_lqr_comes_close_to_the_riccati_optimum(learner_type: Any, config: Any):
    learner = trained(learner_type, LQR(rows=64), config, 20)
    assert is_near_the_optimum(learner.eval_action, GAMMA, 1.15)


PAID_ALIKE = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate=1e-3, learning_rate_range=(1e-4, 4e-3), std_range=(0.05, 1.0),
    autocast="off",
)  # fmt: skip
SAC = MTSACConfig(**OFF_POLICY, init_alpha=0.01)
TRUNKS = ("soft_modules", "paco", "moore", "towers", "transformer")
WAYS: list[tuple[Any, Any, dict[str, Any], int, float]] = [
    (MTPPO, PAID_ALIKE, {"value_heads": False}, 40, 1000.0),
    (MTPPO, PAID_ALIKE, {"policy_heads": True}, 40, 1000.0),
    *((MTPPO, PAID_ALIKE, {"gradient_surgery": way}, 40, 1000.0) for way in ("pcgrad", "cagrad", "famo")),
    *((MTPPO, PAID_ALIKE, {"architecture": name}, 40, 1.0) for name in TRUNKS),
    (MTSAC, SAC, {"architecture": "soft_modules"}, 12, 1.0),
    *((MTTRPO, TRPO, {"policy_heads": heads}, 30, 1000.0) for heads in (False, True)),
]  # fmt: skip


@pytest.mark.parametrize(("learner_type", "config", "options", "iterations", "scale"), WAYS)
def test_two_tasks_that_only_the_one_hot_tells_apart(
    learner_type: Any, config: Any, options: dict[str, Any], iterations: int, scale: float
):
    learner = trained(learner_type, opposite_bandits(0.5, scale), replace(config, **options), iterations)
    assert mean_actions(learner) == pytest.approx([0.5, -0.5], abs=0.2)


REMEMBERING = RL2Config(
    hidden=(16,), activation="tanh", memory=16, init_std=0.6, episodes_per_trial=1, max_adapt_steps=60, gamma=0.9,
    blind_share=0.0, num_minibatches=2, learning_rate=2e-3, learning_rate_range=(3e-4, 1e-2), critic_learning_rate=3e-3,
)  # fmt: skip


def test_what_the_first_of_60_steps_shows_is_used_in_the_last():
    learner = RL2(Recall(steps=60), REMEMBERING, seed=0)
    success = [learner.iterate()["Train/success_last_episode"] for _ in range(20)][-1]
    assert success > 0.9  # seeds 0 to 3: 0.97, 0.94, 0.97, 0.97; by chunks of 25 steps 0.44, 0.48, 0.56, 0.47
