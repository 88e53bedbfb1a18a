"""Pictures: which renderers are made. What they show is looked at by people."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.benchmark import Benchmark, make_task_world
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


def gl_or_skip():
    try:
        gl_backend.prepare()
    except BidexError as error:
        pytest.skip(str(error))


def test_every_thread_draws():
    gl_or_skip()
    world = make_task_world("CatchUnderarm", 2, "cpu", seed=0, threads=1, autoreset_mode="DISABLED")
    world.reset(seed=0)
    here = world.render(1, 48, 36)
    for _ in range(2):  # the second is likely to have the number of the first
        with ThreadPoolExecutor(1) as thread:
            assert np.array_equal(thread.submit(world.render, 1, 48, 36).result(), here)
    assert np.array_equal(world.render(1, 48, 36), here)
    world.close()


def test_pixels_show_what_moves():
    gl_or_skip()
    world = make_task_world("CatchUnderarm", 2, "cpu", seed=0, threads=1, autoreset_mode="DISABLED", pixels=48)
    first = world.reset(seed=0)[1]["pixels"]
    assert first.float().std() > 20.0
    for _ in range(10):
        info = world.step(torch.tensor([[0.0] * 52, [1.0] * 52]))[4]
    differs = (info["pixels"].int() - first.int()).abs().amax(dim=(1, 2, 3))
    assert (differs > 60).all() and not torch.equal(info["pixels"][0], info["pixels"][1])
    assert np.array_equal(info["pixels"][1].numpy(), world.render(1, 48, 48))
    world.close()


EDGE = 64
MOST_APART = 9.0
"""Mean difference of a channel between the two renderers, of 255; measured: 5.1 to 6.7. Edges are smooth in MuJoCo's
pictures only, and light is computed per vertex there, per pixel in mujoco_warp's."""


def both_renderers(world):
    """The pictures by mujoco_warp and by MuJoCo of the same state."""
    painter = rendering.Painter()
    batched = painter.pictures(world, EDGE)
    with pytest.MonkeyPatch.context() as patch:
        for part in world.parts:
            patch.setattr(type(part.group.engine), "has_renderer", False)
        single = painter.pictures(world, EDGE)
    painter.close()
    return batched, single


def apart(one, other):
    return (one.float() - other.float()).abs()


@pytest.mark.timeout(900)  # a cold cache compiles for a minute and more
@pytest.mark.xdist_group("warp")
@pytest.mark.parametrize("name", ["CatchUnderarm-v2", "DoorOpenOutward-v2"])
def test_mujoco_warp_draws_what_mujoco_draws(name):
    gl_or_skip()
    world = make_task_world(name, 3, "cpu", seed=0, engine="warp", autoreset_mode="DISABLED", pixels=EDGE)
    world.reset(seed=0)
    generator = torch.Generator().manual_seed(0)
    for _ in range(15):
        info = world.step(2.0 * torch.rand(3, world.action_size, generator=generator) - 1.0)[4]
    batched, single = both_renderers(world)
    assert torch.equal(info["pixels"], batched) and batched.dtype == torch.uint8
    assert (apart(batched, single).mean(dim=(1, 2, 3)) < MOST_APART).all()
    table = torch.stack([apart(batched, single.roll(-j, 0)).mean(dim=(1, 2, 3)) for j in range(3)])
    assert (table.argmin(0) == 0).all()  # each is most like MuJoCo's picture of its own state
    world.close()


@pytest.mark.timeout(900)
@pytest.mark.xdist_group("warp")
def test_batched_pictures_show_goals_only_if_observations_do():
    gl_or_skip()
    shown, hidden = (
        Benchmark(suite, seed=0).make_world("train", 2, "cpu", engine="warp", autoreset_mode="DISABLED")
        for suite in ("MT1-v2", "ML1-v2")
    )
    pictures = []
    for world in (shown, hidden):
        world.reset(seed=0)
        (part,) = world.parts
        engine = part.group.engine
        engine.reset(torch.ones(2, dtype=torch.bool), engine.placement()[:1].repeat(2, 1))
        assert not torch.equal(*part.tasks[0][world.task_index])
        pictures.append(both_renderers(world))
    (with_goals, single_with), (without, single_without) = pictures
    assert torch.equal(without[0], without[1]) and not torch.equal(with_goals[0], with_goals[1])
    goal = apart(with_goals, without).amax(3) > 8.0
    of_mujoco = apart(single_with, single_without).amax(3) > 8.0
    assert of_mujoco.any(dim=(1, 2)).all()
    assert (goal & of_mujoco).sum() > 0.45 * (goal | of_mujoco).sum()  # 0.6; MuJoCo's is wider by its smooth edge
