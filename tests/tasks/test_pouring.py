"""PourWater pays for pouring alone: not for an upright kettle, whatever is done with the bucket."""

from collections.abc import Iterator
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.tasks.formulas import BOTTOM, FORMULAS, MOUTH
from tests.tasks.oracle import about_z, at, length, pose, shifted
from tests.tasks.worlds import Lens, observe, scene_of, set_pose, task_of, world_of

SPOUT = (-0.2, 0.0, 0.07)
TABLE, KETTLE, BUCKET = 0.4, 0.478, 0.457
"""Heights of the table's top and of the origins of kettle and bucket that stand on it, metres."""
FOOT = (0.0905, 0.074)
"""Radius of the kettle's foot and its depth below the origin, metres."""
TOUCH = 0.001
ROWS = 400


class Scene:
    """Kettle and bucket where they are put, alone with the table; the rest is not looked at."""

    def __init__(self) -> None:
        world = world_of("PourWater", True, 1)
        world.reset(seed=0)
        self.scene, self.task = scene_of(world), task_of(world, 0)
        self.lens, self.place = Lens(self.scene.model), self.scene.start_qpos.copy()

    def put(self, kettle: np.ndarray, bucket: np.ndarray) -> mujoco.MjData:
        """Frames and contacts of two poses (7,)."""
        self.place[self.scene.qpos["kettle"]], self.place[self.scene.qpos["bucket"]] = kettle, bucket
        return self.lens.look(self.place)

    def apart(self, data: mujoco.MjData) -> bool:
        """Whether neither of the two is in the other or in the table."""
        names = ("kettle/object", "bucket/object")
        pairs = [[self.root(data, geom) for geom in contact.geom] for contact in data.contact]
        return not any(
            contact.dist < -TOUCH and set(pair) <= {*names, "world"}
            for contact, pair in zip(data.contact, pairs, strict=True)
        )

    def root(self, data: mujoco.MjData, geom: int) -> str:
        return data.model.body(data.model.body_rootid[data.model.geom_bodyid[geom]]).name

    def target(self, data: mujoco.MjData) -> float:
        return FORMULAS["PourWater"].judge(data, self.task).terms["target"]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def upright_kettle() -> np.ndarray:
    return pose(np.array((0.0, 0.0, KETTLE)), about_z(np.pi / 2))


def tilted_kettle(degrees: float, spout: np.ndarray) -> np.ndarray:
    """Pose of a kettle whose spout, lowered towards -y, is at a place."""
    turn = about_z(np.pi / 2) * Rotation.from_rotvec([0.0, -np.deg2rad(degrees), 0.0])
    return pose(spout - turn.apply(SPOUT), turn)


def lowest_spout(degrees: float) -> float:
    """Height of the spout of a kettle that is tilted about the edge of its foot on the table."""
    along, above = -SPOUT[0] - FOOT[0], SPOUT[2] + FOOT[1]
    return TABLE + above * np.cos(np.deg2rad(degrees)) - along * np.sin(np.deg2rad(degrees))


def buckets_at(spout: np.ndarray, number: int) -> Iterator[np.ndarray]:
    """Poses of buckets turned in any way, whose mouth is at a place, give or take 5 mm."""
    rng = np.random.default_rng(0)
    for _ in range(number):
        turn = Rotation.random(random_state=rng)
        yield pose(spout + rng.uniform(-0.005, 0.005, 3) - turn.apply(MOUTH), turn)


def test_a_bucket_that_is_tipped_under_an_upright_kettle_pays_less_than_pouring(scene: Scene) -> None:
    """Many poses bring the mouth to the spout; none of them, intersecting or not, comes near what pouring pays."""
    spout = at(scene.put(upright_kettle(), upright_kettle()), "kettle/object", SPOUT)
    free, best = 0, -np.inf
    for bucket in buckets_at(spout, ROWS):
        data = scene.put(upright_kettle(), bucket)
        assert length(at(data, "bucket/object", MOUTH) - at(data, "kettle/object", SPOUT)) < 0.01
        free += scene.apart(data)
        best = max(best, scene.target(data))
    standing = scene.put(upright_kettle(), pose(np.array((*spout[:2], BUCKET)), Rotation.identity()))
    best = max(best, scene.target(standing))
    assert free >= 5, "the sweep meets poses that are possible"
    assert best < 0.89 and poured(scene, 60) > 0.98 and poured(scene, 45) > 0.96


