"""GraspAndPlace: docs/figures.md, classes (the appendix has a picture of it and no section)."""

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import FAST
from bidex_meta.tasks.bucket import inside_bucket, stands
from bidex_meta.tasks.layout import Block, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, placed
from bidex_meta.tasks.reach import ReachTask, apart
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import join

_TURN = "quaternion (x, y, z, w), world frame"


class GraspAndPlace(ReachTask):
    """Put a block into a bucket: the left hand takes the block, the right hand the bucket.

    Table 1 x 1 m, 60 cm high. Observation: the original's (425; docs/figures.md, observation). Reward: its formula with
    hand-point distances. The original's success, d < 20 cm, is met by a block beside the bucket. A task shifts and
    turns bucket and block. Both start on the table; the original's start inside it. Bucket pose and bucket link have
    one orientation here, so entries 401-404 and 414-417 are equal.
    """

    needs = Capacity(35, 4, 108)
    name = "GraspAndPlace"
    summary = "Put a block into a bucket"
    formula = "exp(-10 d_left) + exp(-10 d_right) + 2 exp(-10 d), d between bucket and block"
    solved = "the block's centre is inside the bucket, which is within 45 degrees of upright"
    deviations = (
        "Success asks that the block be in the upright bucket, the original that it be within 20 cm of the bucket.",
    )
    episode_steps = 500
    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale, orientation_scale = 0.5, 0.1
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
    camera_target, camera_distance = (0.1, 0.0, 0.68), 1.7
    variation_space = join(placed("bucket"), placed("block"))
    blocks = (
        *object_blocks("bucket"),
        point_block("bucket_position", "bucket/position", "origin of the bucket"),
        Block("bucket_link_quaternion", 4, ("bucket/quaternion",), description=_TURN),
        point_block("block_position", "block/position", "centre of the block"),
        Block("block_quaternion", 4, ("block/quaternion",), description=_TURN),
    )

    def target(self, state: TaskState) -> Tensor:
        return 2.0 * torch.exp(-10.0 * apart(state, "bucket/position", "block/position"))

    def success(self, state: TaskState) -> Tensor:
        block, turn = state["block/position"][:, None], state.quaternion("bucket/quaternion")
        return inside_bucket(block, state["bucket/position"], turn)[:, 0] & stands(turn)
