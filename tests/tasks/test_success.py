"""What counts as solved: for every class a state that does and some that do not."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bidex_meta.tasks import registry
from tests.tasks.formulas import FORMULAS, TRAVEL
from tests.tasks.formulas_of_blocks import PushBlock, StackBlock
from tests.tasks.oracle import Goal, Task, about_z, pose, shifted, start
from tests.tasks.worlds import Lens, engine_of, observe, scene_of, set_pose, task_of, world_of

Parts = dict[str, np.ndarray]


class State(NamedTuple):
    """Where some parts are, and whether that is solved."""

    what: str
    parts: Parts
    solved: bool = False


class Start(NamedTuple):
    """What the builders of states need: the class's goals, its task and where the task puts objects."""

    goals: dict[str, Goal]
    task: Task
    placed: Callable[[str], Goal]


def tip(degrees: float) -> Rotation:
    return Rotation.from_rotvec([np.deg2rad(degrees), 0.0, 0.0])


def eggs(at: Start) -> list[State]:
    parts = {goal: goal.replace("goal", "object") for goal in at.goals}

    def all_off(*offsets: float) -> Parts:
        placed = zip(at.goals.items(), offsets, strict=True)
        return {parts[name]: pose(shifted(centre, 0, off, 0), tip(90)) for (name, (centre, _)), off in placed}

    one, far = len(parts), 0.04
    states = [
        State("2 cm off, turned", all_off(*[0.02] * one), True),
        State("4 cm off", all_off(*[far] * one)),
        State("on the floor", all_off(*[1.0] * one)),
    ]
    return states if one == 1 else [*states, State("one at its goal", all_off(0.0, far))]


def pot(at: Start) -> list[State]:
    centre, turn = at.goals["goal"]

    def put(x: float, tipped: float) -> Parts:
        return {"object": pose(shifted(centre, x, 0, 0), tip(tipped) * turn)}

    return [
        State("4 cm off, tipped a little", put(0.04, 20), True),
        State("6 cm off", put(0.06, 0)),
        State("upside down at the goal", put(0.0, 180)),
        State("tipped by 40 degrees at the goal", put(0.0, 40)),
    ]


def leaves(first: float, second: float) -> Parts:
    return {"object/hinge1": np.array([first]), "object/hinge2": np.array([second])}


def both(first: np.ndarray, second: np.ndarray, yaw: float = 0.0) -> Parts:
    """Two blocks at places, turned by a yaw."""
    return {"block1": pose(first, about_z(yaw)), "block2": pose(second, about_z(yaw))}


def doors_open(at: Start) -> list[State]:
    return [
        State("both open", leaves(1.4, 1.4), True),
        State("one wide, one less", leaves(1.57, 1.0), True),
        State("both ajar", leaves(0.3, 0.3)),
        State("the first leaf alone", leaves(1.3, 0.0)),
        State("the second leaf alone", leaves(0.0, 1.3)),
        State("the first leaf beyond its stop", leaves(1.65, 0.0)),
        State("the second leaf beyond its stop", leaves(0.0, 1.65)),
    ]


def doors_close(at: Start) -> list[State]:
    return [
        State("both nearly shut", leaves(0.14, 0.1), True),
        State("one shut", leaves(0.0, 0.5)),
        State("both 30 degrees open, handles 40 cm apart", leaves(0.52, 0.52)),
    ]


def joint(name: str, good: float, *bad: float) -> Callable[[Start], list[State]]:

    def states(at: Start) -> list[State]:
        return [State(f"{name} {q}", {name: np.array([q])}, q == good) for q in (good, *bad)]

    return states


def scissors(at: Start) -> list[State]:
    target = at.task["target_angle"]
    return [
        State(f"{off} rad off", {"scissors/hinge": np.array([target + off])}, abs(off) < 0.1)
        for off in (0.08, 0.12, -0.12, -0.3)
    ]


def switches(at: Start) -> list[State]:
    def pressed(first: float, second: float) -> Parts:
        return {"switch1/hinge": np.array([first * TRAVEL]), "switch2/hinge": np.array([second * TRAVEL])}

    return [
        State("both", pressed(0.85, 0.82), True),
        State("the first alone", pressed(1.0, 0.75)),
        State("the second alone", pressed(0.75, 1.0)),
    ]


def cubes_pushed(at: Start) -> list[State]:
    one, two = (np.array(place) for place in PushBlock.places.values())
    return [
        State("both 8 cm off", both(shifted(one, 0.08, 0, 0), shifted(two, 0, 0.08, 0), 0.5), True),
        State("one at its start", both(one, shifted(two, 0.2, 0, 0), 0.5)),
        State("one 12 cm off", both(shifted(one, 0, 0.12, 0), two, 0.5)),
        State("exchanged", both(two, one, 0.5)),
    ]


def cup(at: Start) -> list[State]:
    centre, turn = at.goals["goal"]

    def put(x: float, z: float, degrees: float) -> Parts:
        return {"cup": pose(shifted(centre, x, 0, z), about_z(np.deg2rad(degrees)) * turn)}

    return [
        State("40 degrees and 15 cm off", put(0.15, 0.0, 40), True),
        State("50 degrees off", put(0.0, 0.0, 50)),
        State("unturned", {"cup": pose(*at.placed("cup"))}),
        State("turned, on the floor metres away", put(2.0, -0.6, 0)),
        State("turned, 25 cm away", put(0.25, 0.0, 0)),
    ]


