"""TwoCatchUnderarm: appendix A.2.4; docs/figures.md, classes."""

from collections.abc import Hashable

import mujoco
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks import eggs
from bidex_meta.tasks.base import LIGHT, TaskClass
from bidex_meta.tasks.goals import frozen_goal, observe_goal
from bidex_meta.tasks.layout import goal_blocks, object_blocks
from bidex_meta.tasks.objects.held import EGG, held_object
from bidex_meta.tasks.scene import SceneObject
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import box, join, orientation

_ALPHA = 50.0
_NOISE = 0.01
_FLOOR = 0.2
_GOALS = {"object1": (0.0, -0.79, 0.54), "object2": (0.0, -0.38, 0.54)}


class TwoCatchUnderarm(TaskClass):
    """Throw two eggs at once, each to the other hand.

    Observation: Table 14 (446). Reward: equation 4. Both goals share one orientation, both eggs one start noise and
    orientation (docs/figures.md, start noise).
    """

    needs = Capacity(42, 8, 57)
    name = "TwoCatchUnderarm"
    summary = "Throw two eggs at once, each to the other hand"
    formula = "exp(-0.2 (50 d1 + r1)) + exp(-0.2 (50 d2 + r2)), distance and angle of each egg and its goal"
    solved = "each egg within 3 cm of its goal in the same step"
    deviations = ("Success asks it of each egg, the original of the sum of both distances (6 cm).",)
    episode_steps = 75
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale = 0.05
    orientation_scale = 0.5
    start_draws = eggs.JOINT_DRAWS + 5
    solver = LIGHT

    def __init__(self, moving_base: bool | None = None, object: str = EGG) -> None:
        """As of ``OneEgg``; there are two of the object."""
        super().__init__(moving_base)
        self.held = held_object(object)
        if self.held is not None:
            self.needs = self.held.needs(self.needs, count=2)

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        return (*super().scene_key, self.held)

    variation_space = join(
        *(box(f"goal{i}", centre, eggs.GOAL_RANGE) for i, centre in enumerate(_GOALS.values(), start=1)),
        orientation("goal"),
    )
    """Both goal positions (world, metres) and the two draws of their common orientation."""
    blocks = (
        *object_blocks("object1", "object1"),
        *goal_blocks("goal1"),
        *object_blocks("object2", "object2"),
        *goal_blocks("goal2"),
    )

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        first, second, green = (0.0, -0.39, 0.54), (0.0, -0.78, 0.54), (0.45, 0.62, 0.30, 1.0)
        if self.held is None:
            SceneObject("object1", "egg", first).add_to(scene)
            SceneObject("object2", "egg", second, colour=green).add_to(scene)
        else:
            self.held.add_to(scene, "object1", first)
            self.held.add_to(scene, "object2", second, green)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``goal1``, ``goal2``: poses (n, 7); ``..._inverse``: inverses of their rotations (n, 4)."""
        first = frozen_goal(eggs.goal_pose(variation[:, :3], variation[:, 6:]), "goal1")
        return first | frozen_goal(eggs.goal_pose(variation[:, 3:6], variation[:, 6:]), "goal2")

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        eggs.start_hands(draws[:, : eggs.JOINT_DRAWS], 0.2, qpos)
        for name, side, pose in (("object1", "right", self.right), ("object2", "left", self.left)):
            eggs.put_down(qpos[name], self.held, draws[:, eggs.JOINT_DRAWS :], _NOISE, qpos[f"{side}/joints"], pose)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        first = observe_goal(state, "object1/quaternion", "goal1")
        return first | observe_goal(state, "object2/quaternion", "goal2")

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """``pose1`` and ``pose2``: exp(-0.2 (alpha d_ti + d_ri))."""
        return {f"pose{i}": eggs.pose_reward(state, f"object{i}", f"goal{i}", _ALPHA) for i in (1, 2)}

    def success(self, state: TaskState) -> Tensor:
        first, second = (eggs.distances(state, f"object{i}", f"goal{i}")[0] for i in (1, 2))
        return (first < eggs.SUCCESS_DISTANCE) & (second < eggs.SUCCESS_DISTANCE)

    def failed(self, state: TaskState) -> Tensor:
        """Either egg dropped; the reward is positive throughout."""
        return (state["object1/position"][:, 2] <= _FLOOR) | (state["object2/position"][:, 2] <= _FLOOR)

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        size = eggs.SEMI_AXES if self.held is None else self.held.half_extents
        return [(frozen["goal1"], size), (frozen["goal2"], size)]
