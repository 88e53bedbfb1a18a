"""Hand controller: moves both hands to points in closed loop, for scripted policies.

A script is a generator: in each control step it reads the state and yields targets for the hands (:class:`Lead`).
:class:`HandActions` computes the actions of many environments together.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bidex_meta.hands.hand import ANGULAR_DAMPING, FORCE_PER_SCALE, LINEAR_DAMPING, SIDES, TORQUE_PER_SCALE, hand
from bidex_meta.tasks.base import TaskClass
from bidex_meta.utils.maths import conjugate, constant, multiply, quaternion_from_rpy, quaternion_product, rotate, xyzw
from bidex_meta.witness.store import quantised

GAIN = 8.0  # speed of a hand divided by its distance from its target; the same for turns and angles, 1/s
_KNUCKLES = ("FFJ2", "MFJ2", "RFJ2", "LFJ2")
_MIDDLES = ("FFJ1", "MFJ1", "RFJ1", "LFJ1")

Point = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]  # (w, x, y, z)


class Lead(NamedTuple):
    """A script's targets for one control step; pairs hold the values of the right and the left hand."""

    points: tuple[Point, Point]  # target positions of the hands' points, world, metres
    speed: float  # largest speed of the hands' points, m/s
    fingers: tuple[np.ndarray, np.ndarray]  # actions of the joints, (20,) each
    held: tuple[_Quaternion, _Quaternion]  # target orientations, world; zeros for a hand that may turn freely


Actions = Iterator[Lead]
"""The targets that a script, or a part of a script, yields step by step."""


def beside(point: Tensor, x: float, y: float, height: float) -> Point:
    """Return the point that is shifted from ``point`` by ``x`` and ``y``, at a height above the floor, metres."""
    return float(point[0]) + x, float(point[1]) + y, height


def point(position: Tensor) -> Point:
    """Return a position (3,) as three numbers, metres."""
    x, y, z = position.tolist()
    return x, y, z


