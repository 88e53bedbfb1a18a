"""What classes with a goal pose share: the frozen goal and the two goal blocks of the observation."""

from torch import Tensor

from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import conjugate, multiply


def frozen_goal(pose: Tensor, goal: str = "goal") -> dict[str, Tensor]:
    """A goal pose (n, 7), position and quaternion (x, y, z, w), and the inverse of its rotation, as frozen numbers."""
    return {goal: pose, f"{goal}_inverse": conjugate(pose[:, 3:])}


def rotation_difference(state: TaskState, sensor: str, goal: str = "goal") -> Tensor:
    """A body's quaternion, by its sensor, times the inverse of its frozen goal's, (x, y, z, w), shape (n, 4)."""
    inverse = state.frozen[f"{goal}_inverse"]
    return state.once(("difference", sensor, goal), lambda: multiply(state.quaternion(sensor), inverse))


def observe_goal(state: TaskState, sensor: str, goal: str = "goal") -> dict[str, Tensor]:
    """The two goal blocks of a body whose orientation that sensor gives."""
    difference = rotation_difference(state, sensor, goal)
    return {f"{goal}_pose": state.frozen[goal], f"{goal}_rotation_difference": difference}
