"""The observation of a task as named blocks, from which sizes, indices, goal mask and documentation are derived."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain, product

from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.hands.hand import FINGERS, SIDES, TOUCHED, hand
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Count, Finite, Text

VELOCITY_SCALE, FORCE_SCALE = 0.2, 10.0
"""Scale of joint velocities and of objects' angular velocities, and scale of forces and torques (docs/figures.md,
observation)."""
CLIP = 5.0
"""Largest absolute value of an entry; entries are clipped after scaling (docs/figures.md, control)."""
TOUCH_FORCE = 5.0
"""Normal force that touch entries show as 0.5, N. Fingertips felt 3 to 5 N (median) under random and scripted actions,
and up to 394 N, so that a linear scale would either clip or hide most contacts."""
_TIP_STATE = "per distal body: origin (m), quaternion (x, y, z, w), velocities (m/s, rad/s), world frame"
_TIP_WRENCH = "per distal body: force (10 N), torque (10 N m) at its origin, body frame, no weight"
_TOUCH = "per fingertip, palm and little finger's metacarpal: normal force f of contacts, f / (f + 5 N)"
_POSE = "position (m) and quaternion (x, y, z, w), world frame"
_DIFFERENCE = "object times inverse goal quaternion, (x, y, z, w)"


GOAL_QUATERNIONS = ("_pose", "_rotation_difference")
"""Ends of the names of goal blocks whose last four entries are a quaternion (:func:`goal_blocks`)."""


@checked_arguments
@dataclass(frozen=True)
class Block:
    """Consecutive entries of an observation.

    Attributes:
        sensors: Names of the sensors that the block is read from, in order; empty if the entries are computed.
        scale: Factor on the sensors' values.
        goal: Whether the block shows the goal; meta suites zero such blocks.
        saturates: Whether a scaled value x is shown as x / (1 + abs(x)), within (-1, 1).
        description: One line for documentation, with unit and frame.
    """

    name: Text
    size: Count
    sensors: tuple[Text, ...] = ()
    scale: Finite = 1.0
    goal: bool = False
    saturates: bool = False
    description: str = ""

    def __post_init__(self) -> None:
        if self.goal and self.sensors:
            raise BidexError(
                f"Block {self.name!r}: expected a goal without sensors, because suites that hide goals only leave out "
                f"what observe() computes; got {', '.join(self.sensors)}. Compute the block in observe()."
            )


@checked_arguments
@dataclass(frozen=True)
class Layout:
    """An observation: its blocks in order."""

    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        names = [block.name for block in self.blocks]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise BidexError(f"Layout: expected each block once, got two of the name {twice!r}. Rename one.")

    @property
    def size(self) -> int:
        """Return the number of entries."""
        return sum(block.size for block in self.blocks)

    def __iter__(self) -> Iterator[tuple[Block, slice]]:
        """Yield the blocks with their index ranges."""
        start = 0
        for block in self.blocks:
            yield block, slice(start, start + block.size)
            start += block.size

    @checked_arguments
    def range(self, name: str) -> slice:
        """Return the index range of the named block; raise BidexError if there is none."""
        if name not in self._ranges:
            raise unknown_name("block", name, self._ranges)
        return self._ranges[name]

    @cached_property
    def _ranges(self) -> dict[str, slice]:
        return {block.name: where for block, where in self}

    def goal_indices(self) -> list[int]:
        """Return the indices of all entries that show the goal."""
        indices: list[int] = []
        for block, where in self:
            if block.goal:
                indices += range(where.start, where.stop)
        return indices


def hand_blocks(side: str, moving: bool, touch: bool = False) -> tuple[Block, ...]:
    """Return the observation blocks of one hand, as in Table 7 of the paper's appendix.

    With a moving base they have 199 entries. With a fixed base they have 187: the six entries of the base are missing,
    and there are 20 instead of 26 last actions. With ``touch`` a block of 7 entries follows, one entry per body in
    ``hand.TOUCHED``. If f is the sum of the normal forces (N) of the body's contacts, its entry is f / (f +
    TOUCH_FORCE), in [0, 1).
    """

    def block(name: str, size: int, parts: Iterable[str], kinds: str, scale: float, description: str) -> Block:
        sensors = tuple(f"{side}/{part}_{kind}" for part, kind in product(parts, kinds.split()))
        return Block(f"{side}_{name}", size, sensors, scale, description=description)

    joints = hand().joints
    tips = [f"{finger}distal" for finger in FINGERS]
    mapped = "joint angles, mapped from the joint's range to [-1, 1]"
    force = "actuator force at the joint, 10 N m; 0 for the coupled distal joints"
    blocks = [
        block("joint_position", 24, joints, "position", 1.0, mapped),
        block("joint_velocity", 24, joints, "velocity", VELOCITY_SCALE, "joint velocities, 0.2 rad/s"),
        block("joint_force", 24, joints, "force", FORCE_SCALE, force),
        block("fingertip_state", 65, tips, "position quaternion linear_velocity angular_velocity", 1.0, _TIP_STATE),
        block("fingertip_force_torque", 30, tips, "force torque", FORCE_SCALE, _TIP_WRENCH),
    ]
    if moving:
        blocks += [
            Block(f"{side}_base_position", 3, (f"{side}/mount_position",), description="mount origin, world frame, m"),
            Block(f"{side}_base_rotation", 3, description="roll, pitch, yaw of the mount against its start, rad"),
        ]
    blocks.append(Block(f"{side}_action", 26 if moving else 20, description="last actions of this hand, in [-1, 1]"))
    if touch:
        sensors = tuple(f"{side}/{body}_touch" for body in TOUCHED)
        blocks.append(Block(f"{side}_touch", 7, sensors, 1.0 / TOUCH_FORCE, saturates=True, description=_TOUCH))
    return tuple(blocks)


@checked_arguments
def object_blocks(sensors: Text, name: Text | None = None) -> tuple[Block, ...]:
    """Return the observation blocks of a free object: its pose and velocities (13 entries).

    The blocks read the sensors ``<sensors>/...`` and are called ``<name>_...``. Without ``name``, they are called
    ``<sensors>_...``.
    """
    name = name or sensors
    spin = f"{sensors}/angular_velocity"
    return (
        Block(f"{name}_pose", 7, (f"{sensors}/position", f"{sensors}/quaternion"), description=_POSE),
        Block(f"{name}_linear_velocity", 3, (f"{sensors}/linear_velocity",), description="world frame, m/s"),
        Block(f"{name}_angular_velocity", 3, (spin,), VELOCITY_SCALE, description="world frame, 0.2 rad/s"),
    )


@checked_arguments
def goal_blocks(name: Text) -> tuple[Block, ...]:
    """Return the blocks of a goal: its pose, and the rotation from goal to object (11 entries)."""
    return (
        Block(f"{name}_pose", 7, goal=True, description=_POSE),
        Block(f"{name}_rotation_difference", 4, goal=True, description=_DIFFERENCE),
    )


@checked_arguments
def point_block(name: Text, sensor: Text, description: str) -> Block:
    """Return the block of a point that moves with an object: its position (3 entries), read from one sensor."""
    return Block(name, 3, (sensor,), description=f"{description}, world frame, m")


def handle_blocks(sensors: str, right: str, left: str) -> tuple[Block, Block]:
    """Return the blocks of both handles' points (6 entries), read from ``<sensors>/<side>_handle_position``.

    ``right`` and ``left`` describe the points.
    """
    first, second = (f"{side}_handle_position" for side in SIDES)
    return point_block(first, f"{sensors}/{first}", right), point_block(second, f"{sensors}/{second}", left)


@cache
def both_hands(moving: bool, touch: bool = False) -> tuple[Block, ...]:
    """Return the blocks of Table 7: 398 entries with moving bases, 374 with fixed bases; 14 more with ``touch``."""
    return tuple(chain.from_iterable(hand_blocks(side, moving, touch) for side in SIDES))
