"""What the throwing and catching classes share: an egg, its goal pose, the exponential reward of equations 1 to 5.

``OneEgg`` is the part that the four classes with one egg have in common; their files hold the figures.
"""

from collections.abc import Hashable
from typing import ClassVar

import mujoco
import torch
from torch import Tensor

from bidex_meta.hands.poses import HandPose
from bidex_meta.hands.starts import make_room, noisy_joints
from bidex_meta.tasks.base import LIGHT, TaskClass
from bidex_meta.tasks.goals import frozen_goal, observe_goal, rotation_difference
from bidex_meta.tasks.layout import goal_blocks, object_blocks
from bidex_meta.tasks.objects.held import EGG, HeldObject, held_object
from bidex_meta.tasks.scene import SceneObject
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace, box, join, orientation
from bidex_meta.utils.maths import conjugate, constant, norm, random_orientation, rotate, rotation_angle, wxyz, xyzw

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


def put_down(
    place: Tensor, held: HeldObject | None, draws: Tensor, noise: float, joints: Tensor | None, pose: HandPose
) -> None:
    """The start of an egg, in any orientation, or of what takes its place, on a broad side; clear of the hand.

    Args:
        place: Its positions (n, 7), written in place.
        held: What it is; None: an egg.
        draws: As of ``start_egg``.
        noise: Half width of the position noise, metres.
        joints: Joint angles (n, 24) of the hand that it lies on, written in place; None where it lies on none: what
            reaches further down than an egg then starts so much higher.
        pose: Start pose of that hand.
    """
    if held is None:
        start_egg(place, draws, noise)
        if joints is not None:
            lay_egg_on_hand(place, joints, pose)
        return
    place[:, :3] += noise * draws[:, :3]
    held.turn(place, draws[:, 3:], None if joints is None else pose)
    if joints is None:
        place[:, 2] += (held.depth_below(place) - HALF_LENGTH).clamp(min=0.0)
    else:
        held.lay_on_hand(place, joints, pose)


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


class OneEgg(TaskClass):
    """Throw an egg to a goal pose at the other hand.

    Attributes:
        egg_start: Nominal start of the egg, world, metres.
        goal_centre: Centre of the goals' box, world, metres.
        position_noise: Half width of the egg's position noise at a start, metres.
        joint_noise: Joint noise at a start, a share of each joint's range.
        lies_on_right_hand: Whether the egg starts on the right palm, so that room is made for it.
        alpha: Weight of the distance in the reward, per metre.
        floor: The episode fails when the egg's height falls to this, metres.
    """

    formula = "exp(-0.2 (50 d + r)), d and r the distance and the angle between egg and goal"
    solved = "egg within 3 cm of its goal"
    egg_start: ClassVar[tuple[float, float, float]]
    goal_centre: ClassVar[tuple[float, float, float]]
    position_noise: ClassVar[float]
    joint_noise: ClassVar[float]
    lies_on_right_hand: ClassVar[bool] = True
    alpha: ClassVar[float] = 50.0
    floor: ClassVar[float]
    start_draws: ClassVar[int] = JOINT_DRAWS + 5
    solver = LIGHT

    def __init__(self, moving_base: bool | None = None, object: str = EGG) -> None:
        """Chooses the base and the object: ``"egg"``, a name of the shelf, or an MJCF file (docs/objects.md).

        Raises:
            BidexError: There is no such object, or its file holds none for a hand.
        """
        super().__init__(moving_base)
        self.held = held_object(object)
        if self.held is not None:
            self.needs = self.held.needs(self.needs)

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        return (*super().scene_key, self.held)

    @property
    def variation_space(self) -> VariationSpace:
        """Goal position (world, metres) and the two draws of its orientation."""
        return join(box("goal", self.goal_centre, GOAL_RANGE), orientation("goal"))

    blocks = (*object_blocks("object", "object"), *goal_blocks("goal"))

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        if self.held is None:
            SceneObject("object", "egg", self.egg_start).add_to(scene)
        else:
            self.held.add_to(scene, "object", self.egg_start)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``goal``: the goal pose, (n, 7); ``goal_inverse``: the inverse of its rotation, (n, 4)."""
        return frozen_goal(goal_pose(variation[:, :3], variation[:, 3:]))

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        start_hands(draws[:, :JOINT_DRAWS], self.joint_noise, qpos)
        joints = qpos["right/joints"] if self.lies_on_right_hand else None
        put_down(qpos["object"], self.held, draws[:, JOINT_DRAWS:], self.position_noise, joints, self.right)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        return observe_goal(state, "object/quaternion")

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """``pose``: exp(-0.2 (alpha d_t + d_r))."""
        return {"pose": pose_reward(state, "object", "goal", self.alpha)}

    def success(self, state: TaskState) -> Tensor:
        return distances(state, "object", "goal")[0] < SUCCESS_DISTANCE

    def failed(self, state: TaskState) -> Tensor:
        """The egg dropped: the reward is positive throughout, so an early end is never worth seeking."""
        return state["object/position"][:, 2] <= self.floor

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        return [(frozen["goal"], SEMI_AXES if self.held is None else self.held.half_extents)]
