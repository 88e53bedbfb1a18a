"""Hand controller: moves both hands to points in closed loop, for scripted policies.

A script is a generator of actions: it yields one for each control step, and reads the state in which that is taken.
"""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from bidex_meta.hands.hand import ANGULAR_DAMPING, FORCE_PER_SCALE, LINEAR_DAMPING, SIDES, TORQUE_PER_SCALE, hand
from bidex_meta.tasks.base import TaskClass
from bidex_meta.utils.maths import conjugate, multiply, quaternion_from_rpy, rotate, xyzw
from bidex_meta.witness.store import quantised

GAIN = 8.0  # speed of a hand over its distance to its target, and of its turn over its angle to its target, 1/s
_KNUCKLES, _MIDDLES = ("FFJ2", "MFJ2", "RFJ2", "LFJ2"), ("FFJ1", "MFJ1", "RFJ1", "LFJ1")

Point = tuple[float, float, float]
Actions = Iterator[Tensor]
"""Of a script or a part of one, each (action_size,)."""


def beside(point: Tensor, x: float, y: float, height: float) -> Point:
    """A point beside another, at a height above the floor, metres."""
    return float(point[0]) + x, float(point[1]) + y, height


def point(position: Tensor) -> Point:
    """A position (3,) as three numbers, metres."""
    x, y, z = position.tolist()
    return x, y, z


def rest_action(size: int) -> Tensor:
    """The action (size,) of zero joint angles and no force on the bases."""
    low, high = (torch.as_tensor(x).float() for x in (hand().control_low, hand().control_high))
    one = torch.zeros(size // 2)
    one[: len(low)] = (-(high + low) / (high - low)).clamp(-1.0, 1.0)
    return one.repeat(2)


class HandController:
    """Moves both hands of an environment of a class to points, from the state that it reads.

    ``sensor`` gives a sensor's present values by its name, (k,) in double precision, ``frozen`` a frozen number of the
    task, (k,).
    """

    def __init__(self, task: TaskClass, sensor: Callable[[str], Tensor], frozen: Callable[[str], Tensor]):
        self.where, self.frozen = sensor, frozen
        self.episode_steps, self.taken = task.episode_steps, 0
        self.wide = task.rules.wide  # whether a task asks for more than version 1's
        self._rest = rest_action(task.action_size)
        self._full_speed = FORCE_PER_SCALE * task.transition_scale / LINEAR_DAMPING[0]
        self._full_torque = TORQUE_PER_SCALE * task.orientation_scale
        self._held: dict[str, Tensor] = {}
        self._first = {side: self.where(f"{side}/mount_quaternion") for side in SIDES}
        half, self._joints = task.action_size // 2, len(hand().control_low)
        self._fingers = {side: self._rest[i * half :][: self._joints] for i, side in enumerate(SIDES)}

    def orientation(self, sensor: str) -> Tensor:
        """A sensor's quaternion, (x, y, z, w), (4,)."""
        value = self.where(sensor)
        return xyzw(value / value.norm())

    @property
    def steps_left(self) -> int:
        """Control steps to the end of the episode."""
        return self.episode_steps - self.taken

    def at(self, side: str) -> Tensor:
        """Position of a hand's point, metres, (3,)."""
        return self.where(f"{side}/hand_point_position")

    def bend(self, side: str, knuckles: float, middles: float, **others: float) -> None:
        """Bends the four fingers of a hand, and sets other joints by their names (the rest to 0), rad."""
        low, high = (torch.as_tensor(x).float() for x in (hand().control_low, hand().control_high))
        angles = torch.zeros(self._joints)
        names = [hand().joints[i] for i in hand().actuated]
        bent = {**dict.fromkeys(_KNUCKLES, knuckles), **dict.fromkeys(_MIDDLES, middles), **others}
        for joint, angle in bent.items():
            angles[names.index(joint)] = angle
        self._fingers[side] = (2.0 * (angles - low) / (high - low) - 1.0).clamp(-1.0, 1.0)

    def hold(self, side: str, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> None:
        """From now on holds a hand's start orientation, turned about the world's axes, rad; a free hand may turn."""
        turn = torch.tensor(quaternion_from_rpy((roll, pitch, yaw)), dtype=torch.float64)
        self._held[side] = multiply(xyzw(turn), xyzw(self._first[side]))

    def turn(self, side: str, way: Tensor) -> None:
        """Turns a hand from its present orientation by a small ``way``: axis times angle (3,), world, rad."""
        angle = way.norm()
        turn = torch.cat((torch.sin(0.5 * angle) * way / (angle + 1e-9), torch.cos(0.5 * angle)[None]))
        self._held[side] = multiply(turn, self.orientation(f"{side}/mount_quaternion"))

    def lead(self, right: Point, left: Point, steps: int = 1, speed: float = 0.6) -> Actions:
        """Moves the hands' points towards two points (world, metres), at most at ``speed`` (m/s)."""
        for _ in range(min(steps, self.steps_left)):
            action, half = self._rest.clone(), len(self._rest) // 2
            for i, (side, goal) in enumerate(zip(SIDES, (right, left), strict=True)):
                way = GAIN * (torch.tensor(goal, dtype=torch.float64) - self.at(side))
                way *= min(1.0, speed / (float(way.norm()) + 1e-9))
                action[i * half :][: self._joints] = self._fingers[side]
                action[i * half + self._joints :][:3] = (way / self._full_speed).float().clamp(-1.0, 1.0)
                action[i * half + self._joints :][3:6] = self._torque(side).float()
            self.taken += 1
            yield quantised(action.clamp(-1.0, 1.0))

    def lead_each(self, points: Iterable[Point], speed: float = 0.6) -> Actions:
        """``lead`` for a step, to the right and the left hand's point."""
        right, left = points
        yield from self.lead(right, left, 1, speed)

    def _torque(self, side: str) -> Tensor:
        """The actions (3,) that turn a hand to the orientation it is held at; zeros for a free hand."""
        if side not in self._held:
            return torch.zeros(3)
        now = self.orientation(f"{side}/mount_quaternion")
        error = multiply(self._held[side], conjugate(now))
        way = 2.0 * error[:3] * error[3].sign()  # rad, for small angles
        torque = rotate(now, rotate(conjugate(now), way) * torch.tensor(ANGULAR_DAMPING, dtype=torch.float64))
        return (GAIN * torque / self._full_torque).clamp(-1.0, 1.0)
