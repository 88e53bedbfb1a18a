"""Partitions of the hands: each agent's columns and actions, in every class and suite."""

import random
from pathlib import Path

import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.hands.units import UNITS, partition_line
from bidex_meta.tasks import registry
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.contract import plain_groups
from bidex_meta.world.observations import observation_groups
from tests.world.play import suite_world

ALL = [f"{side}/{unit}" for side in ("right", "left") for unit in UNITS]


def views_of(name: str, agents, moving: bool | None = None):
    layout = registry.get(name, moving).layout
    return agent_views(observation_groups([layout], layout.size, 0), actions_of(name, moving), agents)


def actions_of(name: str, moving: bool | None = None) -> int:
    return 52 if registry.get(name, moving).moving_base else 40


def random_partition(seed: int) -> dict[str, list[str]]:
    draw = random.Random(seed)
    units = draw.sample(ALL, len(ALL))
    count = draw.randint(1, 8)
    parts = [units[i::count] for i in range(count)]
    return {f"agent{i}": part for i, part in enumerate(parts)}


@pytest.mark.parametrize("name", registry.names())
def test_each_action_is_of_one_agent(name: str) -> None:
    for agents in ("single", "hands", "fingers", *map(random_partition, range(10))):
        actions = [action for view in views_of(name, agents) for action in view.actions]
        assert sorted(actions) == list(range(actions_of(name)))
    shuffled = {agent: units[::-1] for agent, units in random_partition(3).items()}
    assert views_of(name, shuffled) == views_of(name, random_partition(3))


@pytest.mark.parametrize("name", registry.names())
def test_an_agent_of_one_hand_sees_nothing_of_the_other(name: str) -> None:
    layout = registry.get(name).layout
    obs = torch.rand(2, layout.size)
    right, left = views_of(name, "hands")
    hands = {"right": set(right.columns), "left": set(left.columns)}
    for block, where in layout:
        entries = set(range(where.start, where.stop))
        sides = {side for side in hands if any(s.startswith(f"{side}/") for s in block.sensors)}
        own = {side for side in hands if block.name in (f"{side}_action", f"{side}_base_rotation")} | sides
        for side, seen in hands.items():
            assert (entries <= seen) if side in own or not own else not entries & seen, block.name
    changed = obs.clone()
    changed[:, sorted(hands["left"] - hands["right"])] += 1.0
    assert torch.equal(obs[:, list(right.columns)], changed[:, list(right.columns)])
    assert not torch.equal(obs[:, list(left.columns)], changed[:, list(left.columns)])


def test_sizes_are_the_appendixs() -> None:
    def sizes(*arguments) -> list[tuple[int, int]]:
        return [(len(view.columns), len(view.actions)) for view in views_of(*arguments)]

    assert sizes("CatchUnderarm", "hands") == [(223, 26)] * 2
    assert sizes("HandOver", "hands", False) == [(211, 20)] * 2
    assert sizes("CatchUnderarm", "single") == [(422, 52)]
    assert sizes("CatchUnderarm", "fingers") == [(223, n) for n in (8, 3, 3, 3, 4, 5)] * 2
    assert [n for _, n in sizes("HandOver", "fingers", False)] == [2, 3, 3, 3, 4, 5] * 2
    across = {"palms": ["left/palm", "right/palm"], "rest": [unit for unit in ALL if "palm" not in unit]}
    assert sizes("CatchUnderarm", across) == [(422, 16), (422, 36)]


def test_in_suites_agents_see_the_task_id() -> None:
    world = suite_world("MT4", 4)
    obs, _ = world.reset(seed=0)
    for view in agent_views(world.observation_groups, 52, "hands"):
        assert len(view.columns) == 450 - 199
        own = {group.name: group.where for group in view.own_groups()}
        assert torch.equal(obs[:, list(view.columns)][:, own["task_id"][0]], torch.eye(4))
        seen = torch.cat([obs[:, list(view.columns)][:, part] for part in own[f"{view.name}_hand"]], 1)
        whole = next(group for group in world.observation_groups if group.name == f"{view.name}_hand")
        assert torch.equal(seen, obs[:, whole.where[0]])


def test_a_file_a_line_and_a_dict_are_the_same(tmp_path: Path) -> None:
    units = {
        "thrower": ["right/palm", "right/thumb"],
        "rest": [u for u in ALL if u not in ("right/palm", "right/thumb")],
    }
    file = tmp_path / "team.toml"
    file.write_text("[agents]\n" + "\n".join(f"{name} = {own!r}" for name, own in units.items()))
    line = partition_line(file)
    assert line == partition_line(str(file)) == partition_line(units) == partition_line(line)
    assert line.startswith("thrower=right/palm+right/thumb;rest=")
    assert views_of("CatchUnderarm", file) == views_of("CatchUnderarm", units)


@pytest.mark.parametrize(
    ("agents", "message"),
    [({"a": ALL, "b": ["left/palm"]}, "left/palm belongs to a and to b"),
     ({"a": [*ALL, "left/palm"]}, "left/palm belongs to a and to a"),
     ({"a": ALL[:-1]}, "left/thumb belongs to no agent"),
     ({"a": [*ALL[:-1], "left/thum"]}, "Did you mean 'left/thumb'"), ({}, "agents: expected"),
     ({"a": "right/palm"}, "agents.*expected a list"), ("hand", "expected single, hands, fingers"),
     ("a=right/palm;a=left/palm", "a twice"), ("none.toml", "none.toml")]
)  # fmt: skip
def test_bad_partitions_are_one_line(agents, message: str) -> None:
    with pytest.raises(BidexError, match=message) as error:
        views_of("CatchUnderarm", agents)
    assert "\n" not in str(error.value)


def test_a_world_without_hands_has_a_unit_for_each_action() -> None:
    groups = plain_groups(5, 2)
    views = agent_views(groups, 3, "b=action/2+action/0;a=action/1")
    assert [(view.name, view.actions, len(view.columns)) for view in views] == [("b", (0, 2), 5), ("a", (1,), 5)]
    assert [view.actions for view in agent_views(groups, 3, "single")] == [(0, 1, 2)]
    with pytest.raises(BidexError, match="hands needs a world with hands"):
        agent_views(groups, 3, "hands")
