"""ReOrientation: appendix A.2.13; docs/figures.md, classes."""

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks import eggs
from bidex_meta.tasks.base import FIRM, TaskClass
from bidex_meta.tasks.goals import frozen_goal
from bidex_meta.tasks.scene import SceneObject
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import orientation
from bidex_meta.utils.maths import constant, multiply, rotation_angle, wxyz, xyzw

_BOUNDING_RADIUS = 0.0434
"""Half the space diagonal of a cube with an edge of 5 cm, metres."""
_POSITION_NOISE, _JOINT_NOISE = 0.01, 0.2
_GOALS = ((0.0, -0.76, 0.56), (0.0, -0.39, 0.56))
_HALF = (0.025, 0.025, 0.025)
_START_ANGLE = 0.5
"""No cube starts within this of its goal's orientation, rad."""
_SUCCESS_ANGLE = 0.2
"""Each cube's rotation to its goal below this, rad."""
_SUCCESS_DISTANCE = 0.1
"""Each cube within this of its goal's place, metres."""


class ReOrientation(TaskClass):
    """Turn the two cubes that lie on the hands to one common orientation.

    No table. Observation: Table 32 (446). Object 1 lies on the left hand (-y), as the formula's pairing asks; the
    original's lies on the right. Bases move as the appendix says (52 actions), with the scales of CatchUnderarm. No
    episode ends early, since the reward is negative.

    Both cubes start with the same random orientation 10 cm above the mounts and drop onto the palms; fingers that the
    start noise would push into a cube's bounding sphere are opened.
    """

    needs = Capacity(26, 0, 67)
    name = "ReOrientation"
    summary = "Turn two cubes on the hands to a given orientation"
    formula = "-10 (d1 + d2) - 1.5 (r1 + r2), distance and angle of each cube and its goal"
    solved = "both cubes within 0.2 rad of the goal's orientation, each within 10 cm of its place"
    deviations = (
        "The printed formula adds the angles, which would reward larger ones; here they are subtracted.",
        "A goal lasts for the episode; the original draws a new one when it is reached.",
        "Success asks for both cubes' turns and places; the original's for the turn of the second cube.",
        "A start within 0.5 rad of the goal is turned by half a turn: about 2 % of the starts depend on the goal.",
    )
    episode_steps = 600
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale, orientation_scale = 0.05, 0.5
    start_draws = eggs.JOINT_DRAWS + 5
    solver = FIRM
    variation_space = orientation("goal")
    blocks = eggs.goal_object_blocks("12")

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        SceneObject("object1", "cube", (0.0, -0.76, 0.60), colour=(0.85, 0.43, 0.30, 1.0)).add_to(scene)
        SceneObject("object2", "cube", (0.0, -0.39, 0.60)).add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``goal1``, ``goal2``: poses (n, 7); ``..._inverse``: inverses of their rotations (n, 4)."""
        frozen = {}
        for i, centre in enumerate(_GOALS, start=1):
            position = variation.new_tensor(centre).expand(len(variation), 3)
            frozen |= frozen_goal(eggs.goal_pose(position, variation), f"goal{i}")
        return frozen

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        eggs.start_hands(draws[:, : eggs.JOINT_DRAWS], _JOINT_NOISE, qpos)
        for i, side, pose in ((1, "left", self.left), (2, "right", self.right)):
            cube = qpos[f"object{i}"]
            eggs.start_egg(cube, draws[:, eggs.JOINT_DRAWS :], _POSITION_NOISE)
            _turn_away(cube, frozen[f"goal{i}_inverse"])
            eggs.lay_egg_on_hand(cube, qpos[f"{side}/joints"], pose, _BOUNDING_RADIUS, _BOUNDING_RADIUS)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        return eggs.observe_goals(state, "12")

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        (first, first_angle), (second, second_angle) = self._distances(state)
        return {"left": -10.0 * first, "right": -10.0 * second, "target": -1.5 * (first_angle + second_angle)}

    def success(self, state: TaskState) -> Tensor:
        (first, first_angle), (second, second_angle) = self._distances(state)
        turned = (first_angle < _SUCCESS_ANGLE) & (second_angle < _SUCCESS_ANGLE)
        return turned & (first < _SUCCESS_DISTANCE) & (second < _SUCCESS_DISTANCE)

    def _distances(self, state: TaskState) -> list[tuple[Tensor, Tensor]]:
        """Per cube its distance (m) and rotation (rad) to its goal, each (n,)."""
        return [eggs.distances(state, f"object{i}", f"goal{i}") for i in (1, 2)]

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        return [(frozen[f"goal{i}"], _HALF) for i in (1, 2)]


def _turn_away(cube: Tensor, goal_inverse: Tensor) -> None:
    """Turns cubes (n, 7) near their goal's orientation by half a turn about the world's x axis, in place."""
    now = xyzw(cube[:, 3:])
    near = rotation_angle(multiply(now, goal_inverse)) < _START_ANGLE
    turned = multiply(constant((1.0, 0.0, 0.0, 0.0), now).expand_as(now), now)
    cube[:, 3:] = wxyz(torch.where(near[:, None], turned, now))
