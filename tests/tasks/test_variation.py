"""Variation spaces, the registry and what a class freezes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.variation import VariationSpace, box, join, orientation
from tests.tasks.formulas import goals
from tests.tasks.worlds import each_case

# class: centre of each goal (sheet 4.1 to 4.5, world, metres), +-3 cm by design.md section 4.
GOALS = {
    "HandOver": [(0, -0.64, 0.54)],
    "CatchUnderarm": [(0, -0.79, 0.54)],
    "CatchOver2Underarm": [(0, -0.40, 0.55)],
    "TwoCatchUnderarm": [(0, -0.79, 0.54), (0, -0.38, 0.54)],
    "CatchAbreast": [(-0.39, -1.15, 0.54)],
}


@each_case
def test_samples_lie_inside_and_fill_the_box(name: str, moving: bool) -> None:
    space = registry.get(name, moving).variation_space
    samples = space.sample(np.random.default_rng(0), 500)
    assert samples.shape == (500, space.size) and samples.dtype == np.float64
    assert all(space.contains(sample) for sample in samples)
    low, high = np.array(space.low), np.array(space.high)
    assert (samples.min(axis=0) < low + 0.05 * (high - low)).all()
    assert (samples.max(axis=0) > high - 0.05 * (high - low)).all()
    for i in range(space.size):
        outside = samples[0].copy()
        outside[i] = high[i] + 1e-6
        assert not space.contains(outside)
    assert not space.contains(samples[0][:-1])
    np.testing.assert_array_equal(samples, space.sample(np.random.default_rng(0), 500))


@each_case
def test_goals_vary_about_the_sheets_place(name: str, moving: bool) -> None:
    space = registry.get(name, moving).variation_space
    assert len(set(space.names)) == space.size
    prefixes = ["goal"] if len(GOALS[name]) == 1 else ["goal1", "goal2"]
    for prefix, centre in zip(prefixes, GOALS[name], strict=True):
        for axis, middle in zip("xyz", centre, strict=True):
            i = space.names.index(f"{prefix}_{axis}")
            assert (space.low[i], space.high[i]) == pytest.approx((middle - 0.03, middle + 0.03))
    draws = [i for i, label in enumerate(space.names) if label in ("goal_u0", "goal_u1")]
    assert [(space.low[i], space.high[i]) for i in draws] == [(-1.0, 1.0)] * 2
    assert space.size == 3 * len(GOALS[name]) + 2


@each_case
def test_what_a_task_freezes(name: str, moving: bool) -> None:
    task = registry.get(name, moving)
    pool = task.variation_space.sample(np.random.default_rng(1), 7)
    frozen = task.freeze(torch.from_numpy(pool))
    assert all(len(value) == 7 for value in frozen.values())
    for row in range(7):
        for goal, (position, turn) in goals(name, pool[row]).items():
            np.testing.assert_allclose(frozen[goal][row].numpy(), (*position, *turn), atol=1e-7)
            inverse = Rotation.from_quat(frozen[f"{goal}_inverse"][row].numpy())
            np.testing.assert_allclose((inverse * Rotation.from_quat(turn)).magnitude(), 0.0, atol=1e-6)
    ghosts = task.ghosts(frozen)
    assert [tuple(pose.shape) for pose, _ in ghosts] == [(7, 7)] * len(GOALS[name])


def test_joined_spaces_keep_their_order() -> None:
    space = join(box("goal", (1.0, 2.0, 3.0), 0.5), orientation("goal"))
    assert space.names == ("goal_x", "goal_y", "goal_z", "goal_u0", "goal_u1")
    assert (space.low, space.high) == ((0.5, 1.5, 2.5, -1.0, -1.0), (1.5, 2.5, 3.5, 1.0, 1.0))
    assert space.contains(np.array(space.low)) and space.contains(np.array(space.high))


def test_a_lopsided_space_is_refused() -> None:
    with pytest.raises(ValueError, match="one length"):
        VariationSpace(("a", "b"), (0.0,), (1.0, 1.0))


@given(st.integers(1, 6), st.integers(0, 20), st.integers(0, 2**32 - 1))
def test_any_box_holds_its_samples(size: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.normal(size=size)
    high = low + rng.uniform(0.0, 2.0, size=size)
    space = VariationSpace(tuple(f"x{i}" for i in range(size)), tuple(low), tuple(high))
    samples = space.sample(rng, count)
    assert samples.shape == (count, size) and all(space.contains(sample) for sample in samples)


@pytest.mark.parametrize("name", registry.names())
def test_registry_gives_each_class_with_both_bases(name: str) -> None:
    task = registry.get(name)
    assert isinstance(task, TaskClass) and task.name == name and task.summary and type(task).__doc__
    assert task.moving_base == (name != "HandOver")
    for moving in (True, False):
        chosen = registry.get(name, moving)
        assert (chosen.moving_base, chosen.action_size) == (moving, 52 if moving else 40)
        assert ("moving" if moving else "fixed") in repr(chosen) and name in repr(chosen)


@pytest.mark.parametrize(
    "typo, near", [("CatchUnderam", "CatchUnderarm"), ("handover", "HandOver"), ("TwoCatch", "TwoCatch")]
)
def test_an_unknown_class_is_answered_with_the_nearest(typo: str, near: str) -> None:
    with pytest.raises(BidexError) as caught:
        registry.get(typo)
    text = str(caught.value)
    assert "\n" not in text and typo in text and near in text.split("Known:")[0]
    assert all(name in text.split("Known:")[1] for name in registry.names())


def test_an_unknown_class_that_is_near_to_none_still_lists_them() -> None:
    with pytest.raises(BidexError, match="Known: CatchAbreast"):
        registry.get("qqqqqq")
