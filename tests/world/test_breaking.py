"""A broken row is told, goes on from a safe state at a normal price, and its neighbours do not change by a bit."""

from collections.abc import Callable

import mujoco
import pytest
import torch

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.tasks import registry
from bidex_meta.world import World
from tests.tasks.worlds import engine_of
from tests.world.breaking import ROW, WITHIN, ways
from tests.world.play import class_world, random_actions

ROWS = 3
MOST_CONTACTS = 100
"""PourWater's balls have 43 at the reference pose; with NaN all pairs touch, 600 and more in each class."""
each_class = pytest.mark.parametrize("name", registry.names())


def stepped(world: World, state: list[dict[str, torch.Tensor]], spoil: Callable[[CpuEngine], None]) -> CpuEngine:
    """The engine after a control step from a state, with a row spoilt before it."""
    part, engine = world.parts[0], engine_of(world)
    engine.load_state_dict(state[0])
    part.control(0.5 * torch.ones(ROWS, world.action_size))
    spoil(engine)
    engine.step(part.substeps)
    return engine


def ready(name: str) -> tuple[World, list[dict[str, torch.Tensor]]]:
    world = class_world(name, ROWS, "DISABLED")
    world.reset(seed=0)
    for action in random_actions(world, 5):
        world.step(action)
    return world, [engine_of(world).state_dict()]


def whole(engine: CpuEngine) -> torch.Tensor:
    return torch.cat((engine._numbers, engine.sensordata), dim=1).clone()


@each_class
def test_a_row_broken_by_hand_steps_from_the_reference_pose(name: str) -> None:
    """So its step costs what a step from there costs, however it was broken."""
    world, state = ready(name)
    reference = torch.arange(ROWS) == ROW

    def make_safe(engine: CpuEngine) -> None:
        engine.batch.reset(ids=reference.numpy(), stage=mujoco.mjtStage.mjSTAGE_NONE)

    safe = stepped(world, state, make_safe)
    assert not safe.unstable().any()
    expected, normal = whole(safe), whole(stepped(world, state, lambda engine: None))
    assert torch.equal(expected[~reference], normal[~reference]) and not torch.equal(expected, normal)
    assert safe.batch.get_data(ROW).ncon < MOST_CONTACTS, "from where a step is cheap"
    for kind, spoil in ways(safe).items():
        engine = stepped(world, state, spoil)
        assert torch.equal(engine.unstable(), reference), kind
        assert torch.equal(whole(engine), expected), kind


@each_class
def test_a_row_that_breaks_within_the_step_does_not_drag_on(name: str) -> None:
    world, state = ready(name)
    normal, broke = whole(stepped(world, state, lambda engine: None)), 0
    for kind, spoil in WITHIN.items():
        engine = stepped(world, state, spoil)
        assert torch.equal(whole(engine)[ROW + 1 :], normal[ROW + 1 :]), kind
        assert not engine.unstable()[ROW + 1 :].any(), kind
        if engine.unstable()[ROW]:
            broke += 1
            assert engine._numbers[ROW].isfinite().all(), kind
            assert engine.batch.get_data(ROW).ncon < MOST_CONTACTS, kind
    assert broke, "nothing of it broke the row"
