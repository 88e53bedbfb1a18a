"""Common parts of the throwing classes: eggs, goal poses and the exponential reward of equations 1 to 5."""

from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import mujoco
import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.hands.poses import HandPose
from bidex_meta.hands.starts import make_room, noisy_joints
from bidex_meta.tasks.aligned import Error, Hidden, within
from bidex_meta.tasks.base import JITTER, JOINT_NOISE, TaskClass
from bidex_meta.tasks.goals import Ghost, frozen_goal, observe_goal, rotation_difference
from bidex_meta.tasks.layout import Block, goal_blocks, object_blocks
from bidex_meta.tasks.objects.held import EGG, HeldObject, held_object
from bidex_meta.tasks.scene import Point, SceneObject
from bidex_meta.tasks.solver import LIGHT
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace, box, join, orientation
from bidex_meta.tasks.words import centimetres
from bidex_meta.utils.maths import conjugate, constant, norm, random_orientation, rotate, rotation_angle, wxyz, xyzw

RADIUS, HALF_LENGTH = 0.03, 0.04
"""Short and long semi-axis of the egg, metres (docs/figures.md, objects)."""
SEMI_AXES = (RADIUS, RADIUS, HALF_LENGTH)
JOINT_DRAWS = 24


def goal_object_blocks(numbers: Iterable[str]) -> tuple[Block, ...]:
    """Return the observation blocks of each object and its goal.

    ``numbers`` holds the suffixes of the objects' names: ``""`` for a single ``object``, or ``"1"`` and ``"2"`` for
    ``object1`` and ``object2``.
    """
    blocks: list[Block] = []
    for i in numbers:
        blocks += (*object_blocks(f"object{i}"), *goal_blocks(f"goal{i}"))
    return tuple(blocks)


def observe_goals(state: TaskState, numbers: Iterable[str]) -> dict[str, Tensor]:
    """Return the goal blocks of an observation for several objects, by name.

    For each object these are the goal's pose (n, 7) and the rotation from the goal to the object (n, 4). ``numbers``
    holds the suffixes of the objects' names, as in ``goal_object_blocks``.
    """
    blocks: dict[str, Tensor] = {}
    for i in numbers:
        blocks |= observe_goal(state, f"object{i}/quaternion", f"goal{i}")
    return blocks


def goal_pose(position: Tensor, draws: Tensor) -> Tensor:
    """Return goal poses (n, 7) at positions (n, 3), with random orientations that ``draws`` (n, 2) in [-1, 1] select.

    A pose is a position and a quaternion (x, y, z, w). docs/figures.md, section Start noise, gives the formula.
    """
    return torch.cat((position, random_orientation(draws[:, 0], draws[:, 1])), dim=1)


def start_hands(draws: Tensor, noise: float, qpos: dict[str, Tensor]) -> None:
    """Give both hands the same noisy joint angles (docs/figures.md, start noise).

    ``draws`` are in [-1, 1], shape (n, 24); ``noise`` is a share of each joint's range.
    """
    joints = noisy_joints(draws, noise)
    qpos["right/joints"].copy_(joints)
    qpos["left/joints"].copy_(joints)


def start_egg(qpos: Tensor, draws: Tensor, noise: float) -> None:
    """Shift an egg (n, 7), in place, by up to ``noise`` (m) from its nominal start and turn it at random.

    The draws are in [-1, 1], shape (n, 5): three for position, two for orientation.
    """
    qpos[:, :3] += noise * draws[:, :3]
    qpos[:, 3:] = wxyz(random_orientation(draws[:, 3], draws[:, 4]))


