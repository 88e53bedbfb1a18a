"""Task classes with a bucket: GraspAndPlace and PourWater.

Sources: A.2.17 of the paper's appendix for PourWater, and docs/figures.md. For GraspAndPlace the appendix has only a
picture and one line.
"""

import math
from collections.abc import Mapping

import mujoco
import torch
from torch import Tensor
from torch.nn.functional import pad

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_LEFT_AHEAD, PALM_RIGHT_AHEAD, HandPose
from bidex_meta.tasks.aligned import Error, Hidden, at_least, within
from bidex_meta.tasks.goals import Ghost, frozen_goal, posed
from bidex_meta.tasks.layout import Block, goal_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, SHIFT, TURN, placed, yaw_quaternion
from bidex_meta.tasks.reach import ReachTask, apart
from bidex_meta.tasks.scene import Point, SceneObject, Table
from bidex_meta.tasks.solver import FAST, THIN
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.tasks.words import centimetres
from bidex_meta.utils.maths import conjugate, constant, multiply, norm, quaternion_from_rpy, rotate, uprightness, xyzw
from bidex_meta.utils.validation import whole_number

FLOOR, MOUTH, RIM = -0.049, 0.0345, 0.0445
"""Heights of the inner floor, the site ``mouth`` and the rim in the frame of assets/objects/bucket.xml, metres."""
_FLOOR_RADIUS, _RIM_RADIUS = 0.0255, 0.053
"""Inner radius at the floor and at the rim, to the middle of a wall, metres."""


def inside_bucket(points: Tensor, bucket: Tensor, quaternion: Tensor) -> Tensor:
    """Return whether points lie in a bucket, between its floor and rim and within its wall. Shape (n, k), bool.

    ``points`` (n, k, 3) and the buckets' origins ``bucket`` (n, 3) are in the world frame, metres. ``quaternion``
    (n, 4) holds the buckets' orientations (x, y, z, w).
    """
    x, y, z = rotate(conjugate(quaternion)[:, None], points - bucket[:, None]).unbind(-1)
    share = (z - FLOOR) / (RIM - FLOOR)
    radius = _FLOOR_RADIUS + (_RIM_RADIUS - _FLOOR_RADIUS) * share
    return (share > 0.0) & (share < 1.0) & ((x * x + y * y).sqrt() < radius)


def stands(quaternion: Tensor) -> Tensor:
    """Return whether buckets are within 45 degrees of upright, shape (n,), bool.

    ``quaternion`` (n, 4) holds the buckets' orientations (x, y, z, w).
    """
    return uprightness(quaternion) > math.cos(math.radians(45.0))


_TURN = "quaternion (x, y, z, w), world frame"


