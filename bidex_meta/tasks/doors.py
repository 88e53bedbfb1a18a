"""Task classes with doors: four classes in which a double swing door is opened or closed.

Sources: A.2.7 and A.2.8 of the paper's appendix, and docs/figures.md, section Classes.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import mujoco
import torch
from torch import Tensor
from torch.nn.functional import pad

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.hand import SIDES
from bidex_meta.hands.poses import PALM_LEFT_AHEAD, PALM_RIGHT_AHEAD, HandPose
from bidex_meta.tasks.aligned import Error, Hidden, at_least, within
from bidex_meta.tasks.goals import Ghost, frozen_goal, posed
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks
from bidex_meta.tasks.reach import ReachTask, apart
from bidex_meta.tasks.scene import Point, SceneObject
from bidex_meta.tasks.solver import FAST
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace, component, join
from bidex_meta.tasks.words import degrees
from bidex_meta.utils.maths import constant, multiply, quaternion_from_rpy, rotate, xyzw

_BASE = (0.0, 0.0, 0.7)
_HINGES = ((-0.00846, 0.42653, 0.48329), (-0.0056, -0.42041, 0.48329))
"""Hinges of the right leaf (1) and left leaf (2) in the door's frame, metres. Leaf 1 turns about -z, leaf 2 about z."""
_PANELS, _PANEL_HALF = ((0.00696, -0.1993, -0.4647), (0.0041, 0.1971, -0.4647)), (0.0088, 0.22, 0.4625)
"""Centres of the panels in the leaves' frames, and their half sizes, metres."""
_HANDLES = ((0.04, -0.39, -0.5), (0.04, 0.39, -0.5))
"""Points that the hands must reach, in the leaves' frames, metres; x is negative for an Inward door."""
_POLE = (0.025, 0.025, 0.65)
"""Semi-axes of the goal in pictures, metres: a pole at the handle, visible above a leaf in front of it."""
_LEAST_SHARE = 0.1
"""Distance of each handle from the door's middle along y that success requires, metres. If only one leaf of an Inward
door opens, the handles are 0.497 m apart, and more than 0.5 m if the leaf is pushed against its stop, which yields."""
_SHUT_ANGLE = 0.1 * (0.5 * math.pi)
_DAMPED = "The hinges are damped by 10 N m s/rad, the original's by 1: so a door does not fly open at a bump."


