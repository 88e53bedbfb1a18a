"""Task classes with a pot, a bottle and a cup: LiftUnderarm, BottleCap and SwingCup.

Sources: A.2.6, A.2.9 and A.2.11 of the paper's appendix, and docs/figures.md, section Classes.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import pad

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.hand import hand
from bidex_meta.hands.poses import PALM_LEFT_AHEAD, PALM_RIGHT_AHEAD, PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.aligned import Error, Hidden, at_least, within
from bidex_meta.tasks.goals import Ghost, frozen_goal, posed, rotation_difference
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks, point_block
from bidex_meta.tasks.objects.pointed import OwnObjectClass
from bidex_meta.tasks.placement import DRAWS, SHIFT, TURN, place, placed, yaw_quaternion
from bidex_meta.tasks.reach import apart
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.solver import FAST, FIRM
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace, component, join
from bidex_meta.tasks.words import centimetres, degrees
from bidex_meta.utils.maths import constant, dot, indices, multiply, norm, rotate, rotation_angle, uprightness, xyzw

_START = (0.0, -0.6, 0.465)


class LiftUnderarm(OwnObjectClass):
    """Lift a pot off a table by its two grips.

    Observation: Table 18 of the paper's appendix, size (428). Reward: equation 6.

    In version 1 the goal lies 25 to 45 cm above the start that the task gives the pot, and up to 5 cm to each side
    along x and y. It has the start's orientation, including yaw. In version 2 the goal varies more, and is relative to
    the class's nominal start instead, because every episode draws another start.

    The pot starts at rest on the table; at the height in the original Bi-DexHands it would start 1.5 cm inside the
    table. The friction is 3 between pot and table, and 2 between the pot's wall and a hand.
    """

    needs = Capacity(36, 4, 82)
    name = "LiftUnderarm"
    summary = "Lift a pot off a table by its two grips"
    formula = "0.2 - d_left - d_right + 3 (0.985 - d), d from the pot to its goal"
    solved = "pot within 5 cm of its goal and within 30 degrees of upright"
    deviations = (
        "Success also requires an upright pot; reward and the original's success depend only on its place.",
        "The pot's inertia follows from its shape (3 kg, lid 1 kg); the original's is far too large.",
    )
    episode_steps = 500
    right = HandPose((0.0, 0.05, 0.45), PALM_UP_AWAY)
    left = HandPose((0.0, -1.25, 0.45), PALM_UP_BACK)
    transition_scale = 0.25
    orientation_scale = 1.0
    start_draws = DRAWS
    solver = FAST
    table = Table((0.3, 0.3, 0.4), (0.0, -0.6, 0.2), friction=3.0)
    objects = (SceneObject("object", "pot", _START),)
    points = ("object/left_handle_position", "object/right_handle_position")
    constant = 0.2
    ghost = (0.12, 0.12, 0.06)
    camera_target = (0.0, -0.6, 0.55)
    camera_distance = 1.5
    _goal = (*(component(f"goal_{axis}", -0.05, 0.05) for axis in "xy"), component("goal_height", 0.25, 0.45))
    variation_space = join(placed("object"), *_goal)
    wide_space = join(
        placed("object"),  # the table is hardly wider than the pot
        *(component(f"goal_{axis}", -0.15, 0.15) for axis in "xy"),
        component("goal_height", 0.2, 0.5),
    )
    wide_solved = solved
    blocks = (
        *object_blocks("object"),
        *goal_blocks("goal"),
        *handle_blocks("object", "beside the grip at +y", "beside the grip at -y"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the place of the pot and its goal.

        * ``object``: shift and yaw of the pot from its nominal start (n, 3).
        * ``goal``: goal pose of the pot (n, 7); ``goal_inverse``: inverse of its rotation (n, 4).
        """
        placement = variation[:, :3]
        if self.rules.wide:
            placement = torch.zeros_like(placement)  # episodes draw the placement, so a goal must not depend on it
        start = torch.cat((placement[:, :2], torch.zeros_like(placement[:, :1])), dim=1) + constant(_START, placement)
        goal = torch.cat((start + variation[:, 3:], yaw_quaternion(placement[:, 2])), dim=1)
        return {"object": variation[:, :3], **frozen_goal(goal)}

    def target(self, state: TaskState) -> Tensor:
        return 3.0 * (0.985 - self._distance(state))

    def hides(self) -> tuple[Hidden, ...]:
        return (Hidden(("goal_x", "goal_y", "goal_height"), 0.05),)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None:
            return f"{self.summary}, to its goal"
        aside = centimetres(goal["goal_x"], goal["goal_y"])
        place = "the table's middle" if self.rules.wide else "its start"
        return f"{self.summary}, {centimetres(goal['goal_height'])} higher than it starts and {aside} from {place}"

    def errors(self, state: TaskState) -> list[Error]:
        return [Error(self._distance(state), 0.05)]

    def success(self, state: TaskState) -> Tensor:
        upright = uprightness(state.quaternion("object/quaternion")) > math.cos(math.radians(30.0))
        return (self._distance(state) < 0.05) & upright

    def _distance(self, state: TaskState) -> Tensor:
        return state.once("distance", lambda: norm(state["object/position"] - state.frozen["goal"][:, :3]))


