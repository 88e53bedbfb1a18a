"""Rewards, success and ends as printed, of all twenty classes: appendix and docs/figures.md, classes."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.formulas_of_blocks import GraspAndPlace, PourWater, PushBlock, StackBlock
from tests.tasks.oracle import (
    Goal,
    Judgement,
    Oracle,
    Task,
    about_z,
    angle,
    at,
    frame,
    goal_rotation,
    length,
    linear,
    nominal,
    pose,
    reach,
    rotation_distance,
    shifted,
    some_tilt,
    start,
    tilt,
    within,
)


def _goal(task: Task, name: str) -> Goal:
    position = np.array([task[f"{name}_{axis}"] for axis in "xyz"])
    return position, goal_rotation(task["goal_u0"], task["goal_u1"])


def _errors(data: mujoco.MjData, body: str, goal: Goal) -> tuple[float, float]:
    position, turn = frame(data, body)
    return length(position - goal[0]), rotation_distance(turn, goal[1])


class Eggs(Oracle):
    """Equations 1 to 5: the sum of exp(-0.2 (alpha d_t + d_r)) over the eggs."""

    entering = None

    def __init__(self, alpha: float, floor: float, anchors: dict | None = None, numbers: str = "") -> None:
        self.alpha, self.floor, self.anchors = alpha, floor, anchors or {}
        self.body_of_goal = {f"goal{i}": f"object{i}/object" for i in numbers or ("",)}

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        return {goal: _goal(task, goal) for goal in self.body_of_goal}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        goals = self.goals(data, task)
        errors = [_errors(data, body, goals[goal]) for goal, body in self.body_of_goal.items()]
        heights = [float(data.body(body).xpos[2]) for body in self.body_of_goal.values()]
        away = [length(data.body(body).xpos - np.array(anchor)) for body, anchor in self.anchors.items()]
        terms = {
            goal.replace("goal", "pose"): float(np.exp(-0.2 * (self.alpha * d_t + d_r)))
            for goal, (d_t, d_r) in zip(self.body_of_goal, errors, strict=True)
        }
        failed = any(z <= self.floor for z in heights) or any(d >= 0.1 for d in away)
        edges = [*(d_t - 0.03 for d_t, _ in errors), *(z - self.floor for z in heights), *(d - 0.1 for d in away)]
        return Judgement(terms, all(d_t < 0.03 for d_t, _ in errors), failed, min(abs(edge) for edge in edges))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Eggs about their goals, now and then about the height at which they count as dropped."""
        low = rng.random() < 0.15
        parts = {}
        for goal, body in self.body_of_goal.items():
            centre, turn = _goal(task, goal)
            spot = centre + rng.uniform(-0.025, 0.025, 3)
            if low:
                spot = np.array((2.5, centre[1], self.floor + rng.uniform(-0.05, 0.05)))
            parts[body.removesuffix("/object")] = pose(spot, turn * Rotation.from_rotvec(rng.normal(size=3)))
        return parts


class ReOrientation(Oracle):
    """Equation 15, its angle term subtracted (docs/figures.md, decisions); object 1 on the left hand."""

    entering = None
    body_of_goal: ClassVar = {"goal1": "object1/object", "goal2": "object2/object"}
    places: ClassVar = {"goal1": (0.0, -0.76, 0.56), "goal2": (0.0, -0.39, 0.56)}

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        turn = goal_rotation(task["goal_u0"], task["goal_u1"])
        return {goal: (np.array(place), turn) for goal, place in self.places.items()}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        goals = self.goals(data, task)
        (d_1, r_1), (d_2, r_2) = (_errors(data, body, goals[goal]) for goal, body in self.body_of_goal.items())
        terms = {"left": -10 * d_1, "right": -10 * d_2, "target": -1.5 * (r_1 + r_2)}
        return within(terms, r_1 - 0.2, r_2 - 0.2, d_1 - 0.1, d_2 - 0.1)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Both cubes in the air, turned and moved a little off their goals."""
        return {
            goal.replace("goal", "object"): pose(
                shifted(centre, 0, 0, rng.uniform(0.06, 0.11)), Rotation.from_rotvec(rng.normal(size=3) * 0.1) * turn
            )
            for goal, (centre, turn) in self.goals(data, task).items()
        }


class LiftUnderarm(Oracle):
    """Equation 6."""

    body_of_goal: ClassVar = {"goal": "object/object"}
    entering: ClassVar = {"object_x", "object_y", "goal_x", "goal_y", "goal_height"}

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {
            "object right handle position": at(data, "object/object", (0, 0.15, 0.06)),
            "object left handle position": at(data, "object/object", (0, -0.15, 0.06)),
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        position, turn = start(data, "object", task)
        return {"goal": (shifted(position, task["goal_x"], task["goal_y"], task["goal_height"]), turn)}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        right, left = self.points(data).values()
        position, turn = frame(data, "object/object")
        d_target = length(position - self.goals(data, task)["goal"][0])
        terms = linear(data, left, right, 3 * (0.985 - d_target), 0.2)
        return within(terms, d_target - 0.05, tilt(turn) - np.pi / 6)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        centre, turn = self.goals(data, task)["goal"]
        return {"object": pose(centre + rng.uniform(-0.035, 0.035, 3), some_tilt(rng, 1.0) * turn)}


class BottleCap(Oracle):
    """Equation 11, the cap's place being its own centre."""

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        height = 0.5 * (0.1393 + 0.1496) + angle(data, "bottle/slide")
        return {"bottle cap position": at(data, "bottle/object", (0, 0, height))}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        (cap,) = self.points(data).values()
        bottle = data.body("bottle/object").xpos
        terms = linear(data, cap, bottle, 30 * length(bottle - cap), 0.2)
        return within(terms, 0.03 - angle(data, "bottle/slide"))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"bottle/slide": rng.uniform(0, 0.06, 1)}


