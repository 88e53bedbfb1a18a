"""Scripted policies for the classes that no search on the printed reward solved."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import SIDES
from bidex_meta.utils.maths import conjugate, multiply, rotate, rotation_angle
from bidex_meta.witness.controller import GAIN, HandController, Point

_FINGERS = 0.085  # from a hand's point to the tips of its bent fingers, metres
_DOWN = 0.2  # bend of the wrist that brings straight fingers below the forearm, rad
_BACK = 0.698  # how far a wrist bends back, rad
# Position of a hand's point, from the pot's origin, if its fingertips carry a grip of the pot, metres.
_REACH, _GRIP_HEIGHT = 0.1755 + 0.085, 0.068
# Turn that lays the left fingers on the underside of the kettle's trough; the kettle's tilt when it pours, rad.
_TROUGH, _POUR = math.radians(59.0), math.radians(50.0)
_PRESS = 0.0015  # distance inside what a hand presses to which it is led, metres: about 6 N


def grasp_and_place(hands: HandController) -> None:
    """Both hands clamp the block between the right forefinger and the left little finger, and drop it in the bucket."""
    # The reward for the block's nearness is flat where the block starts, and a push pays only after the hand has
    # followed.
    block, bucket = hands.where("block/position"), hands.where("bucket/position")
    hands.bend("right", 0.0, 0.0, THJ3=0.5, THJ1=-0.5, THJ0=-1.5, WRJ0=_DOWN)  # its thumb out of the way
    hands.bend("left", 0.0, 0.0, WRJ0=_DOWN)
    hands.hold("right", yaw=0.15)
    hands.hold("left", yaw=-0.15)
    x, y = float(block[0]) + 0.075, float(block[1])
    low, high = 0.642, 0.775
    hands.lead((x, y + 0.11, high), (x, y - 0.11, high), 30)
    hands.lead((x, y + 0.11, low), (x, y - 0.11, low), 30, speed=0.4)
    hands.lead((x, y + 0.08, low), (x, y - 0.08, low), 20, speed=0.2)
    for _ in range(30):
        _clamp(hands, x, y, low)
    for i in range(40):
        _clamp(hands, x, y, low + (high - low) * (i + 1) / 40)
    way = (bucket - hands.where("block/position"))[:2] / 80
    for i in range(90):
        x, y = (x + float(way[0]), y + float(way[1])) if i < 80 else (x, y)
        _clamp(hands, x, y, high)
    hands.lead((x, y + 0.11, high), (x, y - 0.11, high), hands.episode_steps, speed=0.2)


def _clamp(hands: HandController, x: float, y: float, height: float) -> None:
    """Presses the hands together, whatever lies between them, and moves their middle in y."""
    right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
    way = y - 0.5 * (right + left)
    hands.lead((x, right + way - _PRESS, height), (x, left + way + _PRESS, height))


def lift_underarm(hands: HandController) -> None:
    """The hands go under the pot's grips, bent back as far as their wrists allow, and lift the pot to its goal."""
    # A pot that is thrown to its goal pays before one that is lifted there.
    pot = hands.where("object/position")
    out = (hands.where("object/right_handle_position") - pot) / 0.15  # from the pot to the right grip, of length 1
    yaw = math.atan2(-float(out[0]), float(out[1]))
    for side, sign in (("right", -1.0), ("left", 1.0)):
        hands.bend(side, 0.0, 0.0, WRJ0=-_BACK)  # against the joint's limit: a wrist's motor is weaker than the pot
        hands.hold(side, roll=sign * (_BACK + 0.1), yaw=yaw)
    out[2] = 0.0

    def under(middle: Tensor, height: float, steps: int, speed: float, reach: float = _REACH) -> None:
        right, left = middle + reach * out, middle - reach * out
        hands.lead(_from(right, 0.0, 0.0, height), _from(left, 0.0, 0.0, height), steps, speed)

    height = float(pot[2]) + _GRIP_HEIGHT
    under(pot, height - 0.06, 25, 0.6, reach=_REACH + 0.1)
    under(pot, height - 0.04, 30, 0.3)
    under(pot, height, 30, 0.1)
    way = hands.frozen("goal")[:3] - pot
    for i in range(150):
        share = (i + 1) / 150
        under(pot + share * way, height + share * float(way[2]), 1, 0.6)
    under(pot + way, height + float(way[2]), hands.episode_steps, 0.6)


