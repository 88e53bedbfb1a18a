"""Gymnasium's and stable-baselines3's own wrappers and checkers: the rows of the table in docs/clients.md."""

import sys
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers import vector as wrap

import bidex_meta  # noqa: F401
from bidex_meta.errors import BidexError
from bidex_meta.world.wrapper import NumpyWorld
from tests.clients.test_adapters import ROWS, points
from tests.world.play import class_world, suite_world

ID = "bidex-meta/CatchUnderarm-v1"
PICTURE = (4, 6, 3)


@pytest.fixture
def films(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[np.ndarray]]:
    """Stands in for moviepy, which RecordVideo writes with and which is no dependency here, and for drawing."""
    written: dict[str, list[np.ndarray]] = {}

    class ImageSequenceClip:
        def __init__(self, frames: list[np.ndarray], fps: int) -> None:
            assert fps == 60
            self.frames = frames

        def write_videofile(self, path: str, logger: Any = None) -> None:
            written[Path(path).name] = self.frames

    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["moviepy.video.io.ImageSequenceClip"].ImageSequenceClip = ImageSequenceClip  # type: ignore[attr-defined]
    draw = lambda painter, world, row, *view: np.full(PICTURE, row, np.uint8)  # noqa: E731
    monkeypatch.setattr("bidex_meta.world.rendering.Painter.picture", draw)
    return written


def single(**more: Any) -> gymnasium.Env:
    return gymnasium.make(ID, **more)


def episode(env: gymnasium.Env) -> tuple[int, dict[str, Any]]:
    """Plays one; its length and last info."""
    env.reset(seed=0)
    for step in range(1, 76):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            return step, info
    raise AssertionError("no end within the time limit")


def test_sb3s_checker_on_the_single_environment() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra sb3")
    env = single().unwrapped  # Gymnasium warns that there is a version 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)


def test_sb3_counts_episodes_of_the_single_environment() -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra sb3")
    learner = sb3.PPO("MlpPolicy", ID, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    learner.learn(256)
    monitor: Any = learner.get_env().envs[0]
    told = [(e["r"], e["l"]) for e in learner.ep_info_buffer]
    own = zip(monitor.get_episode_rewards(), monitor.get_episode_lengths(), strict=True)
    assert len(told) > 2 and told == [(pytest.approx(r, abs=1e-6), n) for r, n in own]
    assert len(learner.ep_success_buffer) == len(told)


def test_video_of_the_single_environment(films: dict[str, list[np.ndarray]], tmp_path: Path) -> None:
    env = RecordVideo(single(render_mode="rgb_array"), str(tmp_path), episode_trigger=lambda _: True)
    steps, _ = episode(env)
    env.close()
    assert [frame.shape for frame in films["rl-video-episode-0.mp4"]] == [PICTURE] * (steps + 1)


def test_render_modes_of_make_vec() -> None:
    for env_id in (ID, "bidex-meta/MT4-v1"):
        world = gymnasium.make_vec(env_id, num_envs=4, render_mode="rgb_array", device="cpu", threads=1)
        assert world.render_mode == "rgb_array"
        with pytest.raises(BidexError, match="render_mode: expected None or 'rgb_array', got 'human'"):
            gymnasium.make_vec(env_id, num_envs=4, render_mode="human")


def test_statistics_of_the_numpy_form_are_the_worlds_own() -> None:
    """1,000 episodes of points; the first, shortened ones the world does not count."""
    env = wrap.RecordEpisodeStatistics(NumpyWorld(points(), stagger=True), buffer_length=10_000)
    env.reset(seed=0)
    generator, first, seen = np.random.default_rng(0), np.ones(ROWS, bool), 0
    while seen < 1000:
        _, _, terminated, truncated, info = env.step(generator.uniform(-1, 1, (ROWS, 2)))
        ended = terminated | truncated
        assert ("final_obs" in info) == ("final_info" in info) == ("episode" in info) == bool(ended.any())
        if not ended.any():
            continue
        final = info["final_info"]["episode"]
        whole = info["final_info"]["_episode"]
        assert (whole == ended)[~first].all() and (info["_final_info"] == ended).all()
        for name in ("r", "l"):
            np.testing.assert_allclose(final[name][whole], info["episode"][name][whole], rtol=1e-6, atol=1e-6)
        assert [each is not None for each in info["final_obs"]] == ended.tolist() == info["_final_obs"].tolist()
        first &= ~ended
        seen += int(whole.sum())


def test_the_numpy_form_is_the_world() -> None:
    """The same numbers, and what an episode ended with."""
    world, env = suite_world("MT4", 8), suite_world("MT4", 8).to_numpy(stagger=True)
    np.testing.assert_array_equal(world.reset(seed=0)[0], env.reset(seed=0)[0])
    env.action_space.seed(0)
    for _ in range(80):
        action = env.action_space.sample()
        expected, found = world.step(action), env.step(action)
        for a, b in zip(expected[:4], found[:4], strict=True):
            np.testing.assert_array_equal(a, b)
            assert isinstance(b, np.ndarray)
        for row in np.flatnonzero(found[-1].get("_final_obs", [])):
            np.testing.assert_array_equal(found[-1]["final_obs"][row], expected[-1]["final_obs"][row])
        np.testing.assert_array_equal(found[-1]["success"], expected[-1]["success"])
    mask = np.arange(8) < 2
    env.reset(options={"reset_mask": mask})
    assert env.world.episodes.length[:2].tolist() == [0, 0]  # type: ignore[attr-defined]


def test_video_of_the_numpy_form(films: dict[str, list[np.ndarray]], tmp_path: Path) -> None:
    env = wrap.RecordVideo(class_world("CatchUnderarm", 4).to_numpy(), str(tmp_path), video_length=5)
    env.reset(seed=0)
    for _ in range(6):
        env.step(env.action_space.sample())
    env.close()
    (frames,) = films.values()
    assert [frame.shape for frame in frames] == [(8, 12, 3)] * 6 and set(np.unique(frames[0])) == {0, 1, 2, 3}


def test_video_of_stable_baselines3(films: dict[str, list[np.ndarray]], tmp_path: Path) -> None:
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason="needs the extra sb3")
    world = import_module("bidex_meta.clients.sb3_env").SB3VecEnv(class_world("CatchUnderarm", 4))
    env = vec_env.VecVideoRecorder(world, str(tmp_path), lambda step: step == 0, video_length=5)
    env.reset()
    for _ in range(6):
        env.step(np.zeros((4, 52), np.float32))
    env.close()
    (frames,) = films.values()
    assert len(frames) == 6 and {frame.shape for frame in frames} == {(8, 12, 3)}
    assert set(np.unique(frames[0])) == {0, 1, 2, 3}


def test_other_wrappers_of_the_numpy_form() -> None:
    env = wrap.NormalizeReward(wrap.RescaleAction(suite_world("MT4", 8).to_numpy(), 0.0, 1.0))
    env.reset(seed=0)
    reward = env.step(np.zeros((8, 52), np.float32))[1]
    assert reward.shape == (8,) and np.isfinite(reward).all()
    env = wrap.NormalizeObservation(suite_world("MT4", 8, "NEXT_STEP").to_numpy())
    env.reset(seed=0)
    assert np.isfinite(env.step(np.zeros((8, 52), np.float32))[0]).all()
    listed = wrap.DictInfoToList(suite_world("MT4", 8).to_numpy())
    listed.reset(seed=0)
    assert len(listed.step(np.zeros((8, 52), np.float32))[-1]) == 8
