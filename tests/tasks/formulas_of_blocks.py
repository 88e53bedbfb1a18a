"""Rewards and success as printed of the classes with blocks, and of water: appendix and docs/figures.md, classes."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tests.tasks.oracle import (
    Goal,
    Judgement,
    Oracle,
    Task,
    at,
    frame,
    length,
    linear,
    pose,
    reach,
    shifted,
    some_tilt,
    start,
    tilt,
    within,
)

FLOOR, RIM = -0.0529, 0.0445
"""Heights of the bucket's lower and upper end in its frame, metres (docs/figures.md, objects)."""
WALL = 0.004
"""How far the middle of the bucket's wall may lie inside its outer face, metres."""
UNSURE = 0.007
"""Whatever lies this near to wall, floor or rim may count either way, metres: their thickness is the project's own."""
MOUTH = (0.0, 0.0, RIM - 0.01)
"""Where the spout shall be of a standing bucket: on its axis, 1 cm below its rim."""
BOTTOM = (0.0, 0.0, -0.049)
"""The middle of the bucket's floor."""
STANDING = 0.457 + BOTTOM[2]
"""Height of that point when the bucket stands on its table, metres."""


def inside(data: mujoco.MjData, point: np.ndarray) -> tuple[bool, bool]:
    """Whether a point surely lies in the bucket, and whether it may."""
    position, turn = frame(data, "bucket/object")
    x, y, z = turn.inv().apply(point - position)
    radius = 0.0298 + (0.0569 - 0.0298) * (z - FLOOR) / (RIM - FLOOR) - WALL
    depth = min(radius - np.hypot(x, y), z - FLOOR, RIM - z)
    return depth > UNSURE, depth > -UNSURE


def kept(data: mujoco.MjData) -> float:
    """How far the bucket is from the tilt of 45 degrees beyond which nothing counts as in it, rad."""
    return np.pi / 4 - tilt(frame(data, "bucket/object")[1])


class Bodies(Oracle):
    """The points of the tables are the origins of these bodies."""

    bodies: ClassVar[tuple[str, str]] = ("block1", "block2")

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {f"{name} position": data.body(f"{name}/object").xpos.copy() for name in self.bodies}


