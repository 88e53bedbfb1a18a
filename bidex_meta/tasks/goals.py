"""Helpers for task classes with a goal pose: fixing it per task, observing it, and drawing it in pictures."""

from typing import NamedTuple

import torch
from torch import Tensor

from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import conjugate, multiply

GREEN = (0.25, 0.75, 0.40)
"""Colour of goals in pictures."""


class Ghost(NamedTuple):
    """A goal in pictures: a translucent ellipsoid."""

    pose: Tensor
    """Position (world, metres) and quaternion (x, y, z, w), (n, 7)."""
    size: tuple[float, float, float]
    """Semi-axes, metres."""
    colour: tuple[float, float, float] = GREEN
    """Red, green and blue in [0, 1]."""


def posed(position: Tensor, quaternion: Tensor) -> Tensor:
    """Return poses (n, 7) of positions (n, 3) and orientations (n, 4), which are quaternions (x, y, z, w)."""
    return torch.cat((position, quaternion), dim=1)


def frozen_goal(pose: Tensor, goal: str = "goal") -> dict[str, Tensor]:
    """Return a dict with the pose of a goal (n, 7) under its name, and the inverse rotation (n, 4) as ``NAME_inverse``.

    A pose is a position and a quaternion (x, y, z, w).
    """
    return {goal: pose, f"{goal}_inverse": conjugate(pose[:, 3:])}


def rotation_difference(state: TaskState, sensor: str, goal: str = "goal") -> Tensor:
    """Return a body's quaternion, which ``sensor`` measures, times the inverse quaternion of the body's goal.

    Quaternions (n, 4) are (x, y, z, w).
    """
    inverse = state.frozen[f"{goal}_inverse"]
    return state.once(("difference", sensor, goal), lambda: multiply(state.quaternion(sensor), inverse))


def observe_goal(state: TaskState, sensor: str, goal: str = "goal") -> dict[str, Tensor]:
    """Return the goal blocks of an observation for one body, by name.

    ``<goal>_pose`` (n, 7) is the goal's pose. ``<goal>_rotation_difference`` (n, 4) is the rotation from the goal to
    the body. ``sensor`` is the name of the sensor that measures the body's orientation.
    """
    difference = rotation_difference(state, sensor, goal)
    return {f"{goal}_pose": state.frozen[goal], f"{goal}_rotation_difference": difference}
