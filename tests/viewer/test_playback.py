"""The live view: what is played, the clock, shapes, and the page by a real viser."""

import re
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.utils import gl_backend
from bidex_meta.viewer import playback
from bidex_meta.viewer.browser import Browser, colour, shape, visible
from bidex_meta.viewer.playback import Stage
from bidex_meta.worlds import open_worlds


@pytest.fixture(scope="module")
def world():
    return open_worlds({"suite": "MT4", "threads": 1}).world("train", 4)


@pytest.fixture
def stage(world):
    return Stage(world, ZeroAgent(world.action_space), row=1)


def test_a_stage_plays_on_and_counts_episodes(stage, world, monkeypatch):
    steps = []

    def step(action):
        """The first row ends at once, the others go on; row 1 counts as a success after the second and third step."""
        made = list(type(world).step(world, action))
        made[2] = torch.tensor([True, False, False, False])
        running = {**made[4]["running"], "success": torch.tensor([False, len(steps) in (1, 2), False, False])}
        made[4] = {**made[4], "running": running}
        steps.append(world.episodes.number.tolist())
        return made

    monkeypatch.setattr(world, "step", step)
    before = stage.data().qpos.copy()
    assert stage.status()["step"] == "0 of 75"
    for _ in range(3):
        stage.step()
    assert [number[0] for number in steps] == [0, 1, 2] and [number[1] for number in steps] == [0, 0, 0]
    assert stage.status()["step"] == "3 of 75"
    assert (stage.status()["success"], stage.status()["episodes"]) == ("yes", "0 of 0 solved")
    stage.step()
    assert stage.status()["success"] == "not yet"  # where success counts at the end it may be lost
    assert not np.allclose(stage.data().qpos, before)
    stage.restart()
    assert (stage.status()["step"], stage.status()["success"]) == ("0 of 75", "not yet")
    stage.row = 0
    assert (stage.status()["class"], stage.status()["episodes"]) == (world.task_names[0], "0 of 4 solved")


def test_a_stage_shows_the_agent_every_transition(world):
    seen = []
    agent = ZeroAgent(world.action_space)
    agent.observe = seen.append  # type: ignore[attr-defined]
    stage = Stage(world, agent)
    stage.step()
    stage.step()
    assert [timestep.valid.tolist() for timestep in seen] == [[True] * 4] * 2
    assert torch.equal(seen[0].next_observation, seen[1].observation)


def test_a_tour_goes_to_the_next_class_after_each_episode(world):
    stage = Stage(world, ZeroAgent(world.action_space), row=3, tour=True)
    lengths = [int(most) for most in world.max_episode_steps]
    for _ in range(lengths[3]):
        assert stage.row == 3
        stage.step()
    assert (stage.row, stage.status()["step"]) == (0, f"0 of {lengths[0]}")
    stage.tour = False
    for _ in range(lengths[0]):
        stage.step()
    assert stage.row == 0


def test_the_next_task_moves_the_goal(stage):
    first = stage.ghosts()[0][0].copy()
    stage.next_task()
    assert not np.allclose(stage.ghosts()[0][0], first)
    assert stage.status()["step"] == "0 of 75"


class Screen:
    paused, speed, shown, closed = False, 1.0, 0, False

    def __init__(self, looks):
        self.looks = looks

    def is_open(self):
        self.looks -= 1
        return self.looks >= 0

    def obey(self, stage):
        self.paused = self.looks < 5

    def show(self, stage):
        self.shown += 1

    def close(self):
        self.closed = True


def test_the_clock_steps_sixty_times_a_second_and_shows_thirty(monkeypatch):
    now, steps = [0.0], []
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: now.__setitem__(0, now[0] + seconds))
    monkeypatch.setattr(playback, "time", clock)
    stage = SimpleNamespace(step=lambda: steps.append(now[0]))
    screen = Screen(looks=121)
    playback.play(stage, screen)  # type: ignore[arg-type]
    assert len(steps) == 116 and screen.closed  # of the last five it is paused
    assert np.allclose(np.diff(steps), 1 / 60)
    assert 60 <= screen.shown <= 62
    later = Screen(looks=10_000)
    playback.play(stage, later, seconds=1.0)  # type: ignore[arg-type]
    assert later.closed and later.looks > 9_000


