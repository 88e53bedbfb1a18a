"""The mask: goals are shown in multi-task worlds and hidden in meta ones (docs/figures.md, decisions)."""

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world import World
from tests.tasks.formulas import FORMULAS
from tests.tasks.wide import HIDDEN
from tests.tasks.worlds import each_version, engine_of, mixed_world, world_of
from tools.gallery import masked

RULES = ["plain", "one-hot", "masked"]


# class: components that are a fixture's place. Equal states imply equal ones, so no two rows can differ in them alone.
FIXTURES = {name: {"base_y"} for name in FORMULAS if name.startswith("Door")} | {
    "Switch": {"switch1_x", "switch1_y", "switch2_x", "switch2_y"}
}


def variants(name: str, moving: bool) -> tuple[list[str], np.ndarray]:
    """A task, and for each of its components but fixtures' places one that differs in this alone."""
    space = registry.get(name, moving).variation_space
    low, high = np.array(space.low), np.array(space.high)
    base = low + 0.2 * (high - low)
    chosen = [label for label in space.names if label not in FIXTURES.get(name.removesuffix("-v2"), ())]
    changed = [base + 0.35 * (high - low) * (np.array(space.names) == label) for label in chosen]
    return chosen, np.stack([base, *changed])


def twins(name: str, moving: bool, rule: str) -> tuple[list[str], Tensor, Tensor]:
    """The components, and observations and rewards of rows in one state, each with another task, after a step."""
    changed, tasks = variants(name, moving)
    world = world_of(name, moving, len(tasks), tasks=tasks, observation=rule)
    world.reset(seed=3)
    assert world.task_index.tolist() == list(range(len(tasks)))
    engine = engine_of(world)
    engine.reset(torch.ones(len(tasks), dtype=torch.bool), engine.placement()[:1].repeat(len(tasks), 1))
    action = torch.rand(1, world.action_size, generator=torch.Generator().manual_seed(6)) * 2 - 1
    obs, reward, *_ = world.step(action.repeat(len(tasks), 1))
    assert (engine.placement() == engine.placement()[0]).all(), "rows of one state stay in one state"
    return changed, obs, reward


def entering(name: str) -> tuple[set[str], set[str]]:
    """The components that enter the reward of a given state, and its success alone; no places of fixtures."""
    plain = name.removesuffix("-v2")
    task, oracle = registry.get(name, True), FORMULAS[plain]
    of_reward = set(task.variation_space.names) if oracle.entering is None else oracle.entering
    names = set(task.variation_space.names)
    return (HIDDEN[plain] if plain != name else of_reward) - FIXTURES.get(plain, set()), names & set(oracle.deciding)


@each_version
@pytest.mark.parametrize("rule", RULES)
def test_tasks_are_told_apart_exactly_where_they_should_be(name: str, moving: bool, rule: str) -> None:
    changed, obs, reward = twins(name, moving, rule)
    of_reward, of_success = entering(name)
    enters = np.isin(changed, list(of_reward))
    np.testing.assert_array_equal((reward[1:] != reward[0]).numpy(), enters, err_msg=str(changed))
    differs = (obs[1:] != obs[0]).any(dim=1).numpy()
    enters |= np.isin(changed, list(of_success))
    if rule == "masked":
        assert not differs.any(), np.array(changed)[differs]
    else:
        assert differs[enters].all(), np.array(changed)[enters & ~differs]


def test_shears_show_the_angle_that_is_missing() -> None:
    """Two tasks whose opened handle, the shears at their nominal places, lies alike: the angle must tell them apart."""
    tasks = np.array([[0.00147, -0.01415, -0.15, 0.30], [-0.00147, 0.01415, 0.26, -0.11]])
    world = world_of("OpenScissors", True, 2, tasks=tasks, observation="plain")
    world.reset(seed=3)
    engine = engine_of(world)
    engine.reset(torch.ones(2, dtype=torch.bool), engine.placement()[:1].repeat(2, 1))
    obs, reward, *_ = world.step(torch.zeros(2, world.action_size))
    assert reward[0] != reward[1] and (obs[0] - obs[1]).abs().max() > 0.05


def played(world: World) -> list[Tensor]:
    """Observations of a short run, its resets included."""
    generator = torch.Generator().manual_seed(9)
    obs, _ = world.reset(seed=4)
    found = [obs]
    for _ in range(5):
        action = torch.rand(world.num_envs, world.action_size, generator=generator) * 2 - 1
        obs, *_, info = world.step(action)
        found += [obs, info["final_obs"]]
    obs, _ = world.reset(options={"reset_mask": torch.arange(world.num_envs) % 2 == 0})
    return [*found, obs]


@each_version
def test_the_mask_zeroes_the_goal_and_nothing_else(name: str, moving: bool) -> None:
    goal = registry.get(name, moving).layout.goal_indices()
    plain, masked = (played(world_of(name, moving, 4, observation=rule)) for rule in ("plain", "masked"))
    for seen, zeroed in zip(plain, masked, strict=True):
        assert not goal or seen[:, goal].any(dim=1).all()
        wanted = seen.clone()
        wanted[:, goal] = 0.0
        assert torch.equal(zeroed, wanted)


def test_the_mask_in_a_mixed_world() -> None:
    """Goal entries by each class's own layout, padding behind it, and the task id only where it is asked for."""
    plain, masked, told = (
        played(mixed_world(2, observation=rule, pad_to=450)) for rule in ("plain", "masked", "one-hot")
    )
    world = mixed_world(2)
    for seen, zeroed, named in zip(plain, masked, told, strict=True):
        assert torch.equal(named[:, :450], seen)
        assert torch.equal(named[:, 450:], torch.eye(world.num_tasks).repeat_interleave(2, dim=0))
        for slot, rows in zip(world.slots, world.slot_env_ids, strict=True):
            layout = slot.task_class.layout
            wanted = seen[rows].clone()
            wanted[:, layout.goal_indices()] = 0.0
            assert torch.equal(zeroed[rows], wanted)
            assert (seen[rows, layout.size :] == 0).all()
            goal = layout.goal_indices()
            assert not goal or (seen[rows][:, goal] != 0).any(dim=1).all()


OPEN = {name for name in FORMULAS if name.startswith("Door")} | set(
    ("BottleCap", "PushBlock", "OpenPenCap", "Switch", "PourWater", "GraspAndPlace")
)
"""The ten classes whose tasks are told apart by nothing that reward or success depends on, or by a fixture's place."""


@pytest.mark.parametrize("name", [*registry.names(), *(f"{name}-v2" for name in registry.names())])
def test_what_the_mask_hides_is_what_the_formulas_use(name: str) -> None:
    task = registry.get(name, True)
    reward, success = masked(task)
    assert (set(reward), set(success)) == entering(name)
    assert (not reward and not success) == (name in OPEN)
    told = {component for part in task.hides() for component in part.names}
    assert told == HIDDEN[name.removesuffix("-v2")] & set(task.variation_space.names)