def lay_egg_on_hand(
    egg: Tensor, joints: Tensor, pose: HandPose, radius: float = RADIUS, half: float = HALF_LENGTH
) -> None:
    """Lift an egg off the palm, and open the fingers, so that the egg does not penetrate the hand at the start.

    ``egg`` holds the egg's poses (n, 7), quaternion (w, x, y, z), and ``joints`` holds the hand's joint angles (n, 24),
    rad. Both are changed in place. The hand starts at ``pose``. ``radius`` and ``half`` are the short and the long
    semi-axis of the egg, or of the spheroid around another object, metres.
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
    """Write the start pose of an egg or another object, so that it does not penetrate the hand below.

    If ``held`` is None, the object is an egg, which gets any orientation. Otherwise the object is ``held``, which lies
    on a broad side. ``place`` (n, 7) holds the object's poses, and ``joints`` (n, 24) holds the hand's joint angles,
    rad; both are modified in place. The hand starts at ``pose``. If ``joints`` is None, there is no hand below the
    object. In this case an object that extends further below its origin than an egg starts higher by the difference.
    ``draws`` and ``noise`` are those of ``start_egg``.
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
    """Return the distance (m) and rotation (rad in [0, pi]) between an egg and its goal, each (n,)."""
    target = state.frozen[goal]
    translation = state.once(("distance", egg), lambda: norm(state[f"{egg}/position"] - target[:, :3]))
    difference = rotation_difference(state, f"{egg}/quaternion", goal)
    return translation, state.once(("angle", egg), lambda: rotation_angle(difference))


