"""What the printed formulas are written with: MuJoCo's own frames and joints, in float64 with NumPy and SciPy.

Nothing here or in ``formulas`` imports the project. ``data`` is MuJoCo's own; a task is the dict of the
numbers that it froze, by component name. Points on objects stand where the original puts them in the frame of the
object's root body (docs/figures.md, classes and objects).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

Task = dict[str, float]
Goal = tuple[np.ndarray, Rotation]


@dataclass(frozen=True)
class Judgement:
    """What the printed formulas say of one state; margins tell how far a comparison is from its edge (m or rad)."""

    terms: dict[str, float]
    success: bool
    failed: bool
    margin: float


def within(terms: dict[str, float], *edges: float) -> Judgement:
    """Solved where all edges are below zero; never failed."""
    return Judgement(terms, max(edges) < 0, False, float(min(abs(edge) for edge in edges)))


class Oracle:
    """A class's formulas: goals, as the tables name them, to the bodies whose orientation is compared with them, and
    the components of a variation that enter the reward of a given state (None: all of them), or its success alone."""

    body_of_goal: Mapping[str, str] = MappingProxyType({})
    entering: frozenset[str] | set[str] | None = frozenset()
    deciding: frozenset[str] | set[str] = frozenset()

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        """Reward terms, success and end in a state."""
        raise NotImplementedError

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Positions of the points that the observation tables list, by the tables' words."""
        return {}

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        """Position and orientation of every goal, by the name it has in the tables."""
        return {}

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Positions of some free parts and joints, drawn about the places where success is decided."""
        raise NotImplementedError


def frame(data: mujoco.MjData, body: str) -> Goal:
    return data.body(body).xpos.copy(), Rotation.from_quat(data.body(body).xquat, scalar_first=True)


def at(data: mujoco.MjData, body: str, offset: tuple[float, float, float]) -> np.ndarray:
    return data.body(body).xpos + data.body(body).xmat.reshape(3, 3) @ np.array(offset)


def angle(data: mujoco.MjData, joint: str) -> float:
    return float(data.joint(joint).qpos[0])


def nominal(data: mujoco.MjData, body: str) -> Goal:
    """Where the scene puts a body before any task and episode."""
    model = data.model.body(body)
    return model.pos.copy(), Rotation.from_quat(model.quat, scalar_first=True)


def start(data: mujoco.MjData, name: str, task: Task) -> Goal:
    """Where a task puts an object: shifted in x and y, turned about the vertical through its origin."""
    position, turn = nominal(data, f"{name}/object")
    return shifted(position, task[f"{name}_x"], task[f"{name}_y"], 0.0), about_z(task[f"{name}_yaw"]) * turn


def about_z(yaw: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, yaw])


def goal_rotation(u0: float, u1: float) -> Rotation:
    """A turn by pi u0 about x, on the left, times one by pi u1 about y (docs/figures.md, start noise)."""
    return Rotation.from_rotvec([np.pi * u0, 0, 0]) * Rotation.from_rotvec([0, np.pi * u1, 0])


def rotation_distance(a: Rotation, b: Rotation) -> float:
    """2 arcsin(min(1, |vec(a b*)|)) (A.2.1; docs/figures.md, observation)."""
    difference = (a * b.inv()).as_quat()
    return 2.0 * float(np.arcsin(min(1.0, float(np.linalg.norm(difference[:3])))))


def hand_point(data: mujoco.MjData, side: str) -> np.ndarray:
    """The palm's origin + 8 cm along its z - 2 cm along its y (docs/figures.md, hand point)."""
    return at(data, f"{side}/palm", (0.0, -0.02, 0.08))


def shifted(position: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return position + np.array((x, y, z))


def tilt(turn: Rotation) -> float:
    """Angle between a body's own z axis and the vertical, rad."""
    return float(np.arccos(np.clip(turn.apply((0.0, 0.0, 1.0))[2], -1.0, 1.0)))


def some_tilt(rng: np.random.Generator, widest: float) -> Rotation:
    """A turn by up to an angle (rad) about a random horizontal axis."""
    direction, size = rng.uniform(-np.pi, np.pi), rng.uniform(0, widest)
    return Rotation.from_rotvec(size * np.array((np.cos(direction), np.sin(direction), 0.0)))


def length(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def reach(data: mujoco.MjData, left: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """d_left and d_right: distances of the two hand points to the points they shall be at."""
    return length(hand_point(data, "left") - left), length(hand_point(data, "right") - right)


def linear(
    data: mujoco.MjData, left: np.ndarray, right: np.ndarray, target: float, constant: float
) -> dict[str, float]:
    """Terms of the formulas of the form constant - d_left - d_right + target."""
    d_left, d_right = reach(data, left, right)
    return {"left": -d_left, "right": -d_right, "target": target, "constant": constant}


def pose(position: np.ndarray, turn: Rotation) -> np.ndarray:
    """Positions of a free part: x, y, z and quaternion (w, x, y, z)."""
    return np.concatenate((position, turn.as_quat(scalar_first=True)))