_TILT = 0.87
_PALM_NORMAL = (math.sin(_TILT), 0.0, math.cos(_TILT))
"""Normal of the right palm at the start, pointing out of the palm, world."""
_LIFT, _AHEAD = 0.006, 0.015
"""Shift of the bottle's start from the original's place, metres: along the palm's normal, because the original's place
lies inside the hand, and along the fingers, so that the bottle can be turned without touching the thumb."""
_THUMB = {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}
"""Start angles of the joints that do not start at 0, rad (docs/figures.md, start noise)."""
_DISC = (0.1, 0.1, 0.003)
"""Semi-axes of the goal in pictures, metres: a disc about the cap, wider than the hand."""
_DROPPED = 0.25
"""Height below which the bottle no longer lies in the hand, metres: half of its start height."""


class BottleCap(OwnObjectClass):
    """Pull the cap off a bottle with the left hand, while the bottle lies in the right hand.

    Observation: Table 24 of the paper's appendix, size (414). Reward: equation 11. As printed, d_left is the distance
    from the left hand to the cap, and d_right the distance from the right hand to the bottle. The cap's point is its
    centre; the original measures from a link frame near the bottle's origin.

    The bottle's start is shifted in the palm's plane. Along the bottle's axis (``bottle_x``), the shift is at most 3 cm
    in both directions. Towards the fingers (``bottle_y``), it is at most 1 cm; the bottle is never shifted the other
    way, because the thumb is there.
    """

    needs = Capacity(47, 4, 65)
    name = "BottleCap"
    summary = "Hold a bottle in one hand and pull its cap off with the other"
    formula = "0.2 - d_left - d_right + 30 d, d between the cap's centre and the bottle's origin"
    solved = "cap more than 3 cm off"
    deviations = (
        "d is measured from the cap's centre: about 14 cm more than the original's.",
        "The hands' start poses are exchanged, so that the left hand starts over the cap.",
        "The bottle starts 6 mm off the palm and 15 mm ahead; tasks shift it to the fingers by 1 cm at most.",
    )
    episode_steps = 125
    right = HandPose((0.0, -0.25, 0.45), (0.0, _TILT, 0.0))
    left = HandPose((0.0, -1.05, 0.5), (0.5, math.pi, math.pi))
    transition_scale = 0.1
    orientation_scale = 0.1
    start_draws = DRAWS
    solver = FIRM
    table = Table((0.3, 0.3, 0.1), (0.0, -0.6, 0.05))
    _nominal = (_LIFT * _PALM_NORMAL[0], -0.6 - _AHEAD, 0.5 + _LIFT * _PALM_NORMAL[2])
    objects = (SceneObject("bottle", "bottle", _nominal, (0.0, -0.7, 0.0)),)
    usual_stands = False
    points = ("bottle/cap_position", "bottle/position")
    constant = 0.2
    camera_target = (0.0, -0.62, 0.52)
    variation_space = VariationSpace(("bottle_x", "bottle_y", "bottle_yaw"), (-SHIFT, -0.01, -TURN), (SHIFT, 0.0, TURN))
    wide_space = join(variation_space, component("cap_slide", 0.01, 0.06))  # the hand has no room for a longer slide
    wide_solved = "cap within 5 mm of where it shall stand out"
    wide_blocks = goal_blocks("goal")
    jittered_hands = ("left",)
    blocks = (*object_blocks("bottle"), point_block("bottle_cap_position", "bottle/cap_position", "centre of the cap"))

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the place of the bottle and, in version 2, the target of its cap.

        * ``bottle``: shift and yaw of the bottle from its nominal start (n, 3).
        * ``slide``: target travel of the cap along the bottle (n, 1), metres; only with wide variation (version 2).
        """
        return super().freeze(variation) | ({"slide": variation[:, 3:]} if self.rules.wide else {})

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Return the observation's goal blocks if the suite uses wide variation (version 2), otherwise an empty dict.

        ``goal_pose`` starts with the target travel of the cap, metres. ``goal_rotation_difference`` starts with the
        cap's present travel minus the target. All other entries of both blocks are 0.
        """
        if not self.rules.wide:
            return {}
        slide = state.frozen["slide"]
        return {
            "goal_pose": pad(slide, (0, 6)),
            "goal_rotation_difference": pad(state["bottle/slide"] - slide, (0, 3)),
        }

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return (Hidden(("cap_slide",), 0.005),)
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if not self.rules.wide:
            return self.summary
        distance = "its goal distance" if goal is None else centimetres(goal["cap_slide"])
        return f"Hold a bottle in one hand and pull its cap out by {distance} with the other"

    def errors(self, state: TaskState) -> list[Error]:
        slide = state["bottle/slide"][:, 0]
        if self.rules.wide:
            return [Error((slide - state.frozen["slide"][:, 0]).abs(), 0.005)]
        return [at_least(slide, 0.03, 0.005)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goal to draw in pictures: the place of the cap, on the bottle, at its target travel.

        Without wide variation (version 1) there is no target travel, and the list is empty.
        """
        if not self.rules.wide:
            return []
        turn = state.quaternion("bottle/quaternion")
        missing = pad(state.frozen["slide"] - state["bottle/slide"], (2, 0))
        return [Ghost(posed(state["bottle/cap_position"] + rotate(turn, missing), turn), _DISC)]

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        for side in ("right", "left"):
            joints = qpos[f"{side}/joints"]
            joints[:, indices(hand().index(*_THUMB), joints)] = constant(tuple(_THUMB.values()), joints)
        bottle = qpos["bottle"]
        nominal = bottle[:, :3].clone()
        normal = constant(_PALM_NORMAL, bottle)
        place(bottle, frozen["bottle"], draws)
        bottle[:, :3] -= dot(bottle[:, :3] - nominal, normal)[:, None] * normal

    def target(self, state: TaskState) -> Tensor:
        return 30.0 * apart(state, "bottle/position", "bottle/cap_position")

    def success(self, state: TaskState) -> Tensor:
        if self.rules.wide:
            return within(self.errors(state))
        return state["bottle/slide"][:, 0] > 0.03

    def failed(self, state: TaskState) -> Tensor:
        """Return whether the bottle fell out of the hand, shape (n,), bool.

        Without wide variation (version 1) the result is always False. A fallen bottle ends the episode, because on the
        table a fast spin may add energy to it.
        """
        dropped = state["bottle/position"][:, 2] < _DROPPED
        return dropped & self.rules.wide


_CUP = SceneObject("cup", "cup", (0.0, 0.0, 0.6845), (0.0, 0.0, 0.5 * math.pi))


class SwingCup(OwnObjectClass):
    """Turn a two-handled cup about the vertical axis, with one hand at each handle.

    Observation: Table 28 of the paper's appendix, size (428). Reward: equation 13.

    The goal's yaw is measured from the nominal start (yaw 90 degrees), not from the task's start yaw. In version 1 the
    goal is at least 72 degrees away from every start, so no start is a success. The original's goal, half a turn away,
    is one end of the range. The goal position is the task's start position in version 1, and the nominal start position
    in version 2. The reward does not read the goal position.
    """

    needs = Capacity(34, 4, 87)
    name = "SwingCup"
    summary = "Turn a two-handled cup with both hands"
    formula = "-1 - d_left - d_right + 5 / (r + 0.1), r the angle between the cup and its goal"
    solved = "cup within 45 degrees of its goal and within 20 cm of its start"
    deviations = (
        "Goals lie 90 to 180 degrees from the nominal start; the original's is half a turn away.",
        "Success requires the cup to stay near its start; reward and the original's success only count its turn.",
    )
    episode_steps = 300
    right = HandPose((0.35, 0.2, 0.8), PALM_LEFT_AHEAD)
    left = HandPose((0.35, -0.2, 0.8), PALM_RIGHT_AHEAD)
    transition_scale = 0.1
    orientation_scale = 0.1
    start_draws = DRAWS
    solver = FIRM
    table = Table((0.3, 0.3, 0.6), (0.0, 0.0, 0.3))
    objects = (_CUP,)
    points = ("cup/left_handle_position", "cup/right_handle_position")
    constant = -1.0
    ghost = (0.1, 0.012, 0.012)
    camera_target = (0.08, 0.0, 0.68)
    camera_angle = (20.0, -42.0)
    variation_space = join(placed("cup"), component("yaw_change", 0.5 * math.pi, math.pi))
    wide_space = join(placed("cup"), component("yaw_change", 0.25 * math.pi, math.pi))  # the table is small
    wide_solved = "cup within 8 degrees of its goal and within 20 cm of its nominal start"
    blocks = (
        *object_blocks("cup"),
        *goal_blocks("goal"),
        *handle_blocks("cup", "middle of the right hand's ear", "middle of the left hand's ear"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the place of the cup and its goal.

        * ``cup``: shift and yaw of the cup from its nominal start (n, 3).
        * ``goal``: goal pose of the cup (n, 7); ``goal_inverse``: inverse of its rotation (n, 4).
        """
        position = constant(_CUP.position, variation).repeat(len(variation), 1)
        if not self.rules.wide:
            position[:, :2] += variation[:, :2]
        rotation = multiply(yaw_quaternion(variation[:, 3]), xyzw(constant(_CUP.quaternion, variation)))
        return super().freeze(variation) | frozen_goal(torch.cat((position, rotation), dim=1))

    def target(self, state: TaskState) -> Tensor:
        return 5.0 / (_angle(state) + 0.1)

    def hides(self) -> tuple[Hidden, ...]:
        return (Hidden(("yaw_change",), math.radians(8.0) if self.rules.wide else 0.25 * math.pi),)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None:
            return f"{self.summary}, to its goal angle"
        return f"{self.summary}, by {degrees(goal['yaw_change'])} degrees counterclockwise"

    def errors(self, state: TaskState) -> list[Error]:
        return [Error(_angle(state), self.hides()[0].tolerance)]

    def success(self, state: TaskState) -> Tensor:
        moved = norm(state["cup/position"] - state.frozen["goal"][:, :3])
        return within(self.errors(state)) & (moved < 0.2)


def _angle(state: TaskState) -> Tensor:
    return state.once("angle", lambda: rotation_angle(rotation_difference(state, "cup/quaternion")))
