"""The part that the four classes with one egg have in common; their files hold the figures."""

from typing import ClassVar

import mujoco
from torch import Tensor

from bidex_meta.tasks import eggs
from bidex_meta.tasks.base import LIGHT, TaskClass
from bidex_meta.tasks.goals import frozen_goal, observe_goal
from bidex_meta.tasks.layout import Layout, both_hands, goal_blocks, object_blocks
from bidex_meta.tasks.scene import SceneObject
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import VariationSpace, box, join, orientation


class OneEgg(TaskClass):
    """Throw an egg to a goal pose at the other hand.

    Attributes:
        egg_start: Nominal start of the egg, world, metres.
        goal_centre: Centre of the goals' box, world, metres.
        position_noise: Half width of the egg's position noise at a start, metres.
        joint_noise: Joint noise at a start, a share of each joint's range.
        lies_on_right_hand: Whether the egg starts on the right palm, so that room is made for it.
        alpha: Weight of the distance in the reward, per metre.
        floor: The episode fails when the egg's height falls to this, metres.
    """

    formula = "exp(-0.2 (50 d + r)), d and r the distance and the angle between egg and goal"
    solved = "egg within 3 cm of its goal"
    egg_start: ClassVar[tuple[float, float, float]]
    goal_centre: ClassVar[tuple[float, float, float]]
    position_noise: ClassVar[float]
    joint_noise: ClassVar[float]
    lies_on_right_hand: ClassVar[bool] = True
    alpha: ClassVar[float] = 50.0
    floor: ClassVar[float]
    start_draws: ClassVar[int] = eggs.JOINT_DRAWS + 5
    solver = LIGHT

    @property
    def variation_space(self) -> VariationSpace:
        """Goal position (world, metres) and the two draws of its orientation."""
        return join(box("goal", self.goal_centre, eggs.GOAL_RANGE), orientation("goal"))

    @property
    def layout(self) -> Layout:
        """Tables 8, 10, 12 and 16."""
        return Layout((*both_hands(self.moving_base), *object_blocks("object", "object"), *goal_blocks("goal")))

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """One egg."""
        SceneObject("object", "egg", self.egg_start).add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``goal``: the goal pose, (n, 7); ``goal_inverse``: the inverse of its rotation, (n, 4)."""
        return frozen_goal(eggs.goal_pose(variation[:, :3], variation[:, 3:]))

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        """Noisy hands, the egg on the right one."""
        eggs.start_hands(draws[:, : eggs.JOINT_DRAWS], self.joint_noise, qpos)
        eggs.start_egg(qpos["object"], draws[:, eggs.JOINT_DRAWS :], self.position_noise)
        if self.lies_on_right_hand:
            eggs.lay_egg_on_hand(qpos["object"], qpos["right/joints"], self.right)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """The goal blocks."""
        return observe_goal(state, "object/quaternion")

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """``pose``: exp(-0.2 (alpha d_t + d_r))."""
        return {"pose": eggs.pose_reward(state, "object", "goal", self.alpha)}

    def success(self, state: TaskState) -> Tensor:
        """The egg within 3 cm of its goal, in whatever orientation."""
        return eggs.distances(state, "object", "goal")[0] < eggs.SUCCESS_DISTANCE

    def failed(self, state: TaskState) -> Tensor:
        """The egg dropped: the reward is positive throughout, so an early end is never worth seeking."""
        return state["object/position"][:, 2] <= self.floor

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        """The goal."""
        return [(frozen["goal"], eggs.SEMI_AXES)]
