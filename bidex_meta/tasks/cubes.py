"""Task classes with two cubes (the paper's appendix, A.2.10, A.2.13 and A.2.16; docs/figures.md, section Classes)."""

import math
from collections.abc import Mapping
from itertools import chain, product
from typing import ClassVar

import mujoco
import torch
from torch import Tensor
from torch.nn.functional import pad

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AWAY, PALM_DOWN_BACK, PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks import eggs
from bidex_meta.tasks.aligned import Error, Hidden, within
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.goals import GREEN, Ghost, frozen_goal, posed
from bidex_meta.tasks.layout import goal_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, SHIFT, TURN, placed
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import Point, SceneObject, Table
from bidex_meta.tasks.solver import FAST, FIRM
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join, orientation
from bidex_meta.tasks.words import centimetres, degrees
from bidex_meta.utils.maths import constant, multiply, norm, rotate, rotation_angle, wxyz, xyzw

_RED, _BLUE = (0.85, 0.43, 0.30), (0.24, 0.52, 0.74)
"""Colours of the first and of the second cube; the second cube keeps the colour of its file."""
_EDGE, _HALF = 0.05, (0.025, 0.025, 0.025)
"""Edge of a cube and its half sizes, metres."""
_RODS = (
    ((0.05, 0.0, 0.0), (0.05, 0.006, 0.006), (0.9, 0.1, 0.1)),
    ((0.0, 0.05, 0.0), (0.006, 0.05, 0.006), (0.1, 0.9, 0.1)),
    ((0.0, 0.0, 0.05), (0.006, 0.006, 0.05), (0.1, 0.1, 0.9)),
)
"""Middle and semi-axes, metres, and colour of rods along x, y and z that reach out of a cube."""


def _cubes(name: str, first: Point, second: Point) -> tuple[SceneObject, SceneObject]:
    """Return two cubes at positions in the world, metres; the first is red."""
    red = SceneObject(f"{name}1", "cube", first, colour=(*_RED, 1.0))
    return red, SceneObject(f"{name}2", "cube", second)


