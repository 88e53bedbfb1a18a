"""Version 2 in plain numbers: what a task hides, where it is solved, and states about there. See ``oracle``."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.formulas import FAILING, FORMULAS
from tests.tasks.formulas_of_blocks import PushBlock
from tests.tasks.oracle import Task, about_z, angle, frame, length, pose, rotation_distance, shifted
from tests.tasks.oracle import start as start_of

LEAVES = {"object/hinge1": "right_angle", "object/hinge2": "left_angle"}
JOINTS = {
    **dict.fromkeys((name for name in FORMULAS if name.startswith("Door")), (LEAVES, 0.15)),
    "BottleCap": ({"bottle/slide": "cap_slide"}, 0.005),
    "OpenScissors": ({"scissors/hinge": "target_angle"}, 0.04),
    "OpenPenCap": ({"pen/slide": "gap"}, 0.0125),
    "Switch": ({f"switch{i}/hinge": f"switch{i}_angle" for i in (1, 2)}, 0.08),
}
"""Classes that ask for joints: which component says where each shall be, and the tolerance, rad or m."""
HIDDEN = {
    **{name: {f"goal_{axis}" for axis in "xyz"} for name in FAILING},
    **{name: set(joints.values()) for name, (joints, _) in JOINTS.items()},
    "TwoCatchUnderarm": {f"goal{i}_{axis}" for i in (1, 2) for axis in "xyz"},
    "LiftUnderarm": {"goal_x", "goal_y", "goal_height"},
    "PushBlock": {f"goal{i}_{axis}" for i in (1, 2) for axis in "xy"},
    "SwingCup": {"yaw_change"},
    "ReOrientation": {"goal_u0", "goal_u1"},
    "StackBlock": {"target_x", "target_y", "order"},
    "PourWater": {"goal_x", "goal_y"},
    "GraspAndPlace": {"goal_x", "goal_y"},
}
BUCKETS = {"PourWater": (0.0, -0.3, 0.457), "GraspAndPlace": (0.0, 0.2, 0.657)}


def _shut(name: str) -> float:
    return 0.17 if name == "OpenPenCap" else 0.0  # the points' distance then


def _pushed(task: Task, i: int) -> np.ndarray:
    return shifted(np.array(PushBlock.places[f"block{i}"]), task[f"goal{i}_x"], task[f"goal{i}_y"], 0.0)


def solved(name: str, data: mujoco.MjData, task: Task) -> tuple[bool, float]:
    """Success of version 2, and how far a comparison is from its edge, m or rad."""
    edges: list[float] = []
    if name in JOINTS:
        joints, tolerance = JOINTS[name]
        edges = [abs(angle(data, joint) + _shut(name) - task[goal]) - tolerance for joint, goal in joints.items()]
    elif name == "PushBlock":
        edges = [length(data.body(f"block{i}/object").xpos - _pushed(task, i)) - 0.05 for i in (1, 2)]
    elif name == "StackBlock":
        order = (1, 2) if task["order"] >= 0 else (2, 1)
        top, bottom = (data.body(f"block{i}/object").xpos for i in order)
        above, wanted = top - bottom, np.array((task["target_x"], task["target_y"], 0.625))
        edges = [length(bottom - wanted) - 0.03, length(top - shifted(wanted, 0, 0, 0.05)) - 0.03]
        edges += [abs(above[2] - 0.05) - 0.01, np.hypot(*above[:2]) - 0.03]
    else:
        told = FORMULAS[name].judge(data, task)
        if name in BUCKETS:
            goal = shifted(np.array(BUCKETS[name]), task["goal_x"], task["goal_y"], 0)
            edges = [length(data.body("bucket/object").xpos - goal) - 0.04]
        elif name == "SwingCup":
            turn = FORMULAS[name].goals(data, task)["goal"][1]
            edges = [rotation_distance(frame(data, "cup/object")[1], turn) - np.deg2rad(8)]
        return told.success and all(edge < 0 for edge in edges), min(told.margin, *map(abs, edges), 1.0)
    return max(edges) < 0, min(map(abs, edges))


def near(name: str, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions of free parts and joints about where a task is solved, within less and more than tolerances."""
    spread = rng.choice((0.5, 1.3, 4.0)) * rng.uniform(-1, 1, 4)
    if name in JOINTS:
        joints, tolerance = JOINTS[name]
        offs = zip(joints.items(), tolerance * spread[:, None], strict=False)
        return {joint: task[goal] - _shut(name) + off for (joint, goal), off in offs}
    if name == "PushBlock":
        offs = 0.04 * spread.reshape(2, 2)
        return {f"block{i}": pose(shifted(_pushed(task, i), *offs[i - 1], 0), Rotation.identity()) for i in (1, 2)}
    if name == "SwingCup":
        turn = about_z(np.pi / 2 + task["yaw_change"] + np.deg2rad(8) * spread[0])
        return {"cup": pose(shifted(start_of(data, "cup", task)[0], *0.1 * spread[1:3], 0), turn)}
    if name in BUCKETS:
        task = task | {f"bucket_{axis}": task[f"goal_{axis}"] + 0.03 * spread[i] for i, axis in enumerate("xy")}
    parts = FORMULAS[name].scatter(data, task, rng)
    swapped = name == "StackBlock" and task["order"] < 0
    return {"block1": parts["block2"], "block2": parts["block1"]} if swapped else parts