class GraspAndPlace(ReachTask):
    """Put a block into a bucket: the left hand takes the block, the right hand takes the bucket.

    The appendix has no table for this class. The observation, size (425), is therefore that of the original code,
    Bi-DexHands (docs/figures.md, section Observation). The reward is the original's formula, with distances from the
    hands' points (section Hand point). In the original, success requires that bucket and block are less than 20 cm
    apart, so a block next to the bucket is enough. Here the block must be in the upright bucket.

    A task shifts and turns bucket and block. Both start on the table, which is 1 x 1 m and 60 cm high; in the original
    they start inside the table. Here the bucket and the bucket's link have the same orientation, so the observation's
    entries 401-404 and 414-417 are equal.
    """

    needs = Capacity(35, 4, 108)
    name = "GraspAndPlace"
    summary = "Put a block into a bucket"
    formula = "exp(-10 d_left) + exp(-10 d_right) + 2 exp(-10 d), d between bucket and block"
    solved = "the block's centre is inside the bucket, which is within 45 degrees of upright"
    deviations = (
        "Success requires the block in the upright bucket; the original's requires it within 20 cm of the bucket.",
    )
    episode_steps = 500
    start_draws = 2 * DRAWS
    solver = FAST
    table = Table((1.0, 1.0, 0.6), (0.0, 0.0, 0.3))
    objects = (
        SceneObject("bucket", "bucket", (0.0, 0.2, 0.657)),
        SceneObject("block", "cube", (0.0, -0.2, 0.625), colour=(0.85, 0.43, 0.30, 1.0)),
    )
    points = ("block/position", "bucket/position")
    exponential = True
    terms = ("left", "right", "target")
    camera_target = (0.1, 0.0, 0.68)
    camera_distance = 1.7
    camera_angle = (20.0, -42.0)
    variation_space = join(placed("bucket"), placed("block"))
    wide_space = join(
        placed("bucket", 3 * SHIFT, 3 * TURN),
        placed("block", 3 * SHIFT, 3 * TURN),
        *(component(f"goal_{axis}", -0.12, 0.12) for axis in "xy"),
    )
    wide_solved = f"{solved} and within 4 cm of its goal"
    wide_blocks = goal_blocks("goal")
    blocks = (
        *object_blocks("bucket"),
        point_block("bucket_position", "bucket/position", "origin of the bucket"),
        Block("bucket_link_quaternion", 4, ("bucket/quaternion",), description=_TURN),
        point_block("block_position", "block/position", "centre of the block"),
        Block("block_quaternion", 4, ("block/quaternion",), description=_TURN),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the places of the objects and, in version 2, the bucket's goal.

        * ``bucket`` and ``block``: shift and yaw from the nominal start (n, 3) each.
        * ``goal``: goal pose of the bucket (n, 7); ``goal_inverse``: inverse of its rotation (n, 4); only with wide
          variation (version 2).
        """
        return super().freeze(variation) | _bucket_goal(variation[:, 6:], self.objects[0])

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return (Hidden(("goal_x", "goal_y"), 0.04),)
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        return self.summary + _bucket_words(goal, self.objects[0], self.rules.wide)

    def errors(self, state: TaskState) -> list[Error]:
        inside = Error(apart(state, "bucket/position", "block/position"), 0.04)
        return [inside, *_bucket_error(state)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        return _bucket_ghosts(state)

    def target(self, state: TaskState) -> Tensor:
        return 2.0 * torch.exp(-10.0 * apart(state, "bucket/position", "block/position"))

    def success(self, state: TaskState) -> Tensor:
        block = state["block/position"][:, None]
        turn = state.quaternion("bucket/quaternion")
        inside = inside_bucket(block, state["bucket/position"], turn)[:, 0] & stands(turn)
        if self.rules.wide:
            return inside & within(_bucket_error(state))
        return inside


def _bucket_goal(shift: Tensor, bucket: SceneObject) -> dict[str, Tensor]:
    """Return a dict with the bucket's goal pose, or an empty dict if tasks have no such goal.

    The goal pose ``goal`` (n, 7) is upright, at the bucket's nominal position moved by ``shift`` (n, 2), metres.
    ``goal_inverse`` (n, 4) is the inverse of its rotation. If ``shift`` is empty, (n, 0), tasks have no such goal.
    """
    if not shift.shape[1]:
        return {}
    position = pad(shift, (0, 1)) + constant(bucket.position, shift)
    return frozen_goal(torch.cat((position, constant((0.0, 0.0, 0.0, 1.0), shift).expand(len(shift), 4)), dim=1))


def _bucket_error(state: TaskState) -> list[Error]:
    """Return a list with the bucket's distance from its goal; the list is empty if the bucket has no goal."""
    goal = state.frozen.get("goal")
    if goal is None:
        return []
    return [Error(norm(state["bucket/position"] - goal[:, :3]), 0.04)]


def _bucket_ghosts(state: TaskState) -> list[Ghost]:
    """Return a list with the bucket's goal; the list is empty if the bucket has no goal."""
    goal = state.frozen.get("goal")
    if goal is None:
        return []
    return [Ghost(goal, (0.065, 0.065, 0.06))]


def _bucket_words(goal: Mapping[str, float] | None, bucket: SceneObject, wide: bool) -> str:
    """Return the clause that adds the bucket's goal to an instruction; it is empty if the bucket has no goal.

    The bucket has a goal only with ``wide`` variation, as in version 2. If ``goal`` is None, the clause does not give
    the goal's coordinates.
    """
    if not wide:
        return ""
    if goal is None:
        return ", which shall stand at its goal"
    x, y, _ = bucket.position
    return f", which shall stand at {centimetres(x + goal['goal_x'], y + goal['goal_y'])}"


_KETTLE = SceneObject("kettle", "kettle", (0.0, 0.0, 0.478), (0.0, 0.0, 0.5 * math.pi))
_BUCKET = SceneObject("bucket", "bucket", (0.0, -0.3, 0.457))
_SINK, _DEEPEST = 5.0, 0.2
"""Metres by which the goal sinks for each metre by which the bucket is lifted, and the goal's largest depth below the
mouth of a standing bucket, metres."""
_TROUGH_TILT = 0.541
_TROUGH, _TROUGH_HALF = (-0.1428, 0.0, 0.0287), (0.0615, 0.022, 0.0136)
"""The box around the kettle's trough: rotation about y, rad; centre in the kettle's frame and half sizes, metres."""
_SIDE, _SPACING, _RISE = 5, 0.012, 0.011
"""The drops start in layers of 5 x 5, 12 mm apart, each layer 11 mm above the last."""


class PourWater(ReachTask):
    """Pour water from a kettle, held by the right hand, into a bucket, held by the left hand.

    Observation: Table 40 of the paper's appendix, size (428). Reward: equation 19. The right hand must reach the
    kettle's handle, the left hand the bucket's origin. The table is 0.5 x 1 m and 40 cm high.

    The spout's goal is on the bucket's axis, 1 cm below the rim if the bucket stands on the table. The goal moves with
    the bucket. For each cm by which the bucket's floor is lifted, the goal also sinks by 5 cm relative to the bucket,
    but never to more than 20 cm below its height for a standing bucket. If the goal were fixed to the bucket, spout and
    goal would also meet if the bucket were lifted and tipped under an upright kettle. The spout only gets near the
    sinking goal if the kettle is tilted over the rim. At less than 30 degrees of tilt no water leaves, and the spout
    stays 3 cm away from the goal. At 40 degrees it is 2 cm away, and from 60 degrees on it reaches the goal. The goal's
    orientation is the kettle's orientation at the task's start, tilted by 40 degrees towards the spout. With wide
    variation, as in version 2, kettle and bucket start at other places in every episode. The goal's position is then
    the goal of the bucket on the table, and its orientation is computed for a kettle at the nominal place.

    A task shifts and turns the bucket, and the kettle with the water. The water consists of drops without friction, of
    5 mm radius; observations do not show the drops. With twelve drops, the default, physics takes 1.4 times as long as
    in HandOver; with the paper's 30 drops it takes 2.4 times as long. The kettle has about the original's outline and
    weighs 1.5 kg. The original's body weighs at most 2.46 kg, the mass of its full hull.
    """

    name = "PourWater"
    summary = "Pour water from a kettle into a bucket"
    formula = (
        "1 - d_left - d_right + 2 (0.5 - d), d from the spout to a point 1 cm below the middle of the rim of a bucket "
        "that stands"
    )
    solved = "a third of the water is in the bucket, which is within 45 degrees of upright"
    deviations = (
        "The goal sinks by 5 cm for each that the bucket is lifted: else the bucket would be tipped under the kettle.",
        "Success counts water; the original's measures the distance from the spout to a point below the bucket.",
        "There are twelve drops without friction by default, or the paper's 30 as an option.",
        "The kettle weighs 1.5 kg and has a high floor and an open trough as spout.",
    )
    episode_steps = 125
    wide_steps = 400  # the script takes 130 steps to pour, 100 to put the kettle down and 120 to carry the bucket
    right = HandPose((0.55, 0.2, 0.6), PALM_LEFT_AHEAD)
    left = HandPose((0.55, -0.2, 0.6), PALM_RIGHT_AHEAD)
    start_draws = 2 * DRAWS
    solver = THIN
    table = Table((0.5, 1.0, 0.4), (0.0, 0.0, 0.2))
    objects = (_KETTLE, _BUCKET)
    points = ("bucket/position", "kettle/handle_position")
    constant = 1.0
    terms = ("constant", "left", "right", "target")
    camera_target = (0.1, -0.05, 0.5)
    camera_distance = 1.4
    camera_angle = (20.0, -42.0)
    variation_space = join(placed("kettle"), placed("bucket"))
    wide_space = join(variation_space, *(component(f"goal_{axis}", -0.12, 0.12) for axis in "xy"))
    wide_solved = f"{solved} and within 4 cm of its goal"
    blocks = (
        *object_blocks("kettle"),
        *goal_blocks("goal"),
        point_block("kettle_handle_position", "kettle/handle_position", "grip of the kettle's handle"),
        point_block("bucket_position", "bucket/position", "origin of the bucket"),
    )

    def __init__(self, moving_base: bool | None = None, water: int = 12) -> None:
        """Create the class with ``water`` drops of water, 1 to 125.

        ``moving_base`` says whether the hands' bases move; None takes the class's default.
        """
        super().__init__(moving_base)
        self.water = whole_number("water", water, 1, 125)  # five layers fit under the lid
        # We measured 12, 30 and 125 drops: a drop adds at most 1.8 contacts, 1 convex pair and 1.6 rows.
        more = max(0, water - 12)
        self.needs = Capacity(71 + 3 * more, 20 + more, 134 + 3 * more)

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        super().add_objects(scene)
        for i in range(self.water):
            SceneObject(f"water{i}", "water", (0.0, 0.0, 0.0)).add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the values that a task fixes: the places of kettle and bucket, and their goals.

        * ``kettle`` and ``bucket``: shift and yaw from the nominal start (n, 3) each.
        * ``goal_rotation``: goal orientation (n, 4) of the kettle, a quaternion (x, y, z, w).
        * ``goal_rotation_inverse``: the inverse of ``goal_rotation`` (n, 4).
        * ``goal``: goal pose of the bucket (n, 7); ``goal_inverse``: inverse of its rotation (n, 4); only with wide
          variation (version 2).
        """
        nominal = xyzw(constant(_KETTLE.quaternion, variation))
        tilt = xyzw(constant(quaternion_from_rpy((0.0, -math.radians(40.0), 0.0)), variation))
        goal = multiply(multiply(yaw_quaternion(variation[:, 2]), nominal), tilt)
        frozen = {"goal_rotation": goal, "goal_rotation_inverse": conjugate(goal)}
        return super().freeze(variation) | frozen | _bucket_goal(variation[:, 6:], _BUCKET)

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        super().start(draws, frozen, qpos)
        kettle = qpos["kettle"]
        drops = rotate(xyzw(kettle[:, 3:])[:, None], self._fill(kettle)).float() + kettle[:, None, :3]
        for i in range(self.water):
            for k, axis in enumerate("xyz"):
                qpos[f"water{i}/{axis}"][:, 0] = drops[:, i, k]

    def obstacles(self, qpos: dict[str, Tensor]) -> list[tuple[str, Tensor, Point]]:
        """Return the box around the kettle's trough, because joint noise might push the left forefinger into it.

        The trough reaches under the left forefinger. ``TaskClass.obstacles`` describes the entry.
        """
        kettle = qpos["kettle"]
        turn = xyzw(kettle[:, 3:])
        centre = kettle[:, :3] + rotate(turn, constant(_TROUGH, kettle))
        tilt = xyzw(constant(quaternion_from_rpy((0.0, _TROUGH_TILT, 0.0)), kettle))
        return [("left", posed(centre, multiply(turn, tilt)), _TROUGH_HALF)]

    def _fill(self, like: Tensor) -> Tensor:
        """Return the positions of the drops in the kettle's frame, metres, (water, 3)."""
        i = torch.arange(self.water, device=like.device)
        middle = 0.5 * (_SIDE - 1)
        x = (i % _SIDE - middle) * _SPACING
        y = (i // _SIDE % _SIDE - middle) * _SPACING
        z = -0.0025 + i // _SIDE**2 * _RISE  # the lowest drops start 0.5 mm above the floor
        return torch.stack((x, y, z), dim=1).to(like.dtype)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        frozen = state.frozen
        difference = multiply(state.quaternion("kettle/quaternion"), frozen["goal_rotation_inverse"])
        if self.rules.wide:
            position = frozen["goal"][:, :3]
        else:
            position = _goal(state)
        pose = torch.cat((position, frozen["goal_rotation"]), dim=1)
        return {"goal_pose": pose, "goal_rotation_difference": difference}

    def ghosts(self, state: TaskState) -> list[Ghost]:
        return _bucket_ghosts(state)

    def target(self, state: TaskState) -> Tensor:
        return 2.0 * (0.5 - _spout_off(state))

    def hides(self) -> tuple[Hidden, ...]:
        if self.rules.wide:
            return (Hidden(("goal_x", "goal_y"), 0.04),)
        return ()

    def instruct(self, goal: Mapping[str, float] | None) -> str:
        return self.summary + _bucket_words(goal, _BUCKET, self.rules.wide)

    def errors(self, state: TaskState) -> list[Error]:
        return [at_least(self._inside(state) / self.water, 1.0 / 3.0, 1.0 / 12.0), *_bucket_error(state)]

    def guides(self, state: TaskState) -> list[Tensor]:
        return [*super().guides(state), _spout_off(state)]

    def success(self, state: TaskState) -> Tensor:
        poured = (3 * self._inside(state) >= self.water) & stands(state.quaternion("bucket/quaternion"))
        if self.rules.wide:
            return poured & within(_bucket_error(state))
        return poured

    def _inside(self, state: TaskState) -> Tensor:
        """Return the number of drops in the bucket, (n,)."""

        def count() -> Tensor:
            drops = torch.stack([state[f"water{i}/position"] for i in range(self.water)], dim=1)
            turn = state.quaternion("bucket/quaternion")
            return inside_bucket(drops, state["bucket/position"], turn).sum(dim=1)

        return state.once("inside", count)


def _spout_off(state: TaskState) -> Tensor:
    """Return the distance from the spout to its goal, metres, (n,)."""
    return state.once("spout", lambda: norm(state["kettle/spout_position"] - _goal(state)))


def _goal(state: TaskState) -> Tensor:
    """Return the goal of the spout, world, metres, (n, 3)."""

    def sunk() -> Tensor:
        x, y, height = state["bucket/mouth_position"].unbind(1)
        origin = state["bucket/position"][:, 2]
        lift = (origin + FLOOR / MOUTH * (height - origin) - (_BUCKET.position[2] + FLOOR)).clamp(min=0.0)
        return torch.stack((x, y, height - torch.minimum(_SINK * lift, lift + _DEEPEST)), dim=1)

    return state.once("goal", sunk)