class _TwoBlocks(ReachTask):
    """Base of the classes in which two blocks on a table must be brought to their goal positions.

    A task fixes the goal positions ``goal1`` and ``goal2``, each (n, 3). The target term of the reward is ``weight``
    times (``widest`` - d), where d is the sum of both blocks' distances from their goals. Block 1 starts at -y and
    belongs to the left hand.
    """

    weight: ClassVar[float]
    widest: ClassVar[float]
    start_draws = 2 * DRAWS
    points = ("block1/position", "block2/position")
    terms = ("constant", "left", "right", "target")
    centres = tuple(point_block(f"block{i}_position", f"block{i}/position", f"centre of block {i}") for i in (1, 2))

    def distances(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Return the distances of the blocks to their goals, metres, each (n,)."""
        first, second = (norm(state[f"block{i}/position"] - state.frozen[f"goal{i}"]) for i in (1, 2))
        return first, second

    def off_by(self, state: TaskState, tolerance: float) -> list[Error]:
        """Return one error per block: its distance from its goal, with this tolerance, both in metres."""
        return [Error(distance, tolerance) for distance in self.distances(state)]

    def target(self, state: TaskState) -> Tensor:
        first, second = self.distances(state)
        return self.weight * (self.widest - (first + second))

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return both goals to draw in pictures: green, or with wide variation in the colours of their blocks."""
        if self.rules.wide:
            colours = (_RED, _BLUE)
        else:
            colours = (GREEN, GREEN)
        return [Ghost(_unturned(state.frozen[f"goal{i}"]), _HALF, colours[i - 1]) for i in (1, 2)]


def _unturned(position: Tensor) -> Tensor:
    """Return poses (n, 7) at positions (n, 3), without rotation."""
    return posed(position, constant((0.0, 0.0, 0.0, 1.0), position).expand(len(position), 4))


_PUSHED = ((-0.2, -0.2, 0.625), (-0.2, 0.2, 0.625))
"""Goals of PushBlock's blocks, metres; in version 2 these are the middles of the goals' ranges."""


class PushBlock(_TwoBlocks):
    """Push two blocks on a table to goals 20 cm away, one block with each hand.

    Observation: Table 26 of the paper's appendix, size (417). Reward: equation 12. The table is 1 x 1 m and 60 cm high.
    Its friction is the mean of 0.5, the original table's friction, and 1, the friction of hands and blocks. The
    observation of Table 26 does not show the goals. In version 1 the goals are therefore the same in all tasks, and a
    task shifts and turns the start of each block. With wide variation, as in version 2, tasks have different goals, and
    goal entries are appended to the observation.
    """

    needs = Capacity(38, 0, 103)
    name = "PushBlock"
    summary = "Push two blocks to their goals, one with each hand"
    formula = "2 - d_left - d_right + 5 (0.8 - d), d the sum of both blocks' distances to their goals"
    solved = "both blocks within 10 cm of their goals"
    deviations = (
        "The blocks start on the table, not in it; there is no half success for one block as in the original.",
    )
    episode_steps = 125
    solver = FAST
    table = Table((1.0, 1.0, 0.6), (0.0, 0.0, 0.3), friction=0.75, priority=1)
    objects = _cubes("block", (0.0, -0.2, 0.625), (0.0, 0.2, 0.625))
    constant = 2.0
    weight = 5.0
    widest = 0.8
    camera_target = (0.1, 0.0, 0.68)
    camera_distance = 1.7
    camera_angle = (20.0, -42.0)
    variation_space = join(placed("block1"), placed("block2"))
    wide_space = join(
        *(placed(f"block{i}", 3 * SHIFT, 3 * TURN) for i in (1, 2)),
        *(component(f"goal{i}_{axis}", -0.15, 0.15) for i, axis in product((1, 2), "xy")),
    )
    wide_solved = "both blocks within 5 cm of their goals"
    wide_blocks = goal_blocks("goal")
    blocks = (*object_blocks("block1"), *_TwoBlocks.centres)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes, each (n, 3): the places of the blocks and their goals.

        ``block1`` and ``block2`` are shift and yaw from the nominal start. ``goal1`` and ``goal2`` are goal positions,
        world, metres.
        """
        first, second = (constant(goal, variation).expand(len(variation), 3) for goal in _PUSHED)
        if self.rules.wide:
            first = first + pad(variation[:, 6:8], (0, 1))
            second = second + pad(variation[:, 8:], (0, 1))
        return super().freeze(variation) | {"goal1": first, "goal2": second}

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Return the observation's goal blocks, with both goal positions; an empty dict without wide variation."""
        if not self.rules.wide:
            return {}
        goals = torch.cat((state.frozen["goal1"], state.frozen["goal2"]), dim=1)
        return {"goal_pose": pad(goals, (0, 1)), "goal_rotation_difference": torch.zeros_like(goals[:, :4])}

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return tuple(Hidden((f"goal{i}_x", f"goal{i}_y"), 0.05) for i in (1, 2))
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None or not self.rules.wide:
            return self.summary
        places = []
        for i, (x, y, _) in enumerate(_PUSHED, start=1):
            places.append(centimetres(x + goal[f"goal{i}_x"], y + goal[f"goal{i}_y"]))
        return f"Push the red block to {places[0]} and the blue one to {places[1]}, one with each hand"

    def errors(self, state: TaskState) -> list[Error]:
        return self.off_by(state, 0.05 if self.rules.wide else 0.1)

    def success(self, state: TaskState) -> Tensor:
        if self.rules.wide:
            return within(self.errors(state))
        first, second = self.distances(state)
        return (first <= 0.1) & (second <= 0.1)


class StackBlock(_TwoBlocks):
    """Stack two blocks: the left hand's block 1 on the right hand's block 2.

    Observation: Table 38 of the paper's appendix, size (428). Reward: equation 18. The table is 0.5 x 1 m and 60 cm
    high. The goal entries show target 1, the pose of the top block. This pose is upright with yaw 0, but the reward
    does not depend on rotations. For success each block must be within 3 cm of its target, and block 1 must be on block
    2. That means that block 1 is one edge length higher, within 1 cm, and within 3 cm of the vertical through block 2's
    centre.

    A task shifts and turns both blocks, and shifts the targets by up to 3 cm along x and y. With wide variation, as in
    version 2, a task only shifts the targets, by up to 9 cm, and chooses which block must be on top.

    The original's friction is 0.25 for blocks, 0.5 for hands and 0.2 for the table, and a pair has the mean of both.
    Here a block has 0.375 and the table 0.225, which are the means for hand and block, and for block and table
    (docs/figures.md, section Friction).
    """

    needs = Capacity(43, 0, 115)
    name = "StackBlock"
    summary = "Stack two blocks at a given place"
    formula = "1.5 - d_left - d_right + 2 (0.24 - d), d the sum of both blocks' distances to their targets"
    solved = "both blocks within 3 cm of their targets, block 1 on block 2"
    deviations = (
        "Friction between blocks is 0.375 instead of 0.25; between hand and table it is 0.225 instead of 0.35.",
    )
    episode_steps = 250
    right = HandPose((0.0, 0.6, 0.7), PALM_DOWN_AWAY)
    left = HandPose((0.0, -0.6, 0.7), PALM_DOWN_BACK)
    transition_scale = 0.2
    orientation_scale = 0.02
    solver = FIRM
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3), friction=0.225, priority=2)
    objects = _cubes("block", (0.0, -0.1, 0.625), (0.0, 0.1, 0.625))
    constant = 1.5
    weight = 2.0
    widest = 0.24
    camera_target = (0.0, 0.0, 0.66)
    camera_distance = 1.5
    variation_space = join(
        placed("block1"), placed("block2"), *(component(f"target_{axis}", -0.03, 0.03) for axis in "xy")
    )
    wide_space = join(
        placed("block1"),  # with larger shifts the blocks would touch
        placed("block2"),
        *(component(f"target_{axis}", -0.09, 0.09) for axis in "xy"),
        component("order", -1.0, 1.0),
    )
    wide_solved = "both blocks within 3 cm of their targets, block 1 on block 2, or the other way for a negative order"
    blocks = (*object_blocks("block1"), *goal_blocks("goal"), *_TwoBlocks.centres)

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        super().add_objects(scene)
        for block in self.objects:
            cube = scene.geom(f"{block.name}/cube")
            cube.friction[0] = 0.375
            cube.priority = 1

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the places of the blocks and their targets.

        * ``block1`` and ``block2``: shift and yaw from the nominal start (n, 3); ``goal1`` and ``goal2``: target
          positions (n, 3).
        * ``goal``: target pose of the top block (n, 7); only without wide variation (version 1).
        * ``upper`` (n, 1): 1 if block 1 must be on top, -1 if block 2 must; only with wide variation (version 2).
        """
        shift = torch.cat((variation[:, 6:8], torch.zeros_like(variation[:, :1])), dim=1)
        bottom = shift + constant((0.0, 0.0, 0.625), shift)
        top = bottom + constant((0.0, 0.0, _EDGE), shift)
        frozen = super().freeze(variation)
        if not self.rules.wide:
            return frozen | {"goal1": top, "goal2": bottom, "goal": _unturned(top)}
        upper = 1.0 - 2.0 * (variation[:, 8:] < 0.0).to(variation.dtype)
        first = torch.where(upper > 0.0, top, bottom)
        second = torch.where(upper > 0.0, bottom, top)
        return frozen | {"goal1": first, "goal2": second, "upper": upper}

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Return the observation's goal blocks, which show target 1 and the orientation of block 1.

        With wide variation (version 2) they hold the target positions of both blocks, and zeros.
        """
        if self.rules.wide:
            goals = torch.cat((state.frozen["goal1"], state.frozen["goal2"]), dim=1)
            return {"goal_pose": pad(goals, (0, 1)), "goal_rotation_difference": torch.zeros_like(goals[:, :4])}
        return {"goal_pose": state.frozen["goal"], "goal_rotation_difference": state.quaternion("block1/quaternion")}

    def hides(self) -> tuple[Hidden, ...]:
        target = Hidden(("target_x", "target_y"), 0.03)
        if self.rules.wide:
            return (target, Hidden(("order",), math.inf, "sign"))
        return (target,)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None and self.rules.wide:
            return "Stack two blocks in their goal order at their goal"
        order = "the red block on the blue one"
        if goal is None:
            return f"Stack {order} at their goal"
        if goal.get("order", 1.0) < 0.0:
            order = "the blue block on the red one"
        return f"Stack {order} at {centimetres(goal['target_x'], goal['target_y'])}"

    def errors(self, state: TaskState) -> list[Error]:
        return self.off_by(state, 0.03)

    def success(self, state: TaskState) -> Tensor:
        first, second = self.distances(state)
        x, y, z = (state["block1/position"] - state["block2/position"]).unbind(1)
        if self.rules.wide:
            z = z * state.frozen["upper"][:, 0]
        stacked = ((z - _EDGE).abs() < 0.01) & ((x * x + y * y).sqrt() < 0.03)
        return (first < 0.03) & (second < 0.03) & stacked