class EggTask(TaskClass):
    """The base of the throwing classes: throw each egg to a goal pose at the other hand.

    All goals of a task have the same orientation, and all eggs have the same range of start noise.

    Attributes:
        starts: Nominal start of each egg, world, metres. The first egg is on the right hand, the second on the left
            hand.
        goals: For each egg, the centre of the box from which tasks draw the egg's goal, world, metres.
        position_noise: Half width of the noise in the eggs' start positions, metres.
        joint_noise: Half width of the noise in the joint angles at the start, as a share of each joint's range.
        lies_on_hand: Whether eggs start on a palm, whose fingers then open to make room.
        alpha: Weight of the distance in the reward, per metre.
        floor: Height in metres; the episode fails when an egg is no higher than this.
        anchors: Fixed points (world, metres) by the name of a position sensor. The episode fails when the sensor's
            position is 0.1 m or more from the fixed point.
        numbers: Suffixes of the names of eggs and goals; one empty suffix for a single egg.
    """

    formula = "exp(-0.2 (50 d + r)), d and r the distance and the angle between egg and goal"
    solved = "egg within 3 cm of its goal"
    starts: ClassVar[tuple[Point, ...]]
    goals: ClassVar[tuple[Point, ...]]
    position_noise: ClassVar[float]
    joint_noise: ClassVar[float]
    lies_on_hand: ClassVar[bool] = True
    alpha: ClassVar[float] = 50.0
    floor: ClassVar[float]
    anchors: ClassVar[Mapping[str, Point]] = MappingProxyType({})
    start_draws: ClassVar[int] = JOINT_DRAWS + 5
    numbers: ClassVar[tuple[str, ...]] = ("",)
    blocks = goal_object_blocks(("",))
    solver = LIGHT

    def __init__(self, moving_base: bool | None = None, object: str = EGG) -> None:
        """Create the class with an egg or with another object that is thrown instead.

        ``object`` is ``"egg"``, the name of an object in the package, or the path of an MJCF file (docs/objects.md).
        ``moving_base`` says whether the hands' bases move; None takes the class's default. Raises BidexError if there
        is no such object, or if its file has no object that a hand can hold.
        """
        super().__init__(moving_base)
        self.variation_space = self._goals_within(0.03)
        self.wide_space = self._goals_within(0.06)
        self.held = held_object(object)
        self._thing = Path(object).stem.replace("_", " ")
        if self.held is not None:
            self.needs = self.held.needs(self.needs, len(self.starts))

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        return (*super().scene_key, self.held)

    def _goals_within(self, half: float) -> VariationSpace:
        """Return the space from which tasks draw the goals: one position per egg, and one orientation for all.

        Each coordinate is within ``half`` metres of the centre in ``goals``. The orientation is given by two draws in
        [-1, 1].
        """
        boxes = (box(f"goal{i}", centre, half) for i, centre in zip(self.numbers, self.goals, strict=True))
        return join(*boxes, orientation("goal"))

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        green = (0.45, 0.62, 0.30, 1.0)
        for i, position, colour in zip(self.numbers, self.starts, (None, green), strict=False):
            if self.held is None:
                SceneObject(f"object{i}", "egg", position, colour=colour).add_to(scene)
            else:
                self.held.add_to(scene, f"object{i}", position, colour)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: each egg's goal pose (n, 7), and the inverse of its rotation (n, 4).

        The keys are ``goal`` and ``goal_inverse``, or for two eggs ``goal1``, ``goal1_inverse``, ``goal2``,
        ``goal2_inverse``.
        """
        frozen = {}
        for k, i in enumerate(self.numbers):
            frozen |= frozen_goal(goal_pose(variation[:, 3 * k : 3 * k + 3], variation[:, -2:]), f"goal{i}")
        return frozen

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        jittered = self.rules.jittered
        noise = self.position_noise or JITTER * jittered
        start_hands(draws[:, :JOINT_DRAWS], self.joint_noise or JOINT_NOISE * jittered, qpos)
        for i, side, pose in zip(self.numbers, SIDES, (self.right, self.left), strict=False):
            if self.lies_on_hand:
                joints = qpos[f"{side}/joints"]
            else:
                joints = None
            put_down(qpos[f"object{i}"], self.held, draws[:, JOINT_DRAWS:], noise, joints, pose)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        return observe_goals(state, self.numbers)

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """Return one term (n,) per egg: exp(-0.2 (alpha d + r)), with d and r the distance and the angle to its goal.

        d is in metres, r in radians. The keys are ``pose``, or for two eggs ``pose1`` and ``pose2``.
        """
        terms = {}
        for i in self.numbers:
            translation, rotation = distances(state, f"object{i}", f"goal{i}")
            terms[f"pose{i}"] = torch.exp(-0.2 * (self.alpha * translation + rotation))
        return terms

    def hides(self) -> tuple[Hidden, ...]:
        return tuple(Hidden(tuple(f"goal{i}_{axis}" for axis in "xyz"), 0.03) for i in self.numbers)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        """Return the class's summary with the object and its goal position.

        The goal's orientation is left out, because success does not depend on it.
        """
        summary = self.summary
        if self.held is not None:
            summary = summary.replace("an egg", f"the {self._thing}").replace(
                "two eggs", f"two objects ({self._thing})"
            )
        alone = len(self.numbers) == 1
        if goal is None:
            place = "its goal" if alone else "their goals"
        else:
            points = [[goal[f"goal{i}_{axis}"] for axis in "xyz"] for i in self.numbers]
            place = " and ".join(centimetres(*point) for point in points)
        if not self.rules.wide:
            return f"{summary}, to {place}"
        held = "it" if alone else "them"
        return f"{summary}, and hold {held} at {place}"

    def errors(self, state: TaskState) -> list[Error]:
        return [Error(distances(state, f"object{i}", f"goal{i}")[0], 0.03) for i in self.numbers]

    def success(self, state: TaskState) -> Tensor:
        return within(self.errors(state))

    def failed(self, state: TaskState) -> Tensor:
        """Return whether the episode fails, shape (n,), bool: an egg dropped, or a hand left its anchor.

        All rewards are positive, so that a policy loses reward if an episode ends early.
        """
        ends = [state[f"object{i}/position"][:, 2] <= self.floor for i in self.numbers]
        for name, anchor in self.anchors.items():
            point = state[name]
            ends.append(norm(point - constant(anchor, point)) >= 0.1)
        return torch.stack(ends).any(dim=0)

    def ghosts(self, state: TaskState) -> list[Ghost]:
        if self.held is None:
            size = SEMI_AXES
        else:
            size = self.held.half_extents
        return [Ghost(state.frozen[f"goal{i}"], size) for i in self.numbers]
