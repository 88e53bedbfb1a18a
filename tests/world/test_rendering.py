"""Pictures: which renderers are made. What they show is looked at by people."""

import pickle

import mujoco
import numpy as np
import pytest

from bidex_meta.benchmark import make_task_world
from bidex_meta.utils import gl_backend


class FakeRenderer:
    """Counts itself."""

    made = 0
    open = 0

    def __init__(self, model, height, width):
        type(self).made += 1
        type(self).open += 1
        self.scene = mujoco.MjvScene(model, maxgeom=200)
        self.picture = np.zeros((height, width, 3), np.uint8)

    def update_scene(self, data, camera):
        assert camera.distance > 0

    def render(self):
        return self.picture.copy()

    def close(self):
        type(self).open -= 1


@pytest.fixture
def world(monkeypatch):
    monkeypatch.setattr(gl_backend, "prepare", lambda: None)
    monkeypatch.setattr(mujoco, "Renderer", FakeRenderer)
    FakeRenderer.made = FakeRenderer.open = 0
    made = make_task_world("CatchUnderarm", num_envs=3, seed=0, autoreset_mode="DISABLED", threads=1)
    made.reset(seed=0)
    return made


def test_one_renderer_draws_a_film_and_closes_with_the_world(world):
    for row in (0, 1, 2, 0):
        assert world.render(row, 64, 48).shape == (48, 64, 3)
    assert FakeRenderer.made == 1
    world.render(0, 400, 300)
    assert FakeRenderer.made == FakeRenderer.open == 2
    assert pickle.loads(pickle.dumps(world._painter))._renderers == {}
    world.close()
    assert FakeRenderer.open == 0
