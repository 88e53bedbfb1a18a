"""Variation spaces, the registry and what a class freezes."""

import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry, variation
from bidex_meta.tasks.variation import VariationSpace, join
from tests.tasks.wide import HIDDEN
from tests.tasks.worlds import each_case, each_version

TURN = np.deg2rad(15)


def around(prefix: str, *centre: float, half: float) -> dict[str, tuple[float, float]]:
    """Ends of components ``<prefix>_x``, ``_y``, ``_z`` about a centre."""
    return {f"{prefix}_{axis}": (c - half, c + half) for axis, c in zip("xyz", centre, strict=False)}


def placed(*names: str) -> dict[str, tuple[float, float]]:
    """What a task freezes of objects on a table (docs/figures.md, decisions): 3 cm along x and y, 15 degrees."""
    return {k: v for name in names for k, v in (*around(name, 0, 0, half=0.03).items(), (f"{name}_yaw", (-TURN, TURN)))}


def goal(name: str, *centres: tuple[float, float, float]) -> dict[str, tuple[float, float]]:
    """The original's goals (docs/figures.md, classes) give or take 3 cm, and the two draws of their one orientation."""
    names = [name] if len(centres) == 1 else [f"{name}{i}" for i in (1, 2)]
    positions = [around(prefix, *centre, half=0.03) for prefix, centre in zip(names, centres, strict=True)]
    return {k: v for ends in positions for k, v in ends.items()} | ORIENTATION


ORIENTATION = {"goal_u0": (-1.0, 1.0), "goal_u1": (-1.0, 1.0)}
OPENING = {"base_y": (-0.05, 0.05), "start_angle": (0.0, 0.15)}
CLOSING = {"base_y": (-0.05, 0.05), "start_angle": (1.3, 1.57)}
# class: components and their ends (docs/figures.md, decisions), metres and radians.
SPACES = {
    "HandOver": goal("goal", (0, -0.64, 0.54)),
    "CatchUnderarm": goal("goal", (0, -0.79, 0.54)),
    "CatchOver2Underarm": goal("goal", (0, -0.40, 0.55)),
    "TwoCatchUnderarm": goal("goal", (0, -0.79, 0.54), (0, -0.38, 0.54)),
    "CatchAbreast": goal("goal", (-0.39, -1.15, 0.54)),
    "LiftUnderarm": placed("object") | around("goal", 0, 0, half=0.05) | {"goal_height": (0.25, 0.45)},
    "DoorOpenOutward": OPENING,
    "DoorOpenInward": OPENING,
    "DoorCloseOutward": CLOSING,
    "DoorCloseInward": CLOSING,
    "BottleCap": placed("bottle") | {"bottle_y": (-0.01, 0.0)},  # the thumb is in the way of more
    "PushBlock": placed("block1", "block2"),
    "SwingCup": placed("cup") | {"yaw_change": (np.pi / 2, np.pi)},
    "OpenScissors": placed("scissors") | {"target_angle": (-0.15, 0.3)},
    "ReOrientation": ORIENTATION,
    "OpenPenCap": placed("pen"),
    "Switch": around("switch1", 0, 0, half=0.03) | around("switch2", 0, 0, half=0.03),
    "StackBlock": placed("block1", "block2") | around("target", 0, 0, half=0.03),
    "PourWater": placed("kettle", "bucket"),
    "GraspAndPlace": placed("bucket", "block"),
}


@each_version
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
def test_a_task_freezes_its_documented_ranges(name: str, moving: bool) -> None:
    space = registry.get(name, moving).variation_space
    found = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
    assert len(found) == space.size == len(SPACES[name]) > 0
    assert found.keys() == SPACES[name].keys()
    for component, ends in SPACES[name].items():
        assert found[component] == pytest.approx(ends, abs=1e-9), component


WIDER = {"PushBlock": 3, "GraspAndPlace": 3, "Switch": 3, "DoorCloseOutward": 3, "OpenScissors": 2, "OpenPenCap": 2}
WIDER |= dict.fromkeys(("DoorOpenOutward", "DoorOpenInward"), 1.6)


@each_case
def test_version_2_freezes_what_it_hides_and_draws_the_rest_in_every_episode(name: str, moving: bool) -> None:
    task = registry.get(f"{name}-v2", moving)
    assert set(task.variation_space.names) == HIDDEN[name]
    assert set(task.episode_space.names) == SPACES[name].keys() - HIDDEN[name]
    space = variation.join(task.variation_space, task.episode_space)
    found = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
    for component, (low, high) in SPACES[name].items():
        assert found[component][0] <= low and found[component][1] >= high, component
        if component not in {*HIDDEN[name], "start_angle"} and "goal" not in component:
            assert np.diff(found[component]) == pytest.approx(WIDER.get(name, 1) * (high - low)), component


@each_version
def test_what_is_frozen_is_one_row_a_task(name: str, moving: bool) -> None:
    """Each (n, k) in the variation's precision, and the rows of tasks independent of each other."""
    task = registry.get(name, moving)
    pool = torch.from_numpy(task.variation_space.sample(np.random.default_rng(1), 7))
    frozen, alone = task.frozen(pool), task.frozen(pool[2:3])
    assert frozen
    for label, value in frozen.items():
        assert value.ndim == 2 and len(value) == 7 and value.dtype == torch.float64, label
        np.testing.assert_array_equal(value[2].numpy(), alone[label][0].numpy(), err_msg=label)


def test_a_lopsided_space_is_refused() -> None:
    with pytest.raises(BidexError, match="one length"):
        VariationSpace(("a", "b"), (0.0,), (1.0, 1.0))


def test_an_inverted_component_and_a_name_twice_are_refused() -> None:
    with pytest.raises(BidexError, match=r"goal_x: expected its lower end before its upper end, got 0\.25 and 0\.1"):
        variation.component("goal_x", 0.25, 0.1)
    with pytest.raises(BidexError, match="each name once, got a, a"):
        join(variation.component("a", 0, 1), variation.component("a", 0, 2))
