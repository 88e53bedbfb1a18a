"""The script of ReOrientation: a fist holds a cube fast, and the hand turns as the cube has to turn.

Noise on the bases throws cubes off open hands, and a turn of a hand moves its cube, which costs as much as the turn
earns: to a learner that explores, doing nothing looks better than what it tries.
"""

from torch import Tensor

from bidex_meta.hands.pair import SIDES
from bidex_meta.maths import conjugate, multiply, rotation_angle, xyzw
from bidex_meta.witness.puppets import GAIN, Puppets

_CUBES = {"right": ("object2", "goal2"), "left": ("object1", "goal1")}
_FALL, _CLOSE = 25, 22
"""Control steps until the cubes lie still in the cups, and until the fists are closed."""
_RATE, _FASTEST = 4.0, 1.8
"""Speed of the turn over the angle that is left, 1/s, and at most, rad/s: faster ones shake cubes out."""


def turn_cubes(hands: Puppets) -> None:
    """Both hands catch their cubes, close, and turn them in closed loop, each about its goal's place."""
    at = {side: hands.at(side) for side in SIDES}
    for side in SIDES:
        hands.hold(side)
        hands.bend(side, 0.6, 0.55, THJ4=0.4, THJ3=0.6)
    hands.lead(_point(at["right"]), _point(at["left"]), _FALL)
    for side in SIDES:
        hands.bend(side, 1.3, 1.35, THJ4=0.85, THJ3=1.1, THJ1=-0.3, THJ0=-0.6)
    hands.lead(_point(at["right"]), _point(at["left"]), _CLOSE)
    while len(hands.actions) < hands.episode_steps:
        points = {}
        for side, (cube, goal) in _CUBES.items():
            hands.turn(side, _turn(hands, cube, goal))
            points[side] = _point(hands.at(side) + hands.frozen(goal)[:3] - hands.where(f"{cube}/position"))
        hands.lead(points["right"], points["left"])


def _turn(hands: Puppets, cube: str, goal: str) -> Tensor:
    """The turn (3,) that is asked of a hand now, rad about the world's axes."""
    mean = hands.where(f"{cube}/quaternion")
    left = multiply(hands.frozen(goal)[3:].double(), conjugate(xyzw(mean / mean.norm())))
    axis = left[:3] * left[3].sign()
    speed = min(_RATE * float(rotation_angle(left)), _FASTEST)
    return speed / GAIN * axis / (axis.norm() + 1e-9)


def _point(place: Tensor) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z
