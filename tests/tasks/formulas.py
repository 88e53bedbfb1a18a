"""Rewards, success and ends as printed (appendix equations 1 to 5, sheet section 4), in float64 with NumPy and SciPy.

Nothing here imports the project: ``data`` is MuJoCo's own, ``task`` the numbers that a task froze.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation


def goal_rotation(draws: np.ndarray) -> Rotation:
    """A turn by pi u0 about x, on the left, times one by pi u1 about y (sheet 3.3)."""
    return Rotation.from_rotvec([np.pi * draws[0], 0, 0]) * Rotation.from_rotvec([0, np.pi * draws[1], 0])


@dataclass(frozen=True)
class Judgement:
    """What the printed formulas say of one state; margins tell how far a comparison is from its edge, metres."""

    terms: dict[str, float]
    success: bool
    failed: bool
    margin: float


def _errors(data: mujoco.MjData, name: str, position: np.ndarray, goal: Rotation) -> tuple[float, float]:
    body = data.body(f"{name}/object")
    difference = (Rotation.from_quat(body.xquat, scalar_first=True) * goal.inv()).as_quat()
    d_r = 2.0 * np.arcsin(min(1.0, float(np.linalg.norm(difference[:3]))))
    return float(np.linalg.norm(body.xpos - position)), d_r


def _apart(data: mujoco.MjData, body: str, anchor: tuple[float, float, float]) -> float:
    return float(np.linalg.norm(data.body(body).xpos - np.array(anchor)))


def _one_egg(alpha: float, floor: float, anchors: dict[str, tuple[float, float, float]]) -> Callable[..., Judgement]:
    def judge(data: mujoco.MjData, task: np.ndarray) -> Judgement:
        d_t, d_r = _errors(data, "object", task[:3], goal_rotation(task[3:5]))
        height = float(data.body("object/object").xpos[2])
        away = [_apart(data, body, anchor) for body, anchor in anchors.items()]
        failed = height <= floor or any(d >= 0.1 for d in away)
        margin = min(abs(d_t - 0.03), abs(height - floor), *(abs(d - 0.1) for d in away), 1.0)
        return Judgement({"pose": float(np.exp(-0.2 * (alpha * d_t + d_r)))}, d_t < 0.03, failed, margin)

    return judge


def _two_eggs(data: mujoco.MjData, task: np.ndarray) -> Judgement:
    goal = goal_rotation(task[6:8])
    errors = [_errors(data, f"object{i}", task[3 * i - 3 : 3 * i], goal) for i in (1, 2)]
    heights = [float(data.body(f"object{i}/object").xpos[2]) for i in (1, 2)]
    terms = {f"pose{i}": float(np.exp(-0.2 * (50.0 * d_t + d_r))) for i, (d_t, d_r) in enumerate(errors, start=1)}
    margin = min(*(abs(d_t - 0.03) for d_t, _ in errors), *(abs(z - 0.2) for z in heights))
    return Judgement(terms, all(d_t < 0.03 for d_t, _ in errors), any(z <= 0.2 for z in heights), margin)


FORMULAS: dict[str, Callable[[mujoco.MjData, np.ndarray], Judgement]] = {
    "HandOver": _one_egg(50.0, 0.2, {}),
    "CatchUnderarm": _one_egg(50.0, 0.1, {}),
    "CatchOver2Underarm": _one_egg(20.0, 0.3, {"right/mount": (0, 0, 0.5), "left/mount": (0, -0.8, 0.5)}),
    "TwoCatchUnderarm": _two_eggs,
    "CatchAbreast": _one_egg(50.0, 0.2, {"right/palm": (-0.3, -0.55, 0.5), "left/palm": (-0.3, -1.15, 0.5)}),
}


def goals(name: str, task: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Position and quaternion (x, y, z, w) of every goal of a task, by the name it has in the tables."""
    if name == "TwoCatchUnderarm":
        turn = goal_rotation(task[6:8]).as_quat()
        return {"goal1": (task[:3], turn), "goal2": (task[3:6], turn)}
    return {"goal": (task[:3], goal_rotation(task[3:5]).as_quat())}


OBJECT_OF_GOAL = {"goal": "object", "goal1": "object1", "goal2": "object2"}