class SwingCup(Oracle):
    """Equation 13. The goal's yaw is the nominal start's + yaw_change, whatever the task's own turn of the cup."""

    body_of_goal: ClassVar = {"goal": "cup/object"}
    entering: ClassVar = {"yaw_change"}
    deciding: ClassVar = {"cup_x", "cup_y"}

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {
            "cup right handle position": at(data, "cup/object", (0.062, 0, 0)),
            "cup left handle position": at(data, "cup/object", (-0.06, 0, 0)),
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        return {"goal": (start(data, "cup", task)[0], about_z(np.pi / 2 + task["yaw_change"]))}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        right, left = self.points(data).values()
        (position, turn), (place, goal) = frame(data, "cup/object"), self.goals(data, task)["goal"]
        d_r = rotation_distance(turn, goal)
        terms = linear(data, left, right, 1 / (abs(d_r) + 0.1) * 5, -1.0)
        return within(terms, d_r - np.pi / 4, length(position - place) - 0.2)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        centre, turn = self.goals(data, task)["goal"]
        turn = about_z(rng.uniform(-1.2, 1.2)) * Rotation.from_rotvec(0.1 * rng.normal(size=3)) * turn
        return {"cup": pose(shifted(centre, *rng.uniform(-0.17, 0.17, 2), 0.1), turn)}


class OpenScissors(Oracle):
    """Equation 14. The right handle moves with the half that turns about the pivot (docs/figures.md, objects)."""

    body_of_goal: ClassVar = {"goal": "scissors/half"}
    entering: ClassVar = {"target_angle"}
    pivot = np.array((-0.0034, 0.0698, 0.0))

    def right(self, base: Goal, q: float) -> np.ndarray:
        return base[0] + base[1].apply(self.pivot + about_z(q).apply((0.1, -0.2, 0.0)))

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        base = frame(data, "scissors/object")
        return {
            "scissors right handle position": self.right(base, angle(data, "scissors/hinge")),
            "scissors left handle position": base[0] + base[1].apply((-0.1, -0.15, 0.0)),
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        base, target = frame(data, "scissors/object"), task["target_angle"]
        return {"goal": (self.right(base, target), base[1] * about_z(target))}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        right, left = self.points(data).values()
        d_target = abs(angle(data, "scissors/hinge") - task["target_angle"])
        terms = linear(data, left, right, (0.59 - d_target) * 5, 2.0)
        return within(terms, d_target - 0.1)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"scissors/hinge": task["target_angle"] + rng.uniform(-0.25, 0.25, 1)}


class OpenPenCap(Oracle):
    """Equation 16. The cap slides off along the pen's -z (docs/figures.md, objects)."""

    body_of_goal: ClassVar = {"goal": "pen/object"}

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {
            "pen body position": at(data, "pen/object", (0, 0, 0.07)),
            "pen cap position": at(data, "pen/object", (0, 0, -0.1 - angle(data, "pen/slide"))),
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        position, turn = start(data, "pen", task)
        return {"goal": (position + turn.apply((0, 0, 0.07 - 0.3)), turn)}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        body, cap = self.points(data).values()
        left, right = (float(np.exp(-10 * distance)) for distance in reach(data, body, cap))
        d_target = length(body - cap)
        terms = {"left": left, "right": right, "target": d_target * 5, "constant": -0.8}
        return within(terms, 0.3 - d_target)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"pen/slide": rng.uniform(0, 0.25, 1)}


TRAVEL = 0.5585
"""A switch's hinge at full travel, rad (docs/figures.md, objects)."""


class Door(Oracle):
    """Equations 7 to 10. Handles between the panel and the pulls that face the hands (docs/figures.md, objects)."""

    body_of_goal: ClassVar = {"goal": "object/object"}

    def __init__(self, opens: bool, side: float) -> None:
        self.opens, self.side = opens, side

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        position, turn = frame(data, "object/object")
        hinges = (("right", 1, (-0.00846, 0.42653, 0.48329), -1), ("left", 2, (-0.00560, -0.42041, 0.48329), 1))
        return {
            f"door {side} handle position": position
            + turn.apply(
                origin + about_z(sign * angle(data, f"object/hinge{i}")).apply((-self.side, sign * 0.39, -0.5))
            )
            for side, i, origin, sign in hinges
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        """The base's pose: no entry of the tables could tell more."""
        position, turn = nominal(data, "object/object")
        return {"goal": (shifted(position, 0, task["base_y"], 0), turn)}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        right, left = self.points(data).values()
        d_target = length(left - right)
        terms = linear(data, left, right, 2 * d_target if self.opens else 2 * (1 - d_target), 0.2)
        if self.opens:
            middle = data.body("object/object").xpos[1]
            of_right, of_left = right[1] - middle, middle - left[1]
            return within(terms, 0.5 - of_right - of_left, 0.1 - of_right, 0.1 - of_left)
        return within(terms, *(angle(data, f"object/hinge{i}") - 0.05 * np.pi for i in (1, 2)))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        widest = 1.57 if self.opens else 0.35
        return {f"object/hinge{i}": rng.uniform(0, widest, 1) for i in (1, 2)}


class Switch(Oracle):
    """Equation 17. A button's target is its own point at full travel of the hinge, the housing where the task puts it.

    The shape is the project's own (the original's point cannot reach its goal: docs/figures.md, classes), so hinge and
    point are taken from the model.
    """

    body_of_goal: ClassVar = {"goal": "switch1/rocker"}
    entering: ClassVar = {f"switch{i}_{axis}" for i in (1, 2) for axis in "xy"}

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {f"switch{i} position": data.site(f"switch{i}/button").xpos.copy() for i in (1, 2)}

    def pressed(self, data: mujoco.MjData, task: Task, i: int) -> Goal:
        """Where the button point is at full travel, and the rocker's orientation there."""
        model = data.model
        position, turn = nominal(data, f"switch{i}/object")
        position = shifted(position, task[f"switch{i}_x"], task[f"switch{i}_y"], 0)
        rocker, joint = model.body(f"switch{i}/rocker"), model.joint(f"switch{i}/hinge")
        travel = Rotation.from_rotvec(TRAVEL * joint.axis)
        hinge = position + turn.apply(rocker.pos + joint.pos)
        turn = turn * Rotation.from_quat(rocker.quat, scalar_first=True) * travel
        return hinge + turn.apply(model.site(f"switch{i}/button").pos - joint.pos), turn

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        return {"goal": self.pressed(data, task, 1)}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        first, second = self.points(data).values()
        d_target = length(first - self.pressed(data, task, 1)[0]) + length(second - self.pressed(data, task, 2)[0])
        terms = linear(data, first, second, (1.4 - d_target) * 50, 2.0)
        return within(terms, *(0.8 * TRAVEL - angle(data, f"switch{i}/hinge") for i in (1, 2)))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {f"switch{i}/hinge": rng.uniform(0.3, TRAVEL, 1) for i in (1, 2)}


FORMULAS: dict[str, Oracle] = {
    "HandOver": Eggs(50.0, 0.2),
    "CatchUnderarm": Eggs(50.0, 0.1),
    "CatchOver2Underarm": Eggs(20.0, 0.3, {"right/mount": (0, 0, 0.5), "left/mount": (0, -0.8, 0.5)}),
    "TwoCatchUnderarm": Eggs(50.0, 0.2, numbers="12"),
    "CatchAbreast": Eggs(50.0, 0.2, {"right/palm": (-0.3, -0.55, 0.5), "left/palm": (-0.3, -1.15, 0.5)}),
    "LiftUnderarm": LiftUnderarm(),
    "DoorOpenOutward": Door(opens=True, side=-0.04),
    "DoorOpenInward": Door(opens=True, side=0.04),
    "DoorCloseOutward": Door(opens=False, side=-0.04),
    "DoorCloseInward": Door(opens=False, side=0.04),
    "BottleCap": BottleCap(),
    "PushBlock": PushBlock(),
    "SwingCup": SwingCup(),
    "OpenScissors": OpenScissors(),
    "ReOrientation": ReOrientation(),
    "OpenPenCap": OpenPenCap(),
    "Switch": Switch(),
    "StackBlock": StackBlock(),
    "PourWater": PourWater(),
    "GraspAndPlace": GraspAndPlace(),
}
FAILING = {"HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm", "CatchAbreast"}
"""Classes that end other than by time: their rewards are positive throughout (docs/figures.md, decisions)."""
