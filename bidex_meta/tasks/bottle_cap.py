"""BottleCap: appendix A.2.9; docs/figures.md, classes."""

import math

from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.hand import hand
from bidex_meta.hands.poses import HandPose
from bidex_meta.tasks.base import FIRM
from bidex_meta.tasks.layout import object_blocks, point_block
from bidex_meta.tasks.objects.pointed import OwnObjectClass
from bidex_meta.tasks.placement import DRAWS, SHIFT, TURN, place
from bidex_meta.tasks.reach import apart
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace
from bidex_meta.utils.maths import constant, dot, indices

_TILT = 0.87
_PALM_NORMAL = (math.sin(_TILT), 0.0, math.cos(_TILT))
"""Out of the right palm at the start, world."""
_LIFT, _AHEAD = 0.006, 0.015
"""How far the bottle starts from the original's place, metres: along the palm's normal, since there it is in the hand,
and along the fingers, so that it can be turned without meeting the thumb."""
_AHEAD_RANGE = 0.01
_OPENED = 0.03
_THUMB = {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}
"""Joint angles at the start other than 0, rad (docs/figures.md, start noise)."""


class BottleCap(OwnObjectClass):
    """Pull the cap off a bottle that lies in the right hand, with the left.

    Observation: Table 24 (414). Reward: equation 11, left hand to cap and right hand to bottle as printed. The cap's
    point is its centre; the original measures from a link frame near the bottle's origin. Tasks shift the bottle in the
    palm's plane: 3 cm either way along its axis (``bottle_x``), and 1 cm to the fingers only (``bottle_y``), since the
    thumb is behind it.
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
    transition_scale, orientation_scale = 0.1, 0.1
    start_draws = DRAWS
    solver = FIRM
    table = Table((0.3, 0.3, 0.1), (0.0, -0.6, 0.05))
    objects = (
        SceneObject(
            "bottle",
            "bottle",
            (_LIFT * _PALM_NORMAL[0], -0.6 - _AHEAD, 0.5 + _LIFT * _PALM_NORMAL[2]),
            (0.0, -0.7, 0.0),
        ),
    )
    usual_stands = False
    points = ("bottle/cap_position", "bottle/position")
    constant = 0.2
    camera_target = (0.0, -0.62, 0.52)
    variation_space = VariationSpace(
        ("bottle_x", "bottle_y", "bottle_yaw"), (-SHIFT, -_AHEAD_RANGE, -TURN), (SHIFT, 0.0, TURN)
    )
    blocks = (
        *object_blocks("bottle"),
        point_block("bottle_cap_position", "bottle/cap_position", "centre of the cap"),
    )

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        for side in ("right", "left"):
            joints = qpos[f"{side}/joints"]
            joints[:, indices(hand().index(*_THUMB), joints)] = constant(tuple(_THUMB.values()), joints)
        bottle = qpos["bottle"]
        nominal, normal = bottle[:, :3].clone(), constant(_PALM_NORMAL, bottle)
        place(bottle, frozen["bottle"], draws)
        bottle[:, :3] -= dot(bottle[:, :3] - nominal, normal)[:, None] * normal

    def target(self, state: TaskState) -> Tensor:
        return 30.0 * apart(state, "bottle/position", "bottle/cap_position")

    def success(self, state: TaskState) -> Tensor:
        return state["bottle/slide"][:, 0] > _OPENED
