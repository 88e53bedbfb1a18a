"""Each class's camera has the start in view: both hands, objects and goal, none behind a hand."""

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.hands.hand import SIDES
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.tasks.state import TaskState

_OF_HANDS = tuple(f"{side}/" for side in SIDES)


@pytest.mark.parametrize("name", registry.names())
def test_the_camera_sees_hands_objects_and_goal(name):
    scene = compile_scene(registry.get(name, True))
    task, model = scene.task, scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = scene.start_qpos[: model.nq]
    mujoco.mj_forward(model, data)
    azimuth, elevation = np.radians(task.camera_angle)
    forward = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
    eye = np.array(task.camera_target) - task.camera_distance * forward
    right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
    half = np.tan(np.radians(0.5 * model.vis.global_.fovy))

    def in_view(point):
        away = point - eye
        across, up = (away @ axis / (away @ forward) for axis in (right, np.cross(right, forward)))
        return bool(away @ forward > 0.0 and abs(up) < half and abs(across) < half * 4.0 / 3.0)

    for side in SIDES:
        assert in_view(data.site(f"{side}/hand_point").xpos), side
    space = task.variation_space
    middle = torch.tensor(0.5 * (np.array(space.low) + np.array(space.high)))[None]
    state = TaskState(torch.from_numpy(data.sensordata.copy())[None], scene.sensors, task.freeze(middle))
    goals = [ghost.pose[0, :3].numpy() for ghost in task.ghosts(state)]
    objects = [data.body(i).xpos for i in range(model.nbody) if model.body(i).name.endswith("/object")]
    hit = np.zeros(1, np.int32)
    for point in (*goals, *objects):
        assert in_view(point), point
        way = point - eye
        distance = mujoco.mj_ray(model, data, eye, way, None, 1, -1, hit)
        seen = model.body(model.geom_bodyid[hit[0]]).name if 0.0 <= distance < 0.97 else ""
        assert not seen.startswith(_OF_HANDS), (point, seen)
