"""A class of version 2 on the other engine, as points, for several agents, and recorded."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bidex_meta import make_task_world
from bidex_meta.data.checking import summary, verify
from bidex_meta.evaluation.references import references_of
from bidex_meta.tasks import registry
from bidex_meta.tasks.state import TaskState
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.part import judgement_of
from tests.data.test_commands import recorded
from tests.tasks.worlds import MOVING, engine_of, slot
from tests.world.play import suite_world


def test_points_hide_the_object_and_show_the_goal() -> None:
    state, points = (make_task_world("PushBlock-v2", 2, "cpu", threads=1, points=n) for n in (0, 32))
    layout, (seen, cloud) = state.slots[0].task_class.layout, [world.reset(seed=0)[0] for world in (state, points)]
    goal, block = layout.range("goal_pose"), layout.range("block1_pose")
    assert torch.equal(seen[:, goal], cloud[:, goal]) and cloud[:, layout.size :].any()
    assert seen[:, block].any() and not cloud[:, block].any()


def test_agents_see_the_goal_and_references_are_those_of_the_version() -> None:
    world = suite_world("MT4-v2", 4)
    sizes = [(len(view.columns), len(view.actions)) for view in agent_views(world.observation_groups, 52, "hands")]
    assert sizes == [(450 - 199, 26)] * 2
    found = references_of(world)
    printed = references_of(suite_world("MT4", 4))
    assert found.keys() == printed.keys() == set(world.task_names)
    for name in found:
        assert (found[name].expert, found[name].episode_steps) == (None, registry.get(f"{name}-v2").episode_steps)
        assert found[name].random != printed[name].random and printed[name].episode_steps is None


@pytest.mark.parametrize("of", [{"suite": "MT1-v2"}, {"task": "CatchUnderarm-v2"}, {"task": "CatchUnderarm"}])
def test_recorded_rewards_are_computed_again_by_the_right_formula(of: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    dataset, v2 = recorded(tmp_path, **of), "-v2" in str(of)
    found = verify(dataset)
    assert found.count == 0 and list(found.recomputed.values()) == [found.steps], found
    assert (dataset.metadata["rules"]["reward"] == "v2") == v2
    for slot_summary in summary(dataset):
        score = 100 * slot_summary.returns[2] / registry.get("CatchUnderarm-v2").episode_steps
        assert (slot_summary.score == pytest.approx(score)) == v2


def test_a_world_knows_what_its_observations_hide() -> None:
    classes = [slot(registry.get(name)) for name in ("PushBlock-v2", "BottleCap-v2")]
    shows, hides = (
        World(classes, WorldConfig(4, observation=rule, autoreset_mode="DISABLED", threads=1))
        for rule in ("plain", "masked")
    )
    action = torch.rand(4, 52, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for world in (shows, hides):
        world.reset(seed=0)
    (seen, *_), (masked, *_) = shows.step(action), hides.step(action)
    assert not torch.equal(seen, masked) and shows.hidden_size == 0
    torch.testing.assert_close(hides.with_goals(masked), seen, rtol=0, atol=1e-6)
    values = hides.hidden_values()
    assert values.shape == (4, 4) and values.abs().max() <= 1.0 and not values[2:, 1:].any() and values[:, 0].all()


def test_rewards_for_other_goals_are_those_of_a_world_that_has_them() -> None:
    classes = [slot(registry.get(name)) for name in ("PushBlock-v2", "BottleCap-v2")]
    one = World(classes, WorldConfig(4, observation="masked", autoreset_mode="DISABLED", threads=1))
    action = torch.rand(4, 52, generator=torch.Generator().manual_seed(0)) * 2 - 1
    one.reset(seed=0)
    mirrored = -one.hidden_values()
    masked, own, *_ = one.step(action)
    shown = one.with_goals(masked, torch.stack([one.hidden_values(), mirrored]))
    torch.testing.assert_close(shown[0], one.with_goals(masked), rtol=0, atol=1e-6)
    assert not torch.allclose(shown[0], shown[1], atol=1e-3)
    again, earned = one.rewards_if(torch.stack([one.hidden_values(), mirrored]))
    torch.testing.assert_close(again, own, rtol=0, atol=1e-5)
    assert torch.equal(one.rewards_if(mirrored), earned)
    pools = {}
    for each in one.slots:
        space, columns = each.task_class.variation_space, one.hidden_columns[each.name]
        pools[each.name] = each.tasks.copy()
        pools[each.name][:, columns] = np.add(space.low, space.high)[columns] - each.tasks[:, columns]
    one.set_tasks(pools)
    one.reset(seed=0)
    masked, paid, *_ = one.step(action)
    torch.testing.assert_close(paid, earned, rtol=0, atol=1e-5)
    torch.testing.assert_close(one.with_goals(masked), shown[1], rtol=0, atol=1e-5)
    assert not torch.allclose(earned, own)


@pytest.mark.parametrize("name", MOVING)
def test_no_start_tells_the_task_and_placements_enter_no_reward(name: str) -> None:
    """Equal seeds start alike whatever the tasks; and what an episode draws changes neither reward nor success."""
    task = registry.get(f"{name}-v2", True)
    masked = WorldConfig(6, observation="masked", autoreset_mode="DISABLED", threads=1)
    pools = [task.variation_space.sample(np.random.default_rng(seed), 6) for seed in (0, 1)]
    worlds = [World([slot(task, pool)], masked) for pool in pools]
    starts = [world.reset(seed=3)[0] for world in worlds]
    placements = [engine_of(world).placement() for world in worlds]
    assert torch.equal(*starts) and torch.equal(*placements)
    assert task.episode_space.size == 0 or len(placements[0].unique(dim=0)) == 6

    ((member, _, state),) = worlds[0].parts[0].states(worlds[0].task_index)
    draws = 2.0 * torch.rand(6, max(1, task.episode_space.size), generator=torch.Generator().manual_seed(0)) - 1.0
    drawn = task.frozen(torch.from_numpy(pools[0]), draws)
    other = TaskState(engine_of(worlds[0]).sensordata, member.scene.sensors, drawn)
    assert torch.equal(judgement_of(task, other).reward, judgement_of(task, state).reward)
    assert torch.equal(judgement_of(task, other).success, judgement_of(task, state).success)
