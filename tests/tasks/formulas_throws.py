"""The classes whose object shall come to a goal pose: equations 1 to 5 and 15 of the appendix."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.oracle import (
    Goal,
    Judgement,
    Oracle,
    Task,
    frame,
    goal_rotation,
    length,
    pose,
    rotation_distance,
    shifted,
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

    def __init__(
        self,
        alpha: float,
        floor: float,
        anchors: dict[str, tuple[float, float, float]] | None = None,
        bodies: dict[str, str] | None = None,
    ) -> None:
        self.alpha, self.floor, self.anchors = alpha, floor, anchors or {}
        self.body_of_goal = bodies or {"goal": "object/object"}

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
            spot = (
                (2.5, centre[1], self.floor + rng.uniform(-0.05, 0.05))
                if low
                else centre + rng.uniform(-0.025, 0.025, 3)
            )
            parts[body.removesuffix("/object")] = pose(np.array(spot), turn * Rotation.from_rotvec(rng.normal(size=3)))
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
        edges = (r_1 - 0.2, r_2 - 0.2, d_1 - 0.1, d_2 - 0.1)
        return Judgement(terms, max(edges) < 0, False, min(abs(edge) for edge in edges))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Both cubes in the air, turned and moved a little off their goals."""
        return {
            goal.replace("goal", "object"): pose(
                shifted(centre, 0, 0, rng.uniform(0.06, 0.11)), Rotation.from_rotvec(rng.normal(size=3) * 0.1) * turn
            )
            for goal, (centre, turn) in self.goals(data, task).items()
        }
