"""Common parts of the classes with tables, doors and tools: a target point for each hand, and the linear reward."""

from abc import abstractmethod
from typing import ClassVar

import mujoco
import torch
from torch import Tensor

from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.goals import Ghost, observe_goal
from bidex_meta.tasks.placement import place_all
from bidex_meta.tasks.scene import Point, SceneObject, Table, add_table
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import norm


def reach(state: TaskState, side: str, point: str) -> Tensor:
    """Return the distance (m) from the hand on ``side`` to the point that the sensor ``point`` gives. Shape (n,).

    The hand's point is the palm's origin + 8 cm along the fingers + 2 cm out of the palm (docs/figures.md, hand point).
    """
    return state.once(("reach", side, point), lambda: norm(state[f"{side}/hand_point_position"] - state[point]))


def apart(state: TaskState, a: str, b: str) -> Tensor:
    """Return the distance (m) between the positions that two sensors give, shape (n,)."""
    return state.once(("apart", a, b), lambda: norm(state[a] - state[b]))


class ReachTask(TaskClass):
    """Base of the classes in which each hand must reach a point, such as a handle.

    The reward is the sum of the terms ``left``, ``right``, ``target`` and ``constant``. ``left`` is -d_left and
    ``right`` is -d_right, where d_left and d_right are the distances (m) of the hands from their points.

    Attributes:
        table: The table of the class.
        objects: Objects that a task shifts and turns, and that an episode jitters. Variations and draws have this
            order.
        points: Names of the sensors that give the points for the left and the right hand.
        constant: Value of the term ``constant``.
        exponential: Whether ``left`` and ``right`` are exp(-10 d_left) and exp(-10 d_right) instead.
        terms: Names of the reward's terms, in the order in which they are summed; a class may leave ``constant`` out.
        ghost: Semi-axes of the ellipsoid that shows the goal in pictures, metres; None: no goal is drawn.
    """

    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale = 0.5
    orientation_scale = 0.1
    table: ClassVar[Table]
    objects: tuple[SceneObject, ...]
    points: ClassVar[tuple[str, str]]
    constant: ClassVar[float] = 0.0
    exponential: ClassVar[bool] = False
    terms: ClassVar[tuple[str, ...]] = ("left", "right", "target", "constant")
    ghost: ClassVar[Point | None] = None
    jittered_hands = ("right", "left")

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        add_table(scene, *self.table)
        for each in self.objects:
            each.add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Return the shift and turn of each object, (n, 3), by the object's name."""
        return {each.name: variation[:, 3 * i : 3 * i + 3] for i, each in enumerate(self.objects)}

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        place_all((each.name for each in self.objects), qpos, frozen, draws)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        if "goal" in state.frozen:
            return observe_goal(state, f"{self.objects[0].name}/quaternion")
        return {}

    @abstractmethod
    def target(self, state: TaskState) -> Tensor:
        """Return the reward's target term, (n,)."""

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        target = self.target(state)
        values = {"target": target, "constant": torch.full_like(target, self.constant)}
        for side, point in zip(("left", "right"), self.points, strict=True):
            distance = reach(state, side, point)
            values[side] = torch.exp(-10.0 * distance) if self.exponential else -distance
        return {term: values[term] for term in self.terms}

    def guides(self, state: TaskState) -> list[Tensor]:
        return [reach(state, side, point) for side, point in zip(("left", "right"), self.points, strict=True)]

    def ghosts(self, state: TaskState) -> list[Ghost]:
        if self.ghost:
            return [Ghost(state.frozen["goal"], self.ghost)]
        return []