def pour_water(hands: HandController) -> None:
    """The right hand grips the handle, the left goes under the spout; they lift the kettle and tilt it."""
    # Water itself is not paid.
    kettle, bucket = hands.where("kettle/position"), hands.where("bucket/position")
    back = hands.where("kettle/handle_position") - kettle  # from spout to handle
    back = back / back.norm()

    def grip(origin: Tensor, tilt: float = 0.0, aside: float = 0.0, loose: float = -0.003, steps: int = 1) -> None:
        """Leads the hands to where they hold a kettle at this place, or ``loose`` metres off it, ``aside`` in x."""

        def at(x: float, along: float, up: float) -> Point:
            flat = along * math.cos(tilt) - up * math.sin(tilt)
            rise = along * math.sin(tilt) + up * math.cos(tilt)
            return _from(origin + flat * back, x + aside, 0.0, float(origin[2]) + rise)

        hands.hold("right", roll=tilt)
        hands.hold("left", roll=_TROUGH + tilt)
        hands.lead(at(-0.005, 0.159 + 0.2 * loose, -0.004), at(0.065, -0.153, 0.030 - loose), steps, speed=1.0)

    hands.bend("right", 0.0, 0.0)
    hands.bend("left", 0.0, 0.0, THJ4=1.047, THJ3=1.222)  # its thumb across the palm, off the kettle's wall
    grip(kettle, aside=0.15, loose=0.025, steps=26)
    grip(kettle, loose=0.025, steps=17)
    hands.bend("right", 1.2, 1.5)
    grip(kettle, steps=17)
    sine, cosine = math.sin(_POUR), math.cos(_POUR)
    lip = -0.2 * cosine - 0.053 * sine, 0.053 * cosine - 0.2 * sine  # of a tilted kettle, along ``back`` and up
    way = bucket + (0.07 - lip[0]) * back - kettle
    way[2] += 0.098 - lip[1]
    for i in range(34):
        share = (i + 1) / 34
        there = kettle + share * way
        there[2] = kettle[2] + min(1.0, 1.3 * share) * way[2]  # up first: the left hand must clear the bucket's rim
        grip(there, share * _POUR)
    grip(kettle + way, _POUR, steps=hands.episode_steps)


def stack_block(hands: HandController) -> None:
    """The right hand pushes block 2 to its place; both hands lift block 1 between their fingertips and set it down."""
    # Both blocks beside each other at the target pay almost as much as the stack.
    block1, block2 = hands.where("block1/position"), hands.where("block2/position")
    for side in SIDES:
        hands.bend(side, 0.5, 0.2)
    behind1, behind2 = -0.03 - _FINGERS, 0.05 + _FINGERS
    hands.lead(_from(block2, 0.0, behind2, 0.70), _from(block1, 0.0, behind1 - 0.03, 0.70), 10, speed=0.66)
    hands.lead(_from(block2, 0.0, behind2, 0.655), _from(block1, 0.0, behind1 - 0.03, 0.655), 12)
    y, goal = float(hands.at("right")[1]), float(hands.frozen("goal2")[1])
    while float(hands.where("block2/position")[1]) > goal + 0.004 and len(hands.actions) < 80:
        y -= 0.0028
        hands.lead((float(block2[0]) + 0.008, y, 0.655), _from(block1, 0.0, -0.05 - _FINGERS, 0.655), speed=0.4)
    hands.bend("right", 1.35, 0.15)  # a hook, to reach between the blocks from above
    back = float(hands.at("right")[1]) + 0.01
    hands.lead((float(block1[0]), back, 0.76), _from(block1, 0.0, behind1 - 0.02, 0.655), 10)
    hands.lead(_from(block1, 0.0, 0.065, 0.76), _from(block1, 0.0, behind1 - 0.01, 0.655), 14)
    hands.lead(_from(block1, 0.0, 0.065, 0.715), _from(block1, 0.0, behind1 - 0.005, 0.655), 10, speed=0.4)
    hooked = float(block1[0]), float(hands.at("right")[1]), 0.684
    hands.lead(hooked, _from(block1, 0.0, behind1, 0.655), 12, speed=0.4)
    _carry_block1(hands, float(block1[0]))


def _carry_block1(hands: HandController, x: float) -> None:
    """Closes both hands on block 1, lifts it, carries it over block 2, sets it down and lets go."""
    right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
    high, low = 0.684, 0.655
    for _ in range(14):
        right, left = right - 0.0025, left + 0.001
        hands.lead((x, right, high), (x, left, low), speed=0.3)
    right, left = float(hands.at("right")[1]) - 0.004, float(hands.at("left")[1]) + 0.004  # about 16 N
    hands.lead((x, right, high), (x, left, low), 6)
    for _ in range(18):
        high, low = high + 0.068 / 18, low + 0.068 / 18
        hands.lead((x, right, high), (x, left, low))
    way = (hands.where("block2/position") - hands.where("block1/position"))[:2] / 32
    for _ in range(32):
        x, right, left = x + float(way[0]), right + float(way[1]), left + float(way[1])
        hands.lead((x, right, high), (x, left, low))
    top = float(hands.where("block2/position")[2]) + 0.0505
    for _ in range(30):
        if float(hands.where("block1/position")[2]) < top:
            break
        high, low = high - 0.0012, low - 0.0012
        hands.lead((x, right, high), (x, left, low))
    for _ in range(14):
        right, left = right + 0.0012, left - 0.0012
        hands.lead((x, right, high), (x, left, low))
    hands.lead((x, right, high), (x, left, low), hands.episode_steps)