class _Door(ReachTask):
    """Base of the four door classes, in which two hands open or close a double swing door.

    The leaf and the handle at +y belong to the right hand. A task fixes the door's position along y, and one start
    angle for both leaves. The goal block of the observation holds the pose of the door's base, which is also the
    object's pose. With wide variation, as in version 2, a task instead fixes the target angles of the right leaf (hinge
    1) and the left leaf (hinge 2), and every episode draws the door's position and the start angle. The goal block then
    holds both target angles, and how far each leaf is from its target angle.

    In version 1 the opening classes measure success along y, because a single leaf that is open by 1.26 rad already
    brings the handles 0.5 m apart in space. The Inward classes have the same door upside down, so that it swings
    towards the hands. The points that their hands must reach lie behind the pulls, which face the hands in these
    classes.
    """

    inward: ClassVar[bool]
    verb: ClassVar[str]
    episode_steps = 250
    right = HandPose((0.55, 0.2, 0.6), PALM_LEFT_AHEAD)
    left = HandPose((0.55, -0.2, 0.6), PALM_RIGHT_AHEAD)
    transition_scale = 0.5
    orientation_scale = 0.5
    start_draws = 0
    jittered_fixtures = ("object",)
    wide_solved = "each leaf within 0.15 rad of its angle"
    solver = FAST
    points = ("object/left_handle_position", "object/right_handle_position")
    constant = 0.2
    camera_target = (0.05, 0.0, 0.68)
    camera_distance = 2.0
    camera_angle = (125.0, -25.0)
    blocks = (
        *object_blocks("object"),
        *goal_blocks("goal"),
        *handle_blocks("object", "behind the right leaf's pull", "behind the left leaf's pull"),
    )

    def __init__(self, moving_base: bool | None = None) -> None:
        super().__init__(moving_base)
        # The door stands upright, or is turned upside down about y.
        self.objects = (SceneObject("object", "door", _BASE, (0.0, math.pi if self.inward else 0.0, 0.0)),)

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        self.objects[0].add_to(scene)
        if self.inward:
            for side, handle in zip(SIDES, self._handles, strict=True):
                scene.site(f"object/{side}_handle").pos = handle

    @property
    def _handles(self) -> list[Point]:
        return [(-x if self.inward else x, y, z) for x, y, z in _HANDLES]

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the pose of the door and the angles of its leaves.

        * ``goal``: pose of the door's base (n, 7); ``goal_inverse``: inverse of its rotation (n, 4).
        * ``angle``: start angle of both leaves (n, 1), rad.
        * ``leaves``: target angles of the right and the left leaf (n, 2), rad; only with wide variation (version 2).
        """
        position = constant(_BASE, variation).repeat(len(variation), 1)
        position[:, 1] += variation[:, 0]
        turn = xyzw(constant(quaternion_from_rpy(self.objects[0].rpy), variation)).expand(len(variation), 4)
        frozen = {**frozen_goal(torch.cat((position, turn), dim=1)), "angle": variation[:, 1:2]}
        return frozen | ({"leaves": variation[:, 2:4]} if self.rules.wide else {})

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        qpos["object"][:, :3] = frozen["goal"][:, :3]
        for leaf in (1, 2):
            qpos[f"object/hinge{leaf}"].copy_(frozen["angle"])

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        if not self.rules.wide:
            return super().observe(state)
        leaves = state.frozen["leaves"]
        missing = _hinges(state) - state.frozen["leaves"]
        return {"goal_pose": pad(leaves, (0, 5)), "goal_rotation_difference": pad(missing, (0, 2))}

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return tuple(Hidden((f"{side}_angle",), 0.15) for side in SIDES)
        return ()

    def errors(self, state: TaskState) -> list[Error]:
        if not self.rules.wide:
            return self.narrow_errors(state)
        return [Error(off, 0.15) for off in (_hinges(state) - state.frozen["leaves"]).abs().unbind(1)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goals to draw in pictures: the handles of leaves at their target angles.

        Without wide variation (version 1) there are no target angles, and the list is empty.
        """
        if not self.rules.wide:
            return []
        base = posed(state["object/position"], state.quaternion("object/quaternion"))
        angles = state.frozen["leaves"]
        handles = enumerate(self._handles)
        return [Ghost(_on_leaf(base, i, angles[:, i : i + 1], handle), _POLE) for i, handle in handles]

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if not self.rules.wide:
            return self.summary
        if goal is None:
            return f"{self.verb} both leaves of a double door to their goal angles"
        right, left = (degrees(goal[f"{side}_angle"]) for side in SIDES)
        return f"{self.verb} both leaves of a double door, the right one to {right} and the left one to {left} degrees"

    @abstractmethod
    def narrow_errors(self, state: TaskState) -> list[Error]:
        """Return the errors of a state for tasks that give the leaves no target angles (version 1)."""

    def success(self, state: TaskState) -> Tensor:
        return within(self.errors(state))


def _on_leaf(base: Tensor, leaf: int, angle: Tensor, point: Point) -> Tensor:
    """Return the poses (n, 7) of a point on a door leaf when the hinge is at an angle (n, 1), in radians.

    ``base`` holds the door's poses (n, 7); ``leaf`` is 0 for the right leaf and 1 for the left leaf. ``point`` is given
    in the leaf's frame, in metres. Quaternions are (x, y, z, w).
    """
    half = 0.5 * (angle if leaf else -angle)
    turn = multiply(base[:, 3:], torch.cat((torch.zeros_like(half), torch.zeros_like(half), half.sin(), half.cos()), 1))
    hinge = base[:, :3] + rotate(base[:, 3:], constant(_HINGES[leaf], base))
    return posed(hinge + rotate(turn, constant(point, base)), turn)


def _hinges(state: TaskState) -> Tensor:
    """Return the angles of both leaves, rad, (n, 2)."""
    return torch.cat([state[f"object/hinge{leaf}_angle"] for leaf in (1, 2)], dim=1)


