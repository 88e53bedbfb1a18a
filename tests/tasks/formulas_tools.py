"""The classes with a pot, a bottle, a cup, scissors or a pen: equations 6, 11, 13, 14 and 16 of the appendix."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.oracle import (
    Goal,
    Judgement,
    Oracle,
    Task,
    about_z,
    angle,
    at,
    frame,
    length,
    linear,
    pose,
    reach,
    rotation_distance,
    shifted,
    some_tilt,
    start,
    tilt,
)


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
        edges = (d_target - 0.05, tilt(turn) - np.pi / 6)
        return Judgement(terms, max(edges) < 0, False, min(abs(edge) for edge in edges))

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
        off = angle(data, "bottle/slide") - 0.03
        return Judgement(terms, off > 0, False, abs(off))

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
        edges = (d_r - np.pi / 4, length(position - place) - 0.2)
        return Judgement(terms, max(edges) < 0, False, min(abs(edge) for edge in edges))

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
        """The right handle with the root at a given pose and the hinge at q."""
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
        return Judgement(terms, d_target < 0.1, False, abs(d_target - 0.1))

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
        d_left, d_right = reach(data, body, cap)
        d_target = length(body - cap)
        terms = {
            "left": float(np.exp(-10 * d_left)),
            "right": float(np.exp(-10 * d_right)),
            "target": d_target * 5,
            "constant": -0.8,
        }
        return Judgement(terms, d_target > 0.3, False, abs(d_target - 0.3))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"pen/slide": rng.uniform(0, 0.25, 1)}