class ReOrientation(TaskClass):
    """Turn the two cubes that lie on the hands to one common orientation.

    Observation: Table 32 of the paper's appendix, size (446). Reward: equation 15, with the angles subtracted. There is
    no table. Cube 1 (``object1``) lies on the left hand (-y), because the reward formula pairs it with this hand; in
    the original it lies on the right hand. The bases move, as the appendix says (52 actions), and have the scales of
    CatchUnderarm. No episode ends early, because the reward is negative and an early end would increase the return.
    Both cubes start with the same random orientation, 10 cm above the mounts of the hands, and drop onto the palms. If
    the start noise would push a finger into the bounding sphere of a cube, the finger is opened.
    """

    needs = Capacity(26, 0, 67)
    name = "ReOrientation"
    summary = "Turn two cubes on the hands to a given orientation"
    formula = "-10 (d1 + d2) - 1.5 (r1 + r2), distance and angle of each cube and its goal"
    solved = "both cubes within 0.2 rad of the goal's orientation, each within 10 cm of its place"
    deviations = (
        "The printed formula adds the angles, which would reward larger ones; here they are subtracted.",
        "A goal lasts for the episode; the original draws a new one when it is reached.",
        "Success requires turn and place of both cubes; the original's only the turn of the second cube.",
        "A start within 0.5 rad of the goal is turned by half a turn: about 2 % of the starts depend on the goal.",
    )
    episode_steps = 600
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale = 0.05
    orientation_scale = 0.5
    start_draws = eggs.JOINT_DRAWS + 5
    solver = FIRM
    objects = _cubes("object", (0.0, -0.76, 0.60), (0.0, -0.39, 0.60))
    variation_space = wide_space = orientation("goal")
    wide_solved = solved
    blocks = eggs.goal_object_blocks("12")

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        for cube in self.objects:
            cube.add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the goal poses ``goal1`` and ``goal2`` (n, 7), and the inverses of their rotations (n, 4).

        The keys of the inverses are ``goal1_inverse`` and ``goal2_inverse``.
        """
        frozen = {}
        for i, centre in enumerate(((0.0, -0.76, 0.56), (0.0, -0.39, 0.56)), start=1):
            position = constant(centre, variation).expand(len(variation), 3)
            frozen |= frozen_goal(eggs.goal_pose(position, variation), f"goal{i}")
        return frozen

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        eggs.start_hands(draws[:, : eggs.JOINT_DRAWS], 0.2, qpos)
        radius = 0.0434  # half the space diagonal of a cube, in metres
        for i, side, pose in ((1, "left", self.left), (2, "right", self.right)):
            cube = qpos[f"object{i}"]
            eggs.start_egg(cube, draws[:, eggs.JOINT_DRAWS :], 0.01)
            if not self.rules.wide:  # in version 2, the start would reveal something about the hidden goal
                _turn_away(cube, frozen[f"goal{i}_inverse"])
            eggs.lay_egg_on_hand(cube, qpos[f"{side}/joints"], pose, radius, radius)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        return eggs.observe_goals(state, "12")

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        (first, first_angle), (second, second_angle) = self._distances(state)
        return {"left": -10.0 * first, "right": -10.0 * second, "target": -1.5 * (first_angle + second_angle)}

    def hides(self) -> tuple[Hidden, ...]:
        return (Hidden(("goal_u0", "goal_u1"), 0.2, "orientation"),)

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        if goal is None:
            return "Turn two cubes on the hands to their goal orientation"
        about_x, about_y = (degrees(math.pi * goal[f"goal_u{i}"]) for i in (0, 1))
        turn = f"{about_x} degrees about x after {about_y} degrees about y"
        return f"Turn two cubes on the hands to the orientation of a turn by {turn}"

    def errors(self, state: TaskState) -> list[Error]:
        return [Error(angle, 0.2) for _, angle in self._distances(state)]

    def success(self, state: TaskState) -> Tensor:
        (first, first_angle), (second, second_angle) = self._distances(state)
        return (first_angle < 0.2) & (second_angle < 0.2) & (first < 0.1) & (second < 0.1)

    def _distances(self, state: TaskState) -> list[tuple[Tensor, Tensor]]:
        """Return per cube the distance (m) and rotation (rad) to its goal, each (n,)."""
        return [eggs.distances(state, f"object{i}", f"goal{i}") for i in (1, 2)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        """Return both goals to draw in pictures: ellipsoids, or rods along the goals' axes if variation is wide."""
        goals = [state.frozen[f"goal{i}"] for i in (1, 2)]
        if not self.rules.wide:
            return [Ghost(goal, _HALF) for goal in goals]
        return list(chain.from_iterable(map(_axes, goals)))


def _axes(goal: Tensor) -> list[Ghost]:
    """Return three rods that start at a pose (n, 7) and follow its axes."""
    rods = []
    for middle, size, colour in _RODS:
        centre = goal[:, :3] + rotate(goal[:, 3:], constant(middle, goal))
        rods.append(Ghost(posed(centre, goal[:, 3:]), size, colour))
    return rods


def _turn_away(cube: Tensor, goal_inverse: Tensor) -> None:
    """Rotate cubes, in place, by 180 degrees about the world's x if they start too near their goal's orientation.

    "Too near" means within 0.5 rad. ``cube`` holds poses (n, 7); ``goal_inverse`` holds the inverses of the goals'
    orientations (n, 4).
    """
    now = xyzw(cube[:, 3:])
    near = rotation_angle(multiply(now, goal_inverse)) < 0.5
    turned = multiply(constant((1.0, 0.0, 0.0, 0.0), now).expand_as(now), now)
    cube[:, 3:] = wxyz(torch.where(near[:, None], turned, now))