class _Open(_Door):
    formula = "0.2 - d_left - d_right + 2 d, d between the two handles"
    solved = "handles more than 0.5 m apart along y, each at least 10 cm from the middle"
    deviations = (
        "Success requires both leaves to open; the original's (handles 0.5 m apart along y) needs only one.",
        _DAMPED,
    )
    variation_space = join(component("base_y", -0.05, 0.05), component("start_angle", 0.0, 0.15))
    wide_space = join(
        component("base_y", -0.08, 0.08),  # with larger shifts the handles would start in the hands
        component("start_angle", 0.0, 0.15),
        *(component(f"{side}_angle", 0.3, 1.4) for side in SIDES),
    )

    def target(self, state: TaskState) -> Tensor:
        return 2.0 * apart(state, *self.points)

    def _opening(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Return the distances of the right and the left handle from the middle along y, metres, each (n,)."""
        middle = state["object/position"][:, 1]
        right = state["object/right_handle_position"][:, 1] - middle
        return right, middle - state["object/left_handle_position"][:, 1]

    def narrow_errors(self, state: TaskState) -> list[Error]:
        right, left = self._opening(state)
        return [at_least(right + left, 0.5, 0.05), *(at_least(each, _LEAST_SHARE, 0.05) for each in (right, left))]

    def success(self, state: TaskState) -> Tensor:
        if self.rules.wide:
            return super().success(state)
        right, left = self._opening(state)
        return (right + left > 0.5) & (right > _LEAST_SHARE) & (left > _LEAST_SHARE)


def _closed_to(shift: float) -> VariationSpace:
    angles = (component(f"{side}_angle", 0.0, 1.0) for side in SIDES)
    return join(component("base_y", -shift, shift), component("start_angle", 1.3, 1.57), *angles)


class _Close(_Door):
    formula = "0.2 - d_left - d_right + 2 (1 - d), d between the two handles"
    solved = "both leaves within a tenth of their travel of shut"
    deviations = (
        "Success requires shut leaves; the original's (handles less than 0.5 m apart) accepts 60 degrees.",
        _DAMPED,
    )
    variation_space = join(component("base_y", -0.05, 0.05), component("start_angle", 1.3, 1.57))
    wide_space = _closed_to(0.15)

    def target(self, state: TaskState) -> Tensor:
        return 2.0 * (1.0 - apart(state, *self.points))

    def narrow_errors(self, state: TaskState) -> list[Error]:
        return [Error(angle.clamp(min=0.0), _SHUT_ANGLE) for angle in _hinges(state).unbind(1)]


class DoorOpenOutward(_Open):
    """Push a double door open.

    Observation: Table 20 of the paper's appendix, size (428). Reward: equation 7.
    """

    needs = Capacity(44, 0, 96)
    name = "DoorOpenOutward"
    summary = "Push a double door open"
    verb = "Push"
    inward = False


class DoorCloseInward(_Close):
    """Push shut a double door that is open towards the hands.

    Observation: Table 20 of the paper's appendix, size (428). Reward: equation 8. The hands start farther out than in
    the other door classes, next to the open leaves.
    """

    needs = Capacity(38, 0, 77)
    name = "DoorCloseInward"
    summary = "Push a double door shut that stands open towards the hands"
    verb = "Push"
    inward = True
    right = HandPose((0.9, 0.5, 0.6), PALM_LEFT_AHEAD)
    left = HandPose((0.9, -0.5, 0.6), PALM_RIGHT_AHEAD)
    camera_target = (0.3, 0.0, 0.65)
    camera_distance = 2.3
    wide_space = _closed_to(0.05)  # with larger angles the leaves would start in the hands

    def obstacles(self, qpos: dict[str, Tensor]) -> list[tuple[str, Tensor, Point]]:
        """Return a box around the panel of each leaf, because joint noise might push fingers into it.

        An open leaf ends next to the fingertips of its hand. ``TaskClass.obstacles`` describes the entries.
        """
        door = qpos["object"]
        base = posed(door[:, :3], xyzw(door[:, 3:]))
        panels = []
        for i, side in enumerate(SIDES):
            panels.append((side, _on_leaf(base, i, qpos[f"object/hinge{i + 1}"], _PANELS[i]), _PANEL_HALF))
        return panels


class DoorOpenInward(_Open):
    """Pull a double door open by its handles.

    Observation: Table 22 of the paper's appendix, size (428). Reward: equation 9.
    """

    needs = Capacity(40, 0, 88)
    name = "DoorOpenInward"
    summary = "Pull a double door open by its handles"
    verb = "Pull"
    inward = True


class DoorCloseOutward(_Close):
    """Pull shut, by its handles, a double door that is open away from the hands.

    Observation: Table 22 of the paper's appendix, size (428). Reward: equation 10.
    """

    needs = Capacity(37, 0, 98)
    name = "DoorCloseOutward"
    summary = "Pull a double door shut by its handles"
    verb = "Pull"
    inward = False