class PushBlock(Bodies):
    """Equation 12."""

    places: ClassVar = {"block1": (-0.2, -0.2, 0.625), "block2": (-0.2, 0.2, 0.625)}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        first, second = self.points(data).values()
        d_1, d_2 = length(first - np.array(self.places["block1"])), length(second - np.array(self.places["block2"]))
        terms = linear(data, first, second, 5 * (0.8 - (d_1 + d_2)), 2.0)
        return within(terms, d_1 - 0.1, d_2 - 0.1)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Both near their places, now and then exchanged."""
        places = list(self.places.values())[:: -1 if rng.random() < 0.1 else 1]
        return {
            name: pose(shifted(np.array(place), *rng.uniform(-0.1, 0.1, 2), 0.005), Rotation.identity())
            for name, place in zip(self.places, places, strict=True)
        }


class StackBlock(Bodies):
    """Equation 18. Block 1 comes to lie on block 2 (docs/figures.md, decisions)."""

    body_of_goal: ClassVar = {"goal": "block1/object"}
    entering: ClassVar = {"target_x", "target_y"}

    def targets(self, task: Task) -> tuple[np.ndarray, np.ndarray]:
        bottom = np.array((task["target_x"], task["target_y"], 0.625))
        return shifted(bottom, 0, 0, 0.05), bottom

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        return {"goal": (self.targets(task)[0], Rotation.identity())}

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        first, second = self.points(data).values()
        g_1, g_2 = (length(p - t) for p, t in zip((first, second), self.targets(task), strict=True))
        terms = linear(data, first, second, (0.24 - (g_1 + g_2)) * 2, 1.5)
        x, y, z = first - second
        return within(terms, g_1 - 0.03, g_2 - 0.03, abs(z - 0.05) - 0.01, np.hypot(x, y) - 0.03)

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        top, bottom = self.targets(task)
        bottom = shifted(bottom, *rng.uniform(-0.02, 0.02, 2), 0.004)
        top = shifted(top, *rng.uniform(-0.02, 0.02, 2), rng.uniform(0.004, 0.02))
        return {"block1": pose(top, Rotation.identity()), "block2": pose(bottom, Rotation.identity())}


class PourWater(Oracle):
    """Equation 19. Success: at least a third of the water in the bucket, which is upright."""

    body_of_goal: ClassVar = {"goal": "kettle/object"}
    spout, handle = (-0.2, 0.0, 0.07), (0.15, 0.0, 0.0)

    def points(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        return {
            "kettle handle position": at(data, "kettle/object", self.handle),
            "bucket position": data.body("bucket/object").xpos.copy(),
        }

    def goals(self, data: mujoco.MjData, task: Task) -> dict[str, Goal]:
        """The mouth of the standing bucket, lower if it is lifted; the kettle's start, its spout 40 degrees down."""
        lift = max(0.0, at(data, "bucket/object", BOTTOM)[2] - STANDING)
        mouth = at(data, "bucket/object", MOUTH)
        down = Rotation.from_rotvec([0.0, -np.deg2rad(40.0), 0.0])
        return {"goal": (shifted(mouth, 0, 0, -min(5 * lift, lift + 0.2)), start(data, "kettle", task)[1] * down)}

    @staticmethod
    def water(data: mujoco.MjData) -> list[str]:
        bodies = [data.model.body(i).name for i in range(data.model.nbody)]
        return [name.removesuffix("/object") for name in bodies if name.startswith("water")]

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        handle, bucket = self.points(data).values()
        d_target = length(at(data, "kettle/object", self.spout) - self.goals(data, task)["goal"][0])
        terms = linear(data, bucket, handle, (0.5 - d_target) * 2, 1.0)
        drops = [inside(data, data.body(f"{drop}/object").xpos) for drop in self.water(data)]
        surely, perhaps = (3 * sum(found) >= len(drops) for found in zip(*drops, strict=True))
        upright = kept(data)
        return Judgement(terms, surely and upright > 0, False, 0.0 if surely != perhaps else abs(upright))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Some of the drops in the middle of the bucket, which is somewhat lifted and tipped."""
        position, turn = start(data, "bucket", task)
        position, turn = shifted(position, 0, 0, rng.choice((0.0, 0.06))), some_tilt(rng, 1.2) * turn
        drops = self.water(data)
        parts = {"bucket": pose(position, turn)}
        for i, drop in enumerate(drops[: rng.integers(0, len(drops) + 1)]):
            place = position + turn.apply((0.012 * (i % 3 - 1), 0, 0.012 * (i // 3) - 0.02))
            parts |= {f"{drop}/{axis}": place[k : k + 1] for k, axis in enumerate("xyz")}
        return parts


class GraspAndPlace(Bodies):
    """The original's formula with one hand point a hand (docs/figures.md, classes).

    Success: the block's centre in the bucket, which is upright.
    """

    bodies = ("bucket", "block")

    def judge(self, data: mujoco.MjData, task: Task) -> Judgement:
        bucket, block = self.points(data).values()
        distances = (*reach(data, block, bucket), length(bucket - block))
        left, right, near = (float(np.exp(-10 * distance)) for distance in distances)
        terms = {"left": left, "right": right, "target": 2 * near}
        surely, perhaps = inside(data, block)
        upright = kept(data)
        return Judgement(terms, surely and upright > 0, False, 0.0 if surely != perhaps else abs(upright))

    def scatter(self, data: mujoco.MjData, task: Task, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """The block over the middle of the bucket, beside it, under it or over its rim, the bucket any way up."""
        position, turn = start(data, "bucket", task)
        turn = some_tilt(rng, 1.2 if rng.random() < 0.8 else np.pi) * turn
        elsewhere = ((0.12, 0.0, 0.0), (0.0, 0.0, -0.085), (0.0, 0.0, 0.08))[rng.integers(3)]
        place = elsewhere if rng.random() < 0.3 else (0.0, 0.0, rng.uniform(0.01, 0.025))
        return {"bucket": pose(position, turn), "block": pose(position + turn.apply(place), turn)}
