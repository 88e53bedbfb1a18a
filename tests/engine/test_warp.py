"""The Warp engine on the Warp CPU device, its graphs captured: parity with C MuJoCo, resets, health, state.

Uniform actions drive fingers into objects and objects into each other. From the first contact on two correct engines
drift apart (a difference of 1e-7 grows a thousandfold within forty steps), so single worst entries tell nothing: the
bars hold for the 95th percentile over rows, steps and entries, and a second rollout that starts every step from the
state of C holds tighter ones.
"""

import copy

import mujoco
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.engine.warp import WarpEngine
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import Scene, compile_scene
from tests.engine.parity import GROUPS, Pair, actions, pair, rollout

ALWAYS = ("CatchUnderarm", "BottleCap")
"""Their groups are compared in every test run: free bodies and an ellipsoid; joints, cylinders and boxes."""
FREE = {"position": 1e-3, "quaternion": 1e-3, "velocity": 1e-2, "reward": 1e-2}
"""95th percentile of a free rollout: m and rad, one, 0.2 m/s or rad/s, relative above 1."""
FIRST_FORCE = 1e-3
"""The same of forces and torques after one step, relative above 1 N or N m."""
RESYNCHRONISED = {"position": 1e-5, "quaternion": 1e-5, "velocity": 1e-4, "reward": 1e-4, "force": 1e-4}
"""95th percentile where every step starts from the state of C."""
SUBSTEPS, ROWS = 4, 4

each_group = pytest.mark.parametrize(
    "names",
    [
        pytest.param(names, id=names[0], marks=[] if set(names) & set(ALWAYS) else [pytest.mark.parity])
        for names in GROUPS
    ],
)


@pytest.fixture(scope="module")
def pairs() -> dict[tuple[str, ...], Pair]:
    return {}


def percentile(values: Tensor) -> float:
    return float(values.flatten().quantile(0.95))


@each_group
def test_a_rollout_is_that_of_c(names: tuple[str, ...]) -> None:
    both = pair(names)
    apart = rollout(both, resynchronised=False)
    found = {kind: percentile(apart[kind]) for kind in FREE} | {"first force": percentile(apart["force"][0])}
    bars = FREE | {"first force": FIRST_FORCE}
    assert {k: v for k, v in found.items() if v > bars[k]} == {}
    assert not both.warp.unstable().any() and not both.c.unstable().any()
    both.restart()
    apart = rollout(both, resynchronised=True)
    found = {kind: percentile(apart[kind]) for kind in RESYNCHRONISED}
    assert {k: v for k, v in found.items() if v > RESYNCHRONISED[k]} == {}
