"""The sentences of tasks: every class, both versions, with the goal shown and hidden."""

import gymnasium
import numpy as np
import pytest

from bidex_meta import Benchmark, make_task_world
from bidex_meta.tasks import registry
from bidex_meta.tasks.task import Task
from tests.world.play import suite_world

VERSIONS = ("", "-v2")
HIGHEST = {
    "HandOver": "Throw an egg from the right palm to the left one across a narrow gap, and hold it at "
    "(6.0, -58.0, 60.0) cm",
    "CatchUnderarm": "Throw an egg underarm from the right hand to the left one, and hold it at (6.0, -73.0, 60.0) cm",
    "CatchOver2Underarm": "Throw an egg from the upright right hand to the upturned left palm, and hold it at "
    "(6.0, -34.0, 61.0) cm",
    "TwoCatchUnderarm": "Throw two eggs at once, each to the other hand, and hold them at (6.0, -73.0, 60.0) cm and "
    "(6.0, -32.0, 60.0) cm",
    "CatchAbreast": "Throw an egg sideways from the right palm to the left one, and hold it at "
    "(-33.0, -109.0, 60.0) cm",
    "LiftUnderarm": "Lift a pot off a table by its two grips, 50.0 cm higher than it starts and (15.0, 15.0) cm from "
    "the table's middle",
    "DoorOpenOutward": "Push both leaves of a double door, the right one to 80 and the left one to 80 degrees",
    "DoorOpenInward": "Pull both leaves of a double door, the right one to 80 and the left one to 80 degrees",
    "DoorCloseOutward": "Pull both leaves of a double door, the right one to 57 and the left one to 57 degrees",
    "DoorCloseInward": "Push both leaves of a double door, the right one to 57 and the left one to 57 degrees",
    "BottleCap": "Hold a bottle in one hand and pull its cap out by 6.0 cm with the other",
    "PushBlock": "Push the red block to (-5.0, -5.0) cm and the blue one to (-5.0, 35.0) cm, one with each hand",
    "SwingCup": "Turn a two-handled cup with both hands, by 180 degrees counterclockwise",
    "OpenScissors": "Open shears to 51 degrees with both hands",
    "ReOrientation": "Turn two cubes on the hands to the orientation of a turn by 180 degrees about x after 180 "
    "degrees about y",
    "OpenPenCap": "Pull the cap off a pen until the points on body and cap are 45.0 cm apart",
    "Switch": "Press the buttons of two rocker switches, the left one to 32 and the right one to 32 degrees",
    "StackBlock": "Stack the red block on the blue one at (9.0, 9.0) cm",
    "PourWater": "Pour water from a kettle into a bucket, which shall stand at (12.0, -18.0) cm",
    "GraspAndPlace": "Put a block into a bucket, which shall stand at (12.0, 32.0) cm",
}
"""Sentences of version 2 with every number at the upper end of its range."""


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", registry.names())
def test_a_sentence_says_the_hidden_numbers_and_no_others_or_none_of_them(name: str, version: str) -> None:
    task_class = registry.get(name + version)
    space = task_class.variation_space
    middle = 0.5 * (np.array(space.low) + np.array(space.high))
    shown = task_class.instruction(middle)
    hidden = task_class.instruction(middle, hidden=True)
    assert hidden == task_class.instruction() and not any(letter.isdigit() for letter in hidden)
    for sentence in (shown, hidden):
        assert sentence.isprintable() and sentence[0].isupper() and sentence[-1] != "." and len(sentence) < 130
    for column in range(space.size):
        for end in (space.low[column], space.high[column]):
            moved = middle.copy()
            moved[column] = end
            told = task_class.instruction(moved) != shown
            assert told == (column in task_class.hidden_columns() and not (space.names[column] == "order" and end > 0))
            assert task_class.instruction(moved, hidden=True) == hidden


def test_sentences_of_version_2() -> None:
    found = {}
    for name in registry.names():
        task_class = registry.get(f"{name}-v2")
        found[name] = task_class.instruction(task_class.variation_space.high)
    assert found == HIGHEST


@pytest.mark.parametrize("version", VERSIONS)
def test_tasks_of_suites_tell_the_goal_unless_the_suite_hides_it(version: str) -> None:
    shows = Benchmark(f"MT20{version}")
    hides = Benchmark(f"ML20{version}")
    classes = shows.task_classes("train")
    for task in shows.train_tasks:
        assert task.instruction == classes[task.env_name].instruction(task.variation)
    assert len({task.env_name for task in (*hides.train_tasks, *hides.test_tasks)}) == 20
    for task in (*hides.train_tasks, *hides.test_tasks):
        assert task.instruction == classes[task.env_name].instruction()
    bare = Task.from_variation("Switch", [0.0])
    told = Task.from_variation("Switch", [0.0], "Press")
    assert bare.instruction == "" and bare == told and len({bare, told}) == 1


def test_a_world_says_what_each_environment_plays() -> None:
    for name, hidden in (("MT4-v2", False), ("ML4-v2", True)):
        world = suite_world(name, 8)
        world.reset(seed=1)
        expected = []
        for slot, index in zip(world.task_id.tolist(), world.task_index.tolist(), strict=True):
            expected.append(world.slots[slot].task_class.instruction(world.pools[slot][index], hidden))
        assert world.instructions() == expected and len(set(expected)) == (3 if hidden else 8)


def test_another_object_is_named() -> None:
    world = make_task_world("TwoCatchUnderarm", 1, "cpu", object="tennis_ball", threads=1)
    assert world.instruction(0).startswith("Throw two objects (tennis ball) at once")
    assert (
        make_task_world("HandOver", 1, "cpu", object="mug", threads=1).instruction(0).startswith("Throw the mug from")
    )


def test_a_trial_has_its_tasks_sentence() -> None:
    trial = gymnasium.make("bidex-meta/trials", suite="ML1-Switch-v2")
    assert trial.unwrapped.task.instruction == "Press the buttons of two rocker switches to their goal angles"  # type: ignore[attr-defined]