def poured(scene: Scene, degrees: float) -> float:
    """The most that a kettle of this tilt is paid for over a standing bucket, neither in the other."""
    mouth = np.array((0.0, -0.3, BUCKET + MOUTH[2]))
    bucket = pose(np.array((0.0, -0.3, BUCKET)), Rotation.identity())
    found = []
    for y in np.arange(-0.05, 0.061, 0.01):
        for z in np.arange(-0.06, 0.081, 0.004):
            if mouth[2] + z < lowest_spout(degrees):
                continue
            data = scene.put(tilted_kettle(degrees, shifted(mouth, 0.0, y, z)), bucket)
            if scene.apart(data):
                found.append(scene.target(data))
    return max(found)


def test_what_a_tilt_pays_rises_until_all_water_is_out(scene: Scene) -> None:
    pays = [poured(scene, degrees) for degrees in (0, 15, 28, 40, 60)]
    assert all(more > less + 0.01 for less, more in pairwise(pays)), pays
    assert pays[2] < 0.94, "below 30 degrees no water leaves"


@pytest.mark.parametrize("degrees", [0, 15, 25])
def test_no_bucket_helps_a_kettle_that_does_not_pour(scene: Scene, degrees: float) -> None:
    """Kettle on the edge of its foot; buckets lifted, tipped or both, their mouth at the spout or below it."""
    rng = np.random.default_rng(1)
    spout = np.array((0.0, -0.2, lowest_spout(degrees) + 0.0005))
    kettle, best = tilted_kettle(degrees, spout), -np.inf
    for _ in range(ROWS):
        size, direction = rng.uniform(0, 1.5), rng.uniform(-np.pi, np.pi)
        turn = Rotation.from_rotvec(size * np.array((np.cos(direction), np.sin(direction), 0.0)))
        mouth = shifted(spout, *rng.normal(0, 0.015, 2), -rng.exponential(0.03))
        data = scene.put(kettle, pose(mouth - turn.apply(MOUTH), turn))
        if scene.apart(data):
            best = max(best, scene.target(data))
    assert best < 0.94


@pytest.mark.parametrize(
    ("lift", "degrees", "sunk"), [(0.0, 0.0, 0.0), (0.02, 0.0, 0.1), (0.3, 0.0, 0.5), (0.02, 60.0, 0.1)]
)
def test_the_goal_sinks_as_the_bucket_is_lifted(lift: float, degrees: float, sunk: float) -> None:
    """The class's own goal entry, for buckets whose floor is lifted so far, and its distance in the reward."""
    world = world_of("PourWater", True, 1)
    world.reset(seed=0)
    turn = Rotation.from_rotvec([np.deg2rad(degrees), 0.0, 0.0])
    floor = np.array((0.1, -0.3, BUCKET + BOTTOM[2] + lift))
    set_pose(world, 0, "bucket", pose(floor - turn.apply(BOTTOM), turn))
    mouth = floor - turn.apply(BOTTOM) + turn.apply(MOUTH)
    task_class = world.slots[0].task_class
    goal = observe(world)[0, task_class.layout.range("goal_pose")][:3]
    np.testing.assert_allclose(goal, mouth - (0.0, 0.0, sunk), atol=1e-5)
    (_, _, state), *_ = world.parts[0].states(world.task_index)
    distance = length(state["kettle/spout_position"][0].numpy() - goal)
    assert float(task_class.reward_terms(state)["target"]) == pytest.approx(2 * (0.5 - distance), abs=1e-5)
