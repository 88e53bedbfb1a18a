"""Version 2 in plain numbers: what a task hides, how far a state is from solved, its reward, and states about there.

``data`` and ``task`` are those of ``oracle``; nothing here imports the project.
"""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.formulas import FAILING, FORMULAS
from tests.tasks.formulas_of_blocks import PushBlock, inside, kept
from tests.tasks.oracle import Task, about_z, angle, frame, length, pose, rotation_distance, shifted, tilt
from tests.tasks.oracle import start as start_of

LEAVES = {"object/hinge1": "right_angle", "object/hinge2": "left_angle"}
ROCKERS = {f"switch{i}/hinge": f"switch{i}_angle" for i in (1, 2)}
JOINTS = {
    **dict.fromkeys((name for name in FORMULAS if name.startswith("Door")), (LEAVES, 0.15)),
    "BottleCap": ({"bottle/slide": "cap_slide"}, 0.005),
    "OpenScissors": ({"scissors/hinge": "target_angle"}, 0.04),
    "OpenPenCap": ({"pen/slide": "gap"}, 0.025),
    "Switch": (ROCKERS, 0.08),
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
"""What each class hides."""
ENTERING = HIDDEN | {"LiftUnderarm": {*HIDDEN["LiftUnderarm"], "object_x", "object_y"}}
"""What enters the reward: of the pot its place at the start too, which observations show."""
BUCKETS = {"PourWater": (0.0, -0.3, 0.457), "GraspAndPlace": (0.0, 0.2, 0.657)}


def goals(name: str, task: Task) -> dict[str, np.ndarray]:
    """Where blocks and buckets shall stand, world, metres."""
    if name == "PushBlock":
        shift = {f"block{i}": (task[f"goal{i}_x"], task[f"goal{i}_y"], 0.0) for i in (1, 2)}
        return {block: shifted(np.array(PushBlock.places[block]), *by) for block, by in shift.items()}
    if name == "StackBlock":
        top, bottom = FORMULAS[name].targets(task)  # type: ignore[attr-defined]
        return dict(zip(("block1", "block2"), (bottom, top) if task["order"] < 0 else (top, bottom), strict=True))
    if name in BUCKETS:
        return {"bucket": shifted(np.array(BUCKETS[name]), task["goal_x"], task["goal_y"], 0.0)}
    return {}


def errors(name: str, data: mujoco.MjData, task: Task) -> tuple[list[float], list[float]]:
    """Errors in units of their tolerances, and what beside them must be below zero for success."""
    place = {body: length(frame(data, f"{body}/object")[0] - goal) for body, goal in goals(name, task).items()}
    if name in JOINTS:
        joints, tolerance = JOINTS[name]
        shift = 0.17 if name == "OpenPenCap" else 0.0  # of the points, shut
        return [abs(angle(data, joint) + shift - task[goal]) / tolerance for joint, goal in joints.items()], []
    if name == "PushBlock":
        return [off / 0.05 for off in place.values()], []
    if name == "StackBlock":
        x, y, z = frame(data, "block1/object")[0] - frame(data, "block2/object")[0]
        return [off / 0.03 for off in place.values()], [
            abs(z * np.copysign(1.0, task["order"]) - 0.05) - 0.01, np.hypot(x, y) - 0.03
        ]  # fmt: skip
    if name == "PourWater":
        water = FORMULAS[name].water(data)  # type: ignore[attr-defined]
        surely, perhaps = zip(*(inside(data, data.body(f"{drop}/object").xpos) for drop in water), strict=True)
        share, unsure = sum(surely) / len(water), sum(perhaps) != sum(surely)
        # A third is enough for success, though its error is then still a tolerance.
        edges = [0.0 if unsure else 1 / 3 - 1e-6 - share, -kept(data)]
        return [max(0.0, 5 / 12 - share) / (1 / 12) - 1e-9, place["bucket"] / 0.04], edges
    if name == "GraspAndPlace":
        block = data.body("block/object").xpos
        surely, perhaps = inside(data, block)
        off = length(block - data.body("bucket/object").xpos)
        return [off / 0.04, place["bucket"] / 0.04], [0.0 if surely != perhaps else 0.5 - surely, -kept(data)]
    found, edges = [], []
    for goal, body in FORMULAS[name].body_of_goal.items():
        (position, turn), (centre, wanted) = frame(data, body), FORMULAS[name].goals(data, task)[goal]
        away, turned = length(position - centre), rotation_distance(turn, wanted)
        if name == "SwingCup":
            found, edges = [turned / np.deg2rad(12)], [away - 0.2]
        elif name == "ReOrientation":
            found, edges = [*found, turned / 0.2], [*edges, away - 0.1]
        else:
            found += [away / (0.05 if name == "LiftUnderarm" else 0.03)]
            edges += [tilt(turn) - np.pi / 6] if name == "LiftUnderarm" else []
    return found, edges


def reward(name: str, data: mujoco.MjData, task: Task) -> tuple[float, bool, float]:
    """The reward of version 2, success, and how far a comparison is from its edge."""
    found, edges = errors(name, data, task)
    # The block of GraspAndPlace may lie in the bucket farther from its origin than the tolerance.
    asked = found[1:] if name in BUCKETS else found
    margins = [*(1 - error for error in asked), *(-edge for edge in edges)]
    solved, margin = min(margins) > 0, min(map(abs, margins))
    if solved:
        return 1.0, True, margin
    far, near = (
        np.mean([f(error) for error in found]) for f in (lambda e: 1 - np.tanh(e / 16), lambda e: np.exp(-0.3 * e))
    )
    terms = FORMULAS[name].judge(data, task).terms
    if "left" not in terms or name == "ReOrientation":
        return 0.25 * far + 0.65 * near, False, margin
    distances = [-np.log(terms[s]) / 10 if terms[s] > 0 else -terms[s] for s in ("left", "right")]
    distances += [0.5 - terms["target"] / 2] if name == "PourWater" else []
    return 0.2 * np.mean([1 - np.tanh(3 * d) for d in distances]) + 0.2 * far + 0.5 * near, False, margin


def near(name: str, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions of free parts and joints about where a task is solved, within less and more than tolerances."""
    spread = rng.choice((0.3, 1.0, 4.0))

    def about(centre: np.ndarray, tolerance: float) -> np.ndarray:
        sizes = np.array((1.0, 1.0, 0.0))[: len(centre)]
        return centre + sizes * spread * tolerance * rng.uniform(-1, 1, len(centre))

    if name in JOINTS:
        joints, tolerance = JOINTS[name]
        shift = 0.17 if name == "OpenPenCap" else 0.0
        return {joint: about(np.array([task[goal] - shift]), tolerance) for joint, goal in joints.items()}
    if name == "SwingCup":
        yaw = np.pi / 2 + task["yaw_change"] + spread * np.deg2rad(12) * rng.uniform(-1, 1)
        return {"cup": pose(about(start_of(data, "cup", task)[0], 0.1), about_z(yaw))}
    places = goals(name, task)
    if not places:
        return FORMULAS[name].scatter(data, task, rng)
    parts = {body: about(goal, 0.03) for body, goal in places.items()}
    found = {body: pose(place, Rotation.identity()) for body, place in parts.items()}
    if name == "GraspAndPlace":
        found["block"] = pose(shifted(parts["bucket"], 0, 0, rng.uniform(-0.02, 0.06)), Rotation.identity())
    elif name == "PourWater":
        drops = FORMULAS[name].water(data)  # type: ignore[attr-defined]
        for i, drop in enumerate(drops[: rng.integers(0, len(drops) + 1)]):
            place = shifted(parts["bucket"], 0.012 * (i % 3 - 1), 0, 0.012 * (i // 3) - 0.02)
            found |= {f"{drop}/{axis}": place[k : k + 1] for k, axis in enumerate("xyz")}
    return found