def rest_action(size: int) -> Tensor:
    """Return the action (size,) for zero joint angles and no force on the bases."""
    low, high = (torch.as_tensor(x).float() for x in (hand().control_low, hand().control_high))
    one = torch.zeros(size // 2)
    one[: len(low)] = (-(high + low) / (high - low)).clamp(-1.0, 1.0)
    return one.repeat(2)


class HandController:
    """Lets a script move both hands of one environment to points, based on the environment's present state.

    ``sensor`` is a function that returns the present values (k,) of a sensor by name, in double precision. ``frozen``
    is a function that returns a value (k,) that the task fixes, such as its goal, by name.
    """

    def __init__(self, task: TaskClass, sensor: Callable[[str], Tensor], frozen: Callable[[str], Tensor]):
        self.where = sensor
        self.frozen = frozen
        self.episode_steps = task.episode_steps
        self.taken = 0
        self.wide = task.rules.wide  # with wide variation tasks ask for more than in version 1
        self._held: dict[str, _Quaternion] = {side: (0.0, 0.0, 0.0, 0.0) for side in SIDES}
        self._first = {side: _numbers(self.where(f"{side}/mount_quaternion")) for side in SIDES}
        self._fingers: dict[str, np.ndarray] = {side: _joint_actions(()) for side in SIDES}

    def orientation(self, sensor: str) -> Tensor:
        """Return the orientation (x, y, z, w) that a sensor measures, (4,)."""
        value = self.where(sensor)
        return xyzw(value / value.norm())

    @property
    def steps_left(self) -> int:
        """Return the number of control steps until the end of the episode."""
        return self.episode_steps - self.taken

    def at(self, side: str) -> Tensor:
        """Return the position of a hand's point (docs/figures.md, section Hand point), world, metres, (3,)."""
        return self.where(f"{side}/hand_point_position")

    def bend(self, side: str, knuckles: float, middles: float, **others: float) -> None:
        """Set the target angles of a hand's joints, rad.

        ``knuckles`` is the angle of the knuckles of all four fingers, and ``middles`` is the angle of their middle
        joints. ``others`` gives the angles of further joints by name. All other joints get the angle 0.
        """
        bent = {**dict.fromkeys(_KNUCKLES, knuckles), **dict.fromkeys(_MIDDLES, middles), **others}
        self._fingers[side] = _joint_actions(bent.items())

    def hold(self, side: str, roll: float = 0.0, yaw: float = 0.0) -> None:
        """Set the orientation that a hand keeps from now on: its start orientation, turned by ``roll`` and ``yaw``.

        Both are angles about the world's axes, rad. A hand may turn freely until a script calls this method or
        ``turn``.
        """
        self._held[side] = quaternion_product(quaternion_from_rpy((roll, 0.0, yaw)), self._first[side])

    def turn(self, side: str, way: Tensor) -> None:
        """Turn a hand from its present orientation by a small rotation vector ``way`` (3,), world, rad."""
        x, y, z = way.tolist()
        angle = math.sqrt(x * x + y * y + z * z)
        sine = math.sin(0.5 * angle) / (angle + 1e-9)
        turn = math.cos(0.5 * angle), sine * x, sine * y, sine * z
        now = self.where(f"{side}/mount_quaternion")
        self._held[side] = quaternion_product(turn, _numbers(now / now.norm()))

    def still_to_turn(self, side: str) -> float:
        """Return the angle between a hand's orientation and the one that it holds, rad."""
        now = _numbers(self.where(f"{side}/mount_quaternion"))
        same = abs(sum(a * b for a, b in zip(now, self._held[side], strict=True)))
        return 2.0 * math.acos(min(1.0, same))

    def lead(self, right: Point, left: Point, steps: int = 1, speed: float = 0.6) -> Actions:
        """Yield the targets that move the hands' points towards ``right`` and ``left`` (world, metres).

        The same targets are yielded for ``steps`` control steps, or until the episode ends. The hands move at ``speed``
        (m/s) at most.
        """
        a, b = SIDES
        for _ in range(min(steps, self.steps_left)):
            self.taken += 1
            fingers = (self._fingers[a], self._fingers[b])
            held = (self._held[a], self._held[b])
            yield Lead((right, left), speed, fingers, held)

    def lead_each(self, points: Iterable[Point], speed: float = 0.6) -> Actions:
        """Yield the targets of one control step that moves a point of each hand towards its goal in ``points``.

        The first point is for the right hand, the second for the left hand (world, metres). ``speed`` is the limit in
        m/s.
        """
        right, left = points
        yield from self.lead(right, left, 1, speed)


class HandActions:
    """Computes the actions that move the hands in a class's environments to the targets of scripts."""

    def __init__(self, task: TaskClass):
        self._full_speed = FORCE_PER_SCALE * task.transition_scale / LINEAR_DAMPING[0]
        self._full_torque = TORQUE_PER_SCALE * task.orientation_scale
        self._rounds = not task.rules.wide

    def __call__(self, leads: Sequence[Lead], sensor: Callable[[str], Tensor]) -> Tensor:
        """Return actions (n, action_size) of n environments; ``sensor`` returns values (n, k), in double precision."""
        at = torch.stack([sensor(f"{side}/hand_point_position") for side in SIDES], 1)
        now = torch.stack([sensor(f"{side}/mount_quaternion") for side in SIDES], 1)
        goals = at.new_tensor([lead.points for lead in leads])
        held = xyzw(at.new_tensor([lead.held for lead in leads]))
        speed = at.new_tensor([lead.speed for lead in leads])[:, None, None]
        way = GAIN * (goals - at)
        way *= (speed / (way.norm(dim=-1, keepdim=True) + 1e-9)).clamp_max(1.0)
        fingers = torch.from_numpy(np.stack([lead.fingers for lead in leads]))
        force = (way / self._full_speed).float()
        actions = torch.cat([fingers, force, self._torque(held, now).float()], -1).flatten(1)
        # Witnesses of version 1 store bytes. In version 2 a small force must not become 0: a policy that learns from
        # the actions would not move the last millimetre.
        if self._rounds:
            return quantised(actions)
        return actions.clamp(-1.0, 1.0)

    def _torque(self, held: Tensor, now: Tensor) -> Tensor:
        """Return the actions (n, 2, 3) that turn hands to the orientations ``held``; zeros for a free hand.

        A hand is free until a script sets its orientation. ``now`` are the present orientations, (w, x, y, z).
        """
        now = xyzw(now / now.norm(dim=-1, keepdim=True))
        error = multiply(held, conjugate(now))
        way = 2.0 * error[..., :3] * error[..., 3:].sign()  # rotation vector, rad; valid for small angles
        torque = rotate(now, rotate(conjugate(now), way) * constant(ANGULAR_DAMPING, now))
        return GAIN * torque / self._full_torque


def _numbers(quaternion: Tensor) -> _Quaternion:
    w, x, y, z = quaternion.tolist()
    return w, x, y, z


@cache
def _joints() -> tuple[dict[str, int], np.ndarray, np.ndarray]:
    """Return the index of each actuated joint by the joint's name, and the bounds of the targets, rad, float32."""
    low, high = (np.asarray(x, np.float32) for x in (hand().control_low, hand().control_high))
    return {hand().joints[joint]: i for i, joint in enumerate(hand().actuated)}, low, high


def _joint_actions(angles: Iterable[tuple[str, float]]) -> np.ndarray:
    """Return the actions (20,) for joint angles given by name, rad; the angles of all other joints are 0."""
    places, low, high = _joints()
    all_angles = np.zeros_like(low)
    for joint, angle in angles:
        all_angles[places[joint]] = angle
    return np.clip(np.float32(2.0) * (all_angles - low) / (high - low) - np.float32(1.0), -1.0, 1.0)
