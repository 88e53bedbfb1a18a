"""Pictures: which renderers are made. What they show is looked at by people."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.utils import gl_backend
from bidex_meta.world import rendering


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


def test_pixels_come_with_every_observation_and_change_nothing_else(world, monkeypatch):
    seen = []
    monkeypatch.setattr(rendering, "pose", lambda model, data, placement: seen.append(placement.tolist()))
    plain, pixels = (
        make_task_world("CatchUnderarm", num_envs=3, seed=0, threads=1, stagger=False, pixels=size) for size in (0, 24)
    )
    (obs, none), (same, info) = plain.reset(seed=0), pixels.reset(seed=0)
    assert none == {} and info["pixels"].shape == (3, 24, 24, 3) and info["pixels"].dtype == torch.uint8
    assert torch.equal(obs, same)
    for _ in range(3):
        (obs, *_, none), (same, *_, info) = (each.step(np.ones((3, 52), np.float32)) for each in (plain, pixels))
        assert torch.equal(obs, same) and "pixels" not in none and info["pixels"].shape == (3, 24, 24, 3)
    assert seen[-3:] == pixels.parts[0].group.engine.placement().tolist()
    assert isinstance(pixels.to_numpy().reset(seed=0)[1]["pixels"], np.ndarray)
    for wrong in (-1, 2000, 1.5):
        with pytest.raises(BidexError, match="pixels"):
            make_task_world("CatchUnderarm", num_envs=1, pixels=wrong)  # type: ignore[arg-type]


def test_every_thread_draws():
    try:
        gl_backend.prepare()
    except BidexError as error:
        pytest.skip(str(error))
    world = make_task_world("CatchUnderarm", 2, "cpu", seed=0, threads=1, autoreset_mode="DISABLED")
    world.reset(seed=0)
    here = world.render(1, 48, 36)
    for _ in range(2):  # the second is likely to have the number of the first
        with ThreadPoolExecutor(1) as thread:
            assert np.array_equal(thread.submit(world.render, 1, 48, 36).result(), here)
    assert np.array_equal(world.render(1, 48, 36), here)
    world.close()


def test_pixels_show_what_moves():
    try:
        gl_backend.prepare()
    except BidexError as error:
        pytest.skip(str(error))
    world = make_task_world("CatchUnderarm", 2, "cpu", seed=0, threads=1, autoreset_mode="DISABLED", pixels=48)
    first = world.reset(seed=0)[1]["pixels"]
    assert first.float().std() > 20.0
    for _ in range(10):
        info = world.step(torch.tensor([[0.0] * 52, [1.0] * 52]))[4]
    differs = (info["pixels"].int() - first.int()).abs().amax(dim=(1, 2, 3))
    assert (differs > 60).all() and not torch.equal(info["pixels"][0], info["pixels"][1])
    assert np.array_equal(info["pixels"][1].numpy(), world.render(1, 48, 48))
    world.close()
