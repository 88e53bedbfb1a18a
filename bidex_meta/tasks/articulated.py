"""Task classes with articulated objects (A.2.12, A.2.14, A.2.15 of the paper's appendix; docs/figures.md, Classes)."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import mujoco
import torch
from torch import Tensor
from torch.nn.functional import pad

from bidex_meta.engine.capacity import Capacity
from bidex_meta.tasks.aligned import Error, Hidden, at_least, within
from bidex_meta.tasks.goals import Ghost, frozen_goal, posed
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, SHIFT, TURN, place, placed, yaw_quaternion
from bidex_meta.tasks.reach import ReachTask, apart
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.solver import FAST, THIN
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.tasks.words import centimetres, degrees
from bidex_meta.utils.maths import (
    conjugate,
    constant,
    multiply,
    norm,
    quaternion_from_rpy,
    quaternion_product,
    rotate,
    xyzw,
)

_SCISSORS = SceneObject("scissors", "scissors", (0.0, 0.0, 0.608), (0.0, 0.0, 0.5 * math.pi))
_PIVOT, _RIGHT_HANDLE = (-0.0034, 0.0698, 0.0), (0.1, -0.2, 0.0)
"""Position of the pivot on the left hand's half of the shears, and position of the right handle's point on the right
hand's half, relative to the pivot, metres (docs/figures.md, objects)."""


_SHUT = 0.59
"""Angle by which the shears are open when the hinge is at 0, rad. They are shut when the hinge is at minus this
angle."""