def cubes_turned(at: Start) -> list[State]:
    def put(first: tuple[float, float], second: tuple[float, float]) -> Parts:
        return {
            name.replace("goal", "object"): pose(shifted(centre, away, 0, 0), about_z(angle) * turn)
            for (name, (centre, turn)), (away, angle) in zip(at.goals.items(), (first, second), strict=True)
        }

    return [
        State("both 8 cm and 0.15 rad off", put((0.08, 0.15), (0.08, -0.15)), True),
        State("the first turned too little", put((0.0, 0.25), (0.0, 0.0))),
        State("the second turned too little", put((0.0, 0.0), (0.0, 0.25))),
        State("both turned, one 15 cm away", put((0.0, 0.0), (0.15, 0.0))),
        State("both turned, far away", put((2.0, 0.1), (-2.0, 0.1))),
    ]


def stack(at: Start) -> list[State]:
    top, bottom = StackBlock().targets(at.task)
    return [
        State("stacked, both 2 cm off", both(shifted(top, 0.02, 0, 0), shifted(bottom, 0.02, 0, 0)), True),
        State("held above", both(shifted(top, 0, 0, 0.02), bottom)),
        State("exchanged", both(bottom, top)),
        State("stacked 5 cm away", both(shifted(top, 0.05, 0, 0), shifted(bottom, 0.05, 0, 0))),
    ]


def water(at: Start) -> list[State]:
    place, turn = at.placed("bucket")
    drops = registry.get("PourWater", True).water  # type: ignore[attr-defined]

    def put(tipped: float, inside: int, depth: float = -0.03, lift: float = 0.2) -> Parts:
        """So many drops on one spot of the bucket's axis; the others stay in the kettle."""
        centre, whole = shifted(place, 0, 0, lift), tip(tipped) * turn
        spot = centre + whole.apply((0.0, 0.0, depth))
        of_drops = {f"water{i}/{axis}": spot[k : k + 1] for i in range(inside) for k, axis in enumerate("xyz")}
        return {"bucket": pose(centre, whole)} | of_drops

    third = -(-drops // 3)
    return [
        State("a third, bucket tipped by 30 degrees", put(30, third), True),
        State("less than a third", put(0, third - 1)),
        State("all of it under the bucket", put(0, drops, depth=-0.08)),
        State("all of it in a bucket that lies", put(90, drops)),
        State("all of it in a bucket tipped by 60 degrees", put(60, drops)),
        State("all of it under a bucket put over it", put(180, drops)),
    ]


def block(at: Start) -> list[State]:
    place, turn = at.placed("bucket")

    def put(tipped: float, *offset: float) -> Parts:
        whole = tip(tipped) * turn
        return {"bucket": pose(place, whole), "block": pose(place + whole.apply(offset), whole)}

    return [
        State("in it, tipped by 30 degrees", put(30, 0.0, 0.0, 0.02), True),
        State("beside it", put(0, 0.1, 0.0, -0.028)),
        State("under it", put(0, 0.0, 0.0, -0.075)),
        State("over its rim", put(0, 0.0, 0.0, 0.07)),
        State("in a bucket that lies", put(90, 0.0, 0.0, 0.02)),
        State("under a bucket put over it", put(180, 0.0, 0.0, 0.02)),
    ]


STATES: dict[str, Callable[[Start], list[State]]] = {
    **{name: eggs for name in ("HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm", "CatchAbreast")},
    "LiftUnderarm": pot,
    "DoorOpenOutward": doors_open,
    "DoorOpenInward": doors_open,
    "DoorCloseOutward": doors_close,
    "DoorCloseInward": doors_close,
    "BottleCap": joint("bottle/slide", 0.035, 0.025, 0.0),
    "PushBlock": cubes_pushed,
    "SwingCup": cup,
    "OpenScissors": scissors,
    "ReOrientation": cubes_turned,
    "OpenPenCap": joint("pen/slide", 0.14, 0.12, 0.0),
    "Switch": switches,
    "StackBlock": stack,
    "PourWater": water,
    "GraspAndPlace": block,
}


@pytest.mark.parametrize("name", registry.names())
def test_good_states_are_solved_and_bad_ones_are_not(name: str) -> None:
    first = world_of(name, True, 1, tasks=1)
    first.reset(seed=0)
    task = task_of(first, 0)
    data = Lens(scene_of(first).model).look(engine_of(first).placement()[0])
    states = STATES[name](Start(FORMULAS[name].goals(data, task), task, lambda part: start(data, part, task)))
    assert sum(not state.solved for state in states) >= 2 and any(state.solved for state in states)

    world = world_of(name, True, len(states), tasks=1)
    world.reset(seed=0)
    for row, state in enumerate(states):
        for part, values in state.parts.items():
            set_pose(world, row, part, values)
    observe(world)
    ((_, _, seen),) = world.parts[0].states(world.task_index)
    found = world.slots[0].task_class.success(seen).tolist()
    assert {s.what: solved for s, solved in zip(states, found, strict=True)} == {s.what: s.solved for s in states}