def _from(point: Tensor, x: float, y: float, height: float) -> Point:
    """A point beside another, at a height above the floor, metres."""
    return float(point[0]) + x, float(point[1]) + y, height


_DOOR_HEIGHT = 0.72  # of the hands at a door, between the ends of the bars, metres
# From a hand's point to its fingers' middle joints: ahead, and away from where the palm faces, metres.
_TO_FINGERS, _TO_PALM = 0.06, 0.02


@dataclass(frozen=True)
class _Leaf:
    """A leaf from above, as on the right hand's side, where y grows outwards; metres (assets/objects/door.xml).

    ``hinge``: its x, and its y from the door's middle; ``along`` and ``over``: from it to the bar that faces the hands.
    """

    hinge: tuple[float, float]
    along: float
    over: float

    def place(self, along: float, over: float, angle: float) -> tuple[float, float]:
        """A point of the leaf that stands open by this angle towards the hands (away from them: negative)."""
        sine, cosine = math.sin(angle), math.cos(angle)
        return self.hinge[0] + over * cosine + along * sine, self.hinge[1] + over * sine - along * cosine


_INWARD = _Leaf((0.0085, 0.4265), 0.3752, 0.0710), _Leaf((0.0056, 0.4204), 0.3761, 0.0738)
_OUTWARD = _Leaf((-0.0085, 0.4265), 0.3752, 0.0830), _Leaf((-0.0056, 0.4204), 0.3761, 0.0802)


def open_inward(hands: HandController) -> None:
    """Fingers bent to hooks go behind the bars from the side, and pull the leaves open; the hands turn with them."""
    # One leaf open and the other shut pays as much as both half open.

    def go(angles: Sequence[float], aside: float = 0.0, back: float = 0.0, steps: int = 1, speed: float = 0.6) -> None:
        """Hooks behind the bars of leaves that stand open by these angles, or ``aside`` and ``back`` of that."""
        at = [
            leaf.place(leaf.along - 0.009 - aside, leaf.over + 0.01 + back, angle)
            for leaf, angle in zip(_INWARD, angles, strict=True)
        ]
        _lead(hands, at, angles, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 1.45)
    led = _angles(hands)
    go(led, aside=0.11, back=0.02, steps=22, speed=0.8)
    go(led, aside=0.11, steps=6, speed=0.5)
    go(led, steps=15, speed=0.5)
    while len(hands.actions) < hands.episode_steps:
        led = [min(angle + 0.0075, now + 0.1, 1.35) for angle, now in zip(led, _angles(hands), strict=True)]
        go(led)


def close_outward(hands: HandController) -> None:
    """Straight fingers go between each bar and its leaf, and pull the leaves shut; the hands turn with them."""
    # Leaves that stand away from the hands cannot be pushed shut. The distance between hand and leaf is bounded, since
    # more force straightens bent fingers.
    start = _angles(hands)

    def go(angles: Sequence[float], back: float = 0.0, steps: int = 1, speed: float = 0.6) -> None:
        """Fingers behind the bars of leaves that stand open by these angles, or ``back`` of that."""
        yaws = [0.8 * (first - angle) for first, angle in zip(start, angles, strict=True)]
        at = []
        for leaf, angle, yaw in zip(_OUTWARD, angles, yaws, strict=True):
            x, y = leaf.place(leaf.along, leaf.over - 0.04, -angle)
            ahead, sine, cosine = _TO_FINGERS + back, math.sin(yaw), math.cos(yaw)
            at.append((x + ahead * cosine + _TO_PALM * sine, y + ahead * sine - _TO_PALM * cosine))
        _lead(hands, at, yaws, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 0.0)
    go(start, back=0.2, steps=16, speed=1.0)
    go(start, steps=22, speed=1.2)
    led = start
    while len(hands.actions) < hands.episode_steps:
        led = [max(angle - 0.012, now - 0.22, -0.2) for angle, now in zip(led, _angles(hands), strict=True)]
        go(led)


def _angles(hands: HandController) -> list[float]:
    """How far the right and the left leaf stand open, rad."""
    return [float(hands.where(f"object/hinge{leaf}_angle")) for leaf in (1, 2)]


