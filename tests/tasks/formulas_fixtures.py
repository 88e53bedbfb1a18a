"""The classes with doors or switches: equations 7 to 10 and 17 of the appendix."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.oracle import Goal, Judgement, Oracle, Task, about_z, angle, frame, length, linear, nominal, shifted

TRAVEL = 0.5585
"""A switch's hinge at full travel, rad (docs/figures.md, objects)."""


class Door(Oracle):
    """Equations 7 to 10. Handles between the panel and the pulls that face the hands (docs/figures.md, objects)."""

    body_of_goal: ClassVar = {"goal": "object/object"}

    def __init__(self, opens: bool, side: float) -> None:
        self.opens, self.side = opens, side

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        position, turn = frame(data, "object/object")
        hinges = {
            "door right handle position": (
                (-0.00846, 0.42653, 0.48329),
                -1,
                "object/hinge1",
                (-self.side, -0.39, -0.5),
            ),
            "door left handle position": ((-0.00560, -0.42041, 0.48329), 1, "object/hinge2", (-self.side, 0.39, -0.5)),
        }
        return {
            words: position + turn.apply(origin + about_z(sign * angle(data, joint)).apply(offset))
            for words, (origin, sign, joint, offset) in hinges.items()
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
            edges = (of_right + of_left - 0.5, of_right - 0.1, of_left - 0.1)
            return Judgement(terms, min(edges) > 0, False, min(abs(edge) for edge in edges))
        ajar = [angle(data, f"object/hinge{i}") - 0.05 * np.pi for i in (1, 2)]
        return Judgement(terms, max(ajar) < 0, False, min(abs(edge) for edge in ajar))

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
        past = [angle(data, f"switch{i}/hinge") - 0.8 * TRAVEL for i in (1, 2)]
        return Judgement(terms, min(past) > 0, False, min(abs(edge) for edge in past))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {f"switch{i}/hinge": rng.uniform(0.3, TRAVEL, 1) for i in (1, 2)}