class OpenScissors(ReachTask):
    """Open a pair of shears to a given angle, with one hand at each loop; the shears lie on a table.

    Observation: Table 30 of the paper's appendix, size (428). Reward: equation 14. The equation does not give the
    target angle, so each task has its own.

    The hinge is at 0 rad when the shears are open by 34 degrees, and at -0.59 rad when they are shut, as at the start.
    Each hand has one half of the shears. The object pose in the observation is the pose of the left hand's half. The
    goal block shows the pose that the right handle has at the target angle if the left hand's half stays where it is.
    The goal block's rotation difference compares the right hand's half with this pose and so shows the missing angle.
    """

    needs = Capacity(57, 0, 131)
    name = "OpenScissors"
    summary = "Open shears to a given angle with both hands"
    formula = "2 - d_left - d_right + 5 (0.59 - r), r the angle between the hinge and its target"
    solved = "hinge within 0.1 rad of its target"
    deviations = ("The loops are hollow; the original's are filled.", "The goal block moves with the shears.")
    episode_steps = 150
    start_draws = DRAWS
    solver = THIN
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3))
    objects = (_SCISSORS,)
    points = ("scissors/left_handle_position", "scissors/right_handle_position")
    constant = 2.0
    camera_target = (0.08, 0.0, 0.66)
    camera_angle = (20.0, -42.0)
    variation_space = join(placed("scissors"), component("target_angle", -0.15, 0.3))
    wide_space = join(placed("scissors", 2 * SHIFT, 2 * TURN), component("target_angle", -0.15, 0.3))
    wide_solved = "hinge within 0.04 rad of its target"
    blocks = (
        *object_blocks("scissors"),
        *goal_blocks("goal"),
        *handle_blocks("scissors", "in the right hand's loop", "in the left hand's loop"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the place of the shears and the target angle of the hinge.

        * ``scissors``: shift and yaw of the shears from their nominal start (n, 3).
        * ``target``: target angle of the hinge (n, 1), rad; ``turn``: the same angle as a quaternion (n, 4) in the
          order (x, y, z, w).
        * ``ghost``: pose (n, 7) of the right handle at the target angle while the shears lie at the task's start.
        """
        root = constant((*_SCISSORS.position, *_SCISSORS.quaternion), variation).repeat(len(variation), 1)
        place(root, variation[:, :3])
        turn = yaw_quaternion(variation[:, 3])
        ghost = _opened(root[:, :3], xyzw(root[:, 3:]), turn)
        return {"scissors": variation[:, :3], "target": variation[:, 3:], "turn": turn, "ghost": ghost}

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        super().start(draws, frozen, qpos)
        qpos["scissors/hinge"].fill_(-_SHUT)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        rotation = state.quaternion("scissors/quaternion")
        goal = _opened(state["scissors/position"], rotation, state.frozen["turn"])
        missing = multiply(state.quaternion("scissors/half_quaternion"), conjugate(goal[:, 3:]))
        return {"goal_pose": goal, "goal_rotation_difference": missing}

    def target(self, state: TaskState) -> Tensor:
        return 5.0 * (_SHUT - _missing(state))

    def hides(self) -> tuple[Hidden, ...]:
        return (Hidden(("target_angle",), 0.04 if self.rules.wide else 0.1),)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None:
            return "Open shears to their goal angle with both hands"
        return f"Open shears to {degrees(_SHUT + goal['target_angle'])} degrees with both hands"

    def errors(self, state: TaskState) -> list[Error]:
        return [Error(_missing(state), self.hides()[0].tolerance)]

    def success(self, state: TaskState) -> Tensor:
        return within(self.errors(state))

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goal to draw in pictures: the right handle at the hinge's target angle.

        In suites with wide variation (version 2) the goal follows the shears as they move; otherwise it belongs to the
        place where the shears lie at the task's start.
        """
        if self.rules.wide:
            pose = self.observe(state)["goal_pose"]
        else:
            pose = state.frozen["ghost"]
        return [Ghost(pose, (0.02, 0.02, 0.01))]


def _opened(position: Tensor, rotation: Tensor, turn: Tensor) -> Tensor:
    """Return the pose (n, 7) that the shears' right handle has when the hinge is turned by ``turn``.

    ``position`` (n, 3) and ``rotation`` (n, 4) are the pose of the other half of the shears, the left hand's half.
    ``turn`` (n, 4), like all rotations here, is a quaternion (x, y, z, w).
    """
    opened = multiply(rotation, turn)
    pivot = position + rotate(rotation, constant(_PIVOT, position))
    return posed(pivot + rotate(opened, constant(_RIGHT_HANDLE, position)), opened)


def _missing(state: TaskState) -> Tensor:
    return state.once("missing", lambda: (state["scissors/angle"] - state.frozen["target"]).abs()[:, 0])


_PEN = SceneObject("pen", "pen", (0.0, 0.0, 0.612), (0.5 * math.pi, 0.5 * math.pi, 0.0))
_OPEN = 0.3
_GAP = 0.0125  # tolerance of version 2 in metres; with 2.5 cm one witness solved 12 % of the tasks
_BODY_POINT = 0.07
"""Position of the body point on the pen's axis, metres; the cap's point lies towards the other end."""


class OpenPenCap(ReachTask):
    """Pull the cap off a pen on a table; the left hand holds the pen's body, the right hand holds its cap.

    Observation: Table 34 of the paper's appendix, size (428). Reward: equation 16.

    In version 1 success requires the points on body and cap to be more than 0.3 m apart. At this distance the cap,
    which is 13 cm long, has been pulled by its own length. The goal position, for the cap's point, is 0.3 m from the
    place of the body's point at the task's start. The goal orientation is the pen's orientation at the task's start.
    Reward and success do not read this goal pose. With wide variation, as in version 2, each task has its own distance
    between the points instead of 0.3 m, and the pen starts at another place in every episode. The goal pose is then
    computed for a pen at the nominal place: it shows the distance, but not where the pen lies.
    """

    needs = Capacity(56, 0, 121)
    name = "OpenPenCap"
    summary = "Pull the cap off a pen"
    formula = "exp(-10 d_left) + exp(-10 d_right) + 5 d - 0.8, d between the points on body and cap"
    solved = "points on body and cap more than 0.3 m apart"
    deviations = ("The pen lies on flats; the original's rolls.",)
    episode_steps = 125
    start_draws = DRAWS
    solver = replace(THIN, integrator=mujoco.mjtIntegrator.mjINT_IMPLICIT)
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3))
    objects = (_PEN,)
    points = ("pen/body_position", "pen/cap_position")
    constant = -0.8
    exponential = True
    ghost = (0.012, 0.012, 0.012)
    camera_target = (0.12, 0.0, 0.66)
    camera_angle = (20.0, -42.0)
    variation_space = placed("pen")
    wide_space = join(placed("pen", 2 * SHIFT, 2 * TURN), component("gap", 0.2, 0.45))
    wide_solved = "points on body and cap within 1.25 cm of the gap between them"
    blocks = (
        *object_blocks("pen"),
        *goal_blocks("goal"),
        point_block("pen_body_position", "pen/body_position", "point on the pen's body for the left hand"),
        point_block("pen_cap_position", "pen/cap_position", "point on the pen's cap for the right hand"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the place of the pen and the goal of the cap.

        * ``pen``: shift and yaw of the pen from its nominal start (n, 3).
        * ``gap``: target distance between the points on body and cap (n, 1), metres.
        * ``goal``: goal pose of the cap (n, 7); ``goal_inverse``: inverse of its rotation (n, 4).
        """
        pen = constant((*_PEN.position, *_PEN.quaternion), variation).repeat(len(variation), 1)
        place(pen, variation[:, :3])
        rotation = xyzw(pen[:, 3:])
        if self.rules.wide:
            gap = variation[:, 3:]
        else:
            gap = torch.full_like(variation[:, :1], _OPEN)
        cap = pen[:, :3] + rotate(rotation, pad(_BODY_POINT - gap, (2, 0)))
        return {"pen": variation[:, :3], "gap": gap, **frozen_goal(torch.cat((cap, rotation), dim=1))}

    def target(self, state: TaskState) -> Tensor:
        return 5.0 * apart(state, *self.points)

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goal of the cap to draw in pictures.

        In suites with wide variation (version 2) the goal follows the pen's body as it moves; otherwise it stays where
        the task has put it.
        """
        if not self.rules.wide:
            return super().ghosts(state)
        pen = state.quaternion("pen/quaternion")
        cap = state["pen/body_position"] + rotate(pen, pad(-state.frozen["gap"], (2, 0)))
        return [Ghost(posed(cap, pen), (0.018, 0.018, 0.06))]

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return (Hidden(("gap",), _GAP),)
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if not self.rules.wide:
            return self.summary
        if goal is None:
            return f"{self.summary}, as far as its goal"
        return f"{self.summary} until the points on body and cap are {centimetres(goal['gap'])} apart"

    def errors(self, state: TaskState) -> list[Error]:
        gap = apart(state, *self.points)
        return [
            Error((gap - state.frozen["gap"][:, 0]).abs(), _GAP) if self.rules.wide else at_least(gap, _OPEN, 0.025)
        ]

    def success(self, state: TaskState) -> Tensor:
        if self.rules.wide:
            return within(self.errors(state))
        return apart(state, *self.points) > _OPEN


_FACE_UP = (math.pi, 0.5 * math.pi, 0.0)
_TRAVEL = 0.5585
_PRESSED = (-0.0241, -0.001, 0.0427)
"""Position of the button's point at full travel relative to the base, along the world's axes, metres. The hinge's
origin and the point then lie flush with the face."""
_PRESSED_QUATERNION = quaternion_product(quaternion_from_rpy(_FACE_UP), quaternion_from_rpy((0.0, _TRAVEL, 0.0)))
"""Orientation (w, x, y, z) of the rocker at full travel."""

_BAR = (0.005, 0.09, 0.005)
"""Semi-axes of the goal in pictures, metres: a bar across the button that reaches out of the housing."""


class Switch(ReachTask):
    """Press the buttons of two rocker switches, one with each hand.

    Observation: Table 36 of the paper's appendix, size (428). Reward: equation 17. The table is 0.5 x 1 m and 55 cm
    high.

    The button is the raised half of a rocker. Its point, which the hand must reach, lies on the button's surface, 3.5
    cm from the hinge. The target of the point is its position at the rocker's full travel. Switch 1 is at -y and
    belongs to the left hand. In the observation, the pose and velocity of switch 1 are those of its rocker, because the
    housing does not move. The goal block holds the target of switch 1's point, and the orientation of the rocker at
    full travel.

    A task shifts each housing by up to 3 cm along x and y, but does not turn it. With wide variation, as in version 2,
    a task instead gives a target angle to each rocker, and every episode shifts the housings by up to 9 cm. The goal
    block then holds both target angles, and the difference of each rocker's angle from its target.
    """

    needs = Capacity(36, 0, 90)
    name = "Switch"
    summary = "Press the buttons of two rocker switches"
    formula = "2 - d_left - d_right + 50 (1.4 - d), d the sum of both buttons' distances to where they are pressed"
    solved = "both rockers past 80 % of their travel"
    deviations = (
        "A button's target is its point at full travel; the original's is a height that it cannot reach.",
        "Tasks shift the housings, but do not turn them.",
    )
    episode_steps = 125
    start_draws = 0
    solver = FAST
    table = Table((0.5, 1.0, 0.55), (0.0, 0.0, 0.275))
    objects = (
        SceneObject("switch1", "switch", (0.0, -0.2, 0.65), _FACE_UP),
        SceneObject("switch2", "switch", (0.0, 0.2, 0.65), _FACE_UP),
    )
    points = ("switch1/button_position", "switch2/button_position")
    constant = 2.0
    camera_target = (0.08, 0.0, 0.70)
    camera_distance = 1.1
    camera_angle = (20.0, -42.0)
    variation_space = join(*(component(f"switch{i}_{axis}", -SHIFT, SHIFT) for i, axis in product((1, 2), "xy")))
    wide_space = join(
        *(component(f"switch{i}_{axis}", -3 * SHIFT, 3 * SHIFT) for i, axis in product((1, 2), "xy")),
        *(component(f"switch{i}_angle", 0.1, _TRAVEL) for i in (1, 2)),
    )
    wide_solved = "each rocker within 0.08 rad of its angle"
    jittered_fixtures = ("switch1", "switch2")
    blocks = (
        *object_blocks("switch1"),
        *goal_blocks("goal"),
        point_block("switch1_position", "switch1/button_position", "point on the rocker's proud half"),
        point_block("switch2_position", "switch2/button_position", "point on the rocker's proud half"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the places of the switches and the targets of their buttons.

        * ``switch1`` and ``switch2``: positions of the switches' bases (n, 3), world, metres.
        * ``goal1`` and ``goal2``: positions of the buttons' points at full travel (n, 3), world, metres.
        * ``goal``: pose of switch 1's button at full travel (n, 7); ``goal_inverse``: inverse of its rotation (n, 4).
        * ``angles``: target angles of both rockers (n, 2), rad; only with wide variation (version 2).
        """
        frozen = {}
        for i, switch in enumerate(self.objects, start=1):
            position = constant(switch.position, variation).repeat(len(variation), 1)
            position[:, :2] += variation[:, 2 * i - 2 : 2 * i]
            frozen |= {switch.name: position, f"goal{i}": position + constant(_PRESSED, variation)}
        turn = xyzw(constant(_PRESSED_QUATERNION, variation)).expand(len(variation), 4)
        if self.rules.wide:
            angles = {"angles": variation[:, 4:]}
        else:
            angles = {}
        return frozen | frozen_goal(torch.cat((frozen["goal1"], turn), dim=1)) | angles

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        for name in ("switch1", "switch2"):
            qpos[name][:, :3] = frozen[name]

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        if not self.rules.wide:
            return super().observe(state)
        angles = state.frozen["angles"]
        missing = _rockers(state) - angles
        return {"goal_pose": pad(angles, (0, 5)), "goal_rotation_difference": pad(missing, (0, 2))}

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return tuple(Hidden((f"switch{i}_angle",), 0.08) for i in (1, 2))
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if not self.rules.wide:
            return self.summary
        if goal is None:
            return "Press the buttons of two rocker switches to their goal angles"
        left, right = (degrees(goal[f"switch{i}_angle"]) for i in (1, 2))
        return f"Press the buttons of two rocker switches, the left one to {left} and the right one to {right} degrees"

    def errors(self, state: TaskState) -> list[Error]:
        rockers = _rockers(state)
        if self.rules.wide:
            return [Error(off, 0.08) for off in (rockers - state.frozen["angles"]).abs().unbind(1)]
        return [at_least(angle, 0.8 * _TRAVEL, 0.08) for angle in rockers.unbind(1)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return the goals to draw in pictures: the buttons at their target angles, or none without wide variation."""
        if not self.rules.wide:
            return []
        found = []
        for i, missing in enumerate((state.frozen["angles"] - _rockers(state)).split(1, dim=1), start=1):
            hinge = state[f"switch{i}/position"]
            rocker = state.quaternion(f"switch{i}/quaternion")
            half = 0.5 * missing
            turn = multiply(
                rocker, torch.cat((torch.zeros_like(half), half.sin(), torch.zeros_like(half), half.cos()), 1)
            )
            button = rotate(conjugate(rocker), state[f"switch{i}/button_position"] - hinge)
            found.append(Ghost(posed(hinge + rotate(turn, button), turn), _BAR))
        return found

    def target(self, state: TaskState) -> Tensor:
        goals = [state.frozen[f"goal{i}"] for i in (1, 2)]
        if self.rules.wide:  # every episode draws the places
            goals = [state[f"switch{i}/position"] + constant(_PRESSED, goals[0]) for i in (1, 2)]
        first, second = (norm(state[f"switch{i}/button_position"] - goal) for i, goal in enumerate(goals, start=1))
        return 50.0 * (1.4 - (first + second))

    def success(self, state: TaskState) -> Tensor:
        if self.rules.wide:
            return within(self.errors(state))
        return (_rockers(state) > 0.8 * _TRAVEL).all(dim=1)


def _rockers(state: TaskState) -> Tensor:
    """Return the angles of both rockers, rad, (n, 2)."""
    return torch.cat([state["switch1/angle"], state["switch2/angle"]], dim=1)
