import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world import World
from bidex_meta.world.contract import ObservationGroup
from bidex_meta.world.observations import observation_groups
from tests.world.play import class_world, random_actions, suite_world

HANDS = {"right_hand": [(0, 199)], "left_hand": [(199, 398)]}


def ranges(groups: tuple[ObservationGroup, ...]) -> dict[str, list[tuple[int, int]]]:
    return {group.name: [(where.start, where.stop) for where in group.where] for group in groups}


def entries(obs: Tensor, world: World, name: str) -> Tensor:
    where = next(group.where for group in world.observation_groups if group.name == name)
    return torch.cat([obs[:, part] for part in where], 1)


def test_groups_of_suites_and_of_a_class_alone() -> None:
    shared = HANDS | {"object": [(398, 411)]}
    mt4 = shared | {"goal": [(411, 422)], "task": [(422, 446)], "task_id": [(446, 450)]}
    assert ranges(suite_world("MT4", 4).observation_groups) == mt4
    mt20 = shared | {"task": [(411, 446)], "task_id": [(446, 466)]}
    assert ranges(suite_world("MT20", 20).observation_groups) == mt20
    ml4 = shared | {"goal": [(411, 422)], "padding": [(422, 446)]}
    assert ranges(suite_world("ML4", 3).observation_groups) == ml4
    two = HANDS | {"object": [(398, 411), (422, 435)], "goal": [(411, 422), (435, 446)]}
    assert ranges(suite_world("ML4", 1, split="test").observation_groups) == two
    alone = {"right_hand": [(0, 187)], "left_hand": [(187, 374)], "object": [(374, 387)], "goal": [(387, 398)]}
    assert ranges(class_world("HandOver", 1).observation_groups) == alone


def test_a_handle_is_of_the_object_whatever_its_name() -> None:
    layout = registry.get("LiftUnderarm").layout
    where = layout.range("right_handle_position")
    found = ranges(observation_groups([layout], layout.size, 0))
    assert found["object"] == [(398, 411), (422, 428)] and where == slice(422, 425)


def test_groups_hold_what_their_names_say() -> None:
    for world, hidden in ((suite_world("ML4", 6), True), (suite_world("MT1", 6), False)):
        world.reset(seed=0)
        for action in random_actions(world, 3):
            obs = world.step(action)[0]
        assert (entries(obs, world, "goal") == 0).all() == hidden
        if hidden:
            assert (entries(obs, world, "padding") == 0).all()
        assert torch.equal(entries(obs, world, "right_hand")[:, -26:], action[:, :26])
        assert torch.equal(entries(obs, world, "left_hand")[:, -26:], action[:, 26:])
        assert (entries(obs, world, "object").abs().sum(1) > 0.5).all()