def test_shapes_fill_the_boxes_that_mujoco_knows():
    model = mujoco.MjModel.from_xml_string("""<mujoco>
      <asset><mesh name="m" vertex="0 0 0  1 0 0  0 2 0  0 0 3"/><material name="r" rgba="1 0 0 .5"/></asset>
      <worldbody>
        <geom type="plane" size="1 1 1"/>
        <geom type="sphere" size=".2" material="r"/> <geom type="capsule" size=".1 .3"/>
        <geom type="ellipsoid" size=".1 .2 .3"/> <geom type="cylinder" size=".1 .4"/>
        <geom type="box" size=".1 .2 .3" rgba="0 1 0 1"/> <geom type="mesh" mesh="m"/>
        <geom type="box" size=".1 .1 .1" group="3"/> <geom type="box" size=".1 .1 .1" rgba="0 0 0 0"/>
      </worldbody></mujoco>""")
    shown = visible(model)
    assert shown == [1, 2, 3, 4, 5, 6]
    for geom in shown:
        points, faces = shape(model, geom)
        assert faces.min() == 0 and faces.max() < len(points)
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        assert np.allclose((points.max(0) + points.min(0)) / 2, centre, atol=1e-6)
        assert np.allclose((points.max(0) - points.min(0)) / 2, half, rtol=0.02, atol=1e-6)
    assert colour(model, 1) == (1.0, 0.0, 0.0, 0.5) and colour(model, 5) == (0.0, 1.0, 0.0, 1.0)


def test_the_page_shows_the_row_and_obeys(stage):
    page = Browser(stage, port=18_080)
    try:
        page.show(stage)
        shown = visible(stage.model())
        assert list(page._shapes) == shown
        moved = shown[-1]
        for _ in range(3):
            stage.step()
        page.show(stage)
        assert np.allclose(page._shapes[moved].position, stage.data().geom_xpos[moved])
        assert len(page._ghosts) == len(stage.ghosts()) > 0
        page._class.value, page._pace.value, page._pause.value = stage.names[3], 0.5, True
        page._tour.value = True
        page._asked.append("Another episode")
        page.obey(stage)
        assert (stage.row, page.paused, page.speed) == (3, True, 0.5)
        assert not stage.tour and not page._tour.value, "a chosen class stays"
        page._tour.value = True
        page.obey(stage)
        assert stage.tour, "a tour goes on from there"
        assert len(page._ghosts) == len(stage.ghosts())
        assert f"| class | {stage.names[3]} |" in page._text.content
        stage.row = 0  # as on a tour
        page.show(stage)
        assert page._class.value == stage.names[0] and list(page._shapes) == visible(stage.model())
    finally:
        page.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux names its screen in the environment")
def test_without_the_screen_that_the_environment_names_the_browser_shows_it(monkeypatch, capfd):
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["play", "--task", "CatchUnderarm", "--port", "18345", "--seconds", "0"]) == 0
    assert re.search(r"No window can be opened .*\n(.*\n)*Open http://127.0.0.1:\d+ in", capfd.readouterr().err)


def test_demo_plays_where_there_is_a_screen(monkeypatch):
    played = []
    monkeypatch.setattr(gl_backend, "has_screen", lambda: True)
    monkeypatch.setattr("bidex_meta.cli.play_live.main", played.append)
    monkeypatch.setattr("bidex_meta.cli.render.main", played.append)
    assert main(["demo"]) == main(["demo", "--out", "x.webp"]) == 0
    live, film = played
    assert live == [] and film[0].endswith("MT20-v2") and film[-1].endswith("/x.webp")


def test_what_cannot_be_played_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(gl_backend, "has_screen", lambda: False)
    for flags, told in (
        (["--policy", "random"], "a run folder, --task TASK or --suite SUITE"),
        (["--task", "CatchUnderarms"], "Did you mean 'CatchUnderarm'"),
        (["--task", "CatchUnderarm", "--speed", "0"], "speed"),
        (["--task", "CatchUnderarm", "--browser", "--host", "203.0.113.7"], "cannot be served at --host 203.0.113.7"),
    ):
        assert main(["play", *flags]) == 2
        assert told in capsys.readouterr().err
