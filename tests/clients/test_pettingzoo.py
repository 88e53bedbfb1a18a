"""PettingZoo's own tests of our parallel environment, and its episodes beside the single agent's."""

import warnings

import numpy as np
import pytest

from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.errors import BidexError

pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test, parallel_seed_test

from bidex_meta.clients.pettingzoo import parallel_env


@pytest.mark.parametrize("agents", ["hands", "fingers"])
def test_pettingzoos_own_tests(agents: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(parallel_env("CatchUnderarm", agents), num_cycles=100)
    parallel_seed_test(lambda: parallel_env("CatchUnderarm", agents), num_cycles=50)


def test_agents_together_are_the_single_agent() -> None:
    alone, env = TaskEnv("HandOver"), parallel_env("HandOver", "fingers", render_mode="rgb_array")
    whole, _ = alone.reset(seed=3)
    seen, _ = env.reset(seed=3)
    assert len(env.agents) == 12 and {obs.shape for obs in seen.values()} == {(211,)}
    draw = np.random.default_rng(0)
    for _ in range(100):
        np.testing.assert_array_equal(env.state(), whole)
        np.testing.assert_array_equal(seen["left/thumb"], whole[187:])
        joint = draw.uniform(-1.0, 1.0, alone.action_space.shape).astype(np.float32)
        palms = {"right/palm": joint[:2], "left/palm": joint[20:22]}
        fingers, at = {}, 0
        for name, size in (("first", 3), ("middle", 3), ("ring", 3), ("little", 4), ("thumb", 5)):
            fingers |= {f"right/{name}": joint[2 + at :][:size], f"left/{name}": joint[22 + at :][:size]}
            at += size
        seen, reward, terminated, truncated, info = env.step(palms | fingers)
        whole, *expected = alone.step(joint)
        assert [reward["left/palm"], terminated["right/palm"], truncated["right/thumb"]] == expected[:3]
        assert info["left/ring"]["success"] == expected[3]["success"]
        if not env.agents:
            break
    assert not env.agents and env.step({}) == ({}, {}, {}, {}, {})
    picture = env.render()
    assert picture is not None and picture.ndim == 3
    env.reset()
    with pytest.raises(BidexError, match=r"Expected an action of shape \(.,\) of agent right/.*, got nothing"):
        env.step({})
    env.close()