def _lead(
    hands: HandController, at: Sequence[tuple[float, float]], yaws: Sequence[float], steps: int, speed: float
) -> None:
    """Moves the right hand to its point and the left one to its point mirrored, turned outwards."""
    middle = float(hands.where("object/position")[1])
    points: list[Point] = []
    for side, sign, (x, y), yaw in zip(SIDES, (1.0, -1.0), at, yaws, strict=True):
        hands.hold(side, yaw=sign * yaw)
        points.append((x, middle + sign * y, _DOOR_HEIGHT))
    hands.lead(*points, steps=steps, speed=speed)


_CUBES = {"right": ("object2", "goal2"), "left": ("object1", "goal1")}
# Joint angles of a hand that waits for its cube, and that holds it, rad.
_CUP = {"knuckles": 0.6, "middles": 0.55, "THJ4": 0.4, "THJ3": 0.6, "THJ1": 0.0, "THJ0": 0.0}
_FIST = {"knuckles": 1.3, "middles": 1.35, "THJ4": 0.85, "THJ3": 1.1, "THJ1": -0.3, "THJ0": -0.6}
_CUBE_KNUCKLES = ("FFJ2", "MFJ2", "RFJ2")
# Speed of the turn over the angle that is left, 1/s, and at most, rad/s: faster ones shake cubes out.
_RATE, _FASTEST = 4.0, 1.8
# Share of the full gain with which a cup follows its cube: 98 instead of 82 % of fifty episodes; twice it, 68 %.
_FOLLOW = 0.5


def turn_cubes(hands: HandController) -> None:
    """Each hand stays below its cube until that lies in the cup, closes to a fist, and turns it at its goal."""
    # Noise on the bases throws cubes off open hands, and a turn moves its cube, which costs as much as it earns. All is
    # a function of the state alone, so that it can be cloned.
    while len(hands.actions) < hands.episode_steps:
        points = {side: _next(hands, side) for side in SIDES}
        hands.lead(points["right"], points["left"])


def _next(hands: HandController, side: str) -> Point:
    """Bends the fingers and turns a hand; returns where it should go."""
    cube, goal = _CUBES[side]
    place, knuckles = hands.where(f"{cube}/position"), _knuckles(hands, side, "position")
    mount = hands.orientation(f"{side}/mount_quaternion")
    height = -float(rotate(conjugate(mount), place - hands.at(side))[1])  # above the palm; 3 cm where it lies
    speed = float(hands.where(f"{cube}/linear_velocity").norm())
    # Half closed fingers go on closing, whatever the cube does.
    lies = _falls(speed, 0.06, 0.12) * _falls(height, 0.05, 0.06)
    closed = max(lies, 1.0 - _falls(knuckles, 0.62, 0.67))
    hands.bend(side, **{name: (1.0 - closed) * cup + closed * _FIST[name] for name, cup in _CUP.items()})
    moving = abs(_knuckles(hands, side, "velocity"))
    held = (1.0 - _falls(knuckles, 0.7, 0.8)) * _falls(moving, 0.3, 1.1)
    left = multiply(hands.frozen(goal)[3:].double(), conjugate(hands.orientation(f"{cube}/quaternion")))
    axis = left[:3] * left[3].sign()  # of the turn that takes the cube to its goal's orientation
    hands.turn(side, held * (min(_RATE * float(rotation_angle(left)), _FASTEST) / GAIN * axis / (axis.norm() + 1e-9)))
    below = place - hands.at(side)
    below[2] = 0.0
    x, y, z = (hands.at(side) + (1.0 - closed) * _FOLLOW * below + held * (hands.frozen(goal)[:3] - place)).tolist()
    return x, y, z


def _knuckles(hands: HandController, side: str, what: str) -> float:
    """Mean angle, rad, or its speed, of three knuckles."""
    return sum(float(hands.where(f"{side}/{joint}_{what}")) for joint in _CUBE_KNUCKLES) / len(_CUBE_KNUCKLES)


def _falls(value: float, low: float, high: float) -> float:
    """1 up to ``low``, 0 from ``high`` on, linear between."""
    return min(1.0, max(0.0, (high - value) / (high - low)))


SCRIPTS: dict[str, Callable[[HandController], None]] = {
    "DoorCloseOutward": close_outward,
    "DoorOpenInward": open_inward,
    "GraspAndPlace": grasp_and_place,
    "LiftUnderarm": lift_underarm,
    "PourWater": pour_water,
    "ReOrientation": turn_cubes,
    "StackBlock": stack_block,
}


def script_of(name: str) -> Callable[[HandController], None]:
    """The script of a class; raises BidexError where it has none."""
    if name not in SCRIPTS:
        raise BidexError(f"Expected a class with a script ({', '.join(SCRIPTS)}), got {name}; leave --script out.")
    return SCRIPTS[name]
