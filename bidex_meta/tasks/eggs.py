"""What the throwing and catching classes share: an egg, its goal pose, the exponential reward of equations 1 to 5."""

import torch
from torch import Tensor

from bidex_meta.hands.poses import HandPose
from bidex_meta.hands.starts import make_room, noisy_joints
from bidex_meta.maths import conjugate, constant, norm, random_orientation, rotate, rotation_angle, wxyz, xyzw
from bidex_meta.tasks.goals import rotation_difference
from bidex_meta.tasks.state import TaskState

RADIUS, HALF_LENGTH = 0.03, 0.04
"""Short and long semi-axis of the egg, metres (docs/figures.md, objects)."""
SEMI_AXES = (RADIUS, RADIUS, HALF_LENGTH)
JOINT_DRAWS = 24
SUCCESS_DISTANCE = 0.03
"""Object within this distance of its goal, metres."""
GOAL_RANGE = 0.03
"""Half width of the goals' box, metres."""


def goal_pose(position: Tensor, draws: Tensor) -> Tensor:
    """Pose (n, 7), position and quaternion (x, y, z, w), from positions (n, 3) and orientation draws (n, 2)."""
    return torch.cat((position, random_orientation(draws[:, 0], draws[:, 1])), dim=1)


def start_hands(draws: Tensor, noise: float, qpos: dict[str, Tensor]) -> None:
    """Gives both hands the same noisy joint angles (docs/figures.md, start noise). Draws in [-1, 1], shape (n, 24)."""
    joints = noisy_joints(draws, noise)
    qpos["right/joints"].copy_(joints)
    qpos["left/joints"].copy_(joints)


def start_egg(qpos: Tensor, draws: Tensor, noise: float) -> None:
    """Shifts an egg from its nominal start and turns it at random.

    Args:
        qpos: The egg's positions (n, 7), written in place.
        draws: Numbers in [-1, 1], shape (n, 5): three of position, two of orientation.
        noise: Half width of the position noise, metres.
    """
    qpos[:, :3] += noise * draws[:, :3]
    qpos[:, 3:] = wxyz(random_orientation(draws[:, 3], draws[:, 4]))


def lay_egg_on_hand(
    egg: Tensor, joints: Tensor, pose: HandPose, radius: float = RADIUS, half: float = HALF_LENGTH
) -> None:
    """Lifts an egg, or what a spheroid bounds, off the palm it lies on and opens the fingers that would stick in it.

    Args:
        egg: The egg's positions (n, 7), written in place.
        joints: That hand's joint angles (n, 24), written in place.
        pose: Start pose of that hand.
        radius: Short semi-axis, metres.
        half: Long semi-axis, metres.
    """
    quaternion = xyzw(constant(pose.quaternion, egg))
    inverse = conjugate(quaternion)
    position = rotate(inverse, egg[:, :3] - constant(pose.position, egg))
    axis = rotate(inverse, rotate(xyzw(egg[:, 3:]), constant((0.0, 0.0, 1.0), egg)))
    opened, shift = make_room(joints, position, axis, radius, half)
    joints.copy_(opened.float())
    egg[:, :3] += rotate(quaternion, shift).float()


def distances(state: TaskState, egg: str, goal: str) -> tuple[Tensor, Tensor]:
    """Distance (m) and rotation (rad in [0, pi]) between an egg and its goal, each (n,)."""
    target = state.frozen[goal]
    translation = state.once(("distance", egg), lambda: norm(state[f"{egg}/position"] - target[:, :3]))
    difference = rotation_difference(state, f"{egg}/quaternion", goal)
    return translation, state.once(("angle", egg), lambda: rotation_angle(difference))


def pose_reward(state: TaskState, egg: str, goal: str, alpha: float) -> Tensor:
    """exp(-0.2 (alpha d_t + d_r)), shape (n,)."""
    translation, rotation = distances(state, egg, goal)
    return torch.exp(-0.2 * (alpha * translation + rotation))
