"""``bidex-meta render``: pictures and films, of policies that fit."""

import imageio.v3 as imageio
import pytest
from PIL import Image

from bidex_meta.cli import looking, main
from bidex_meta.cli.parsing import LookFlags
from bidex_meta.config import RunConfig
from bidex_meta.experiments.run_config import resolve
from bidex_meta.runs import RunFolder
from bidex_meta.tasks import registry
from bidex_meta.worlds.own import OwnSuite, SingleClass
from tests.cli.conftest import toy
from tests.cli.small_runs import run


@pytest.fixture
def toy_class(monkeypatch, toy_worlds):
    """The first class of ``ToyWorld`` on its own."""
    monkeypatch.setattr(registry, "names", lambda: ["Near"])
    monkeypatch.setattr(SingleClass, "world", toy)
    monkeypatch.setattr(SingleClass, "task_classes", lambda source: {source.name: None})


def test_render_picture_and_film(toy_class, tmp_path, capsys):
    flags = ["render", "--task", "Near", "--width", "64", "--height", "48", "--policy", "random"]
    assert main([*flags, "--out", str(tmp_path / "a.png"), "--steps", "2"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'a.png'}\n"
    assert imageio.imread(tmp_path / "a.png")[0, :, 0].tolist() == [0] * 2 + [255] * 62
    assert main(["render", "--task", "Nearer", "--out", str(tmp_path / "b.png")]) == 2
    assert "Did you mean 'Near'?" in capsys.readouterr().err


def test_render_refuses_a_policy_of_other_observations(monkeypatch, toy_class, tmp_path, capsys):
    monkeypatch.setattr(OwnSuite, "task_classes", lambda source: {"Near": None})
    monkeypatch.setattr(OwnSuite, "tasks", lambda source, split: {"Near": ["0"]})
    assert run("--steps", 24, "--run-dir", tmp_path / "a", "--no-evaluate") == 0
    flags = ["render", "--task", "Near", "--width", "64", "--height", "48", "--policy", str(tmp_path / "a")]
    capsys.readouterr()
    assert main([*flags, "--out", str(tmp_path / "a.png"), "--steps", "2"]) == 0
    shape = {"observations": 7, "actions": 1}
    monkeypatch.setattr(looking, "load_checkpoint", lambda *_: ({"learner": {"policy": {"shape": shape}}}, 24))
    assert main([*flags, "--out", str(tmp_path / "b.png"), "--steps", "2"]) == 2
    assert "takes 7 observations" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "shown"),
    [
        ({}, "CatchUnderarm-mug"),
        ({"task": "catchunderarm"}, "CatchUnderarm-mug"),
        ({"task": "CatchUnderarm", "object": "block"}, "CatchUnderarm-block"),
        ({"task": "CatchAbreast"}, "CatchAbreast"),
    ],
)
def test_a_policy_is_shown_with_the_object_of_its_run(flags, shown, tmp_path):
    config = resolve(RunConfig(task="CatchUnderarm", object="mug", algo="ppo", device="cpu"))
    run = RunFolder.create(config, tmp_path / "run")
    assert looking.looked_at(LookFlags(run=run.path, **flags))[2] == shown


@pytest.mark.parametrize(("flags", "switches"), [({}, "pyramids"), ({"task": "CatchAbreast-v2"}, "")])
def test_a_policy_is_shown_with_the_physics_of_its_run(flags, switches, tmp_path):
    config = resolve(RunConfig(task="CatchUnderarm-v2", switches="pyramids", algo="ppo", device="cpu"))
    run = RunFolder.create(config, tmp_path / "run")
    assert looking.looked_at(LookFlags(run=run.path, **flags))[0].switches == switches


def test_a_run_is_filmed_with_all_its_classes_beside_each_other(monkeypatch, toy_class, tmp_path, capsys):
    monkeypatch.setattr(OwnSuite, "task_classes", lambda source: {"Near": None})
    monkeypatch.setattr(OwnSuite, "tasks", lambda source, split: {"Near": ["0"], "Far": ["0"]})
    path = tmp_path / "a"
    assert run("--steps", 24, "--run-dir", path, "--no-evaluate") == 0
    capsys.readouterr()
    small = ["--tiled", "--width", "64", "--height", "44"]
    assert main(["render", str(path), *small]) == 0
    assert capsys.readouterr().out == f"{path / 'videos' / 'tiled.mp4'}\n"
    # Episodes take four steps, of which every second is shown; two tiles, a name of 20 under each.
    assert imageio.imread(path / "videos" / "tiled.mp4", plugin="FFMPEG").shape == (3, 64, 128, 3)
    out = tmp_path / "b.webp"
    assert main(["render", str(path), *small, "--steps", "6", "--every", "3", "--out", str(out)]) == 0
    with Image.open(out) as film:
        assert (film.n_frames, film.size) == (3, (128, 64))
    # Beside two tiles a large one of 64 x 44 (a grid is as high as its tiles); toys are as large as they are.
    assert main(["render", str(path), *small, "--large", "--steps", "6", "--every", "3", "--out", str(out)]) == 0
    with Image.open(out) as film:
        assert (film.n_frames, film.size) == (3, (192, 64))
    assert main(["render", str(path), "--width", "64", "--every", "4"]) == 0  # its first class
    assert (path / "videos" / "film.mp4").is_file()
    capsys.readouterr()
    for flags, told in (
        (["--task", "Near"], "--out film.mp4"),
        (["--task", "Near", "--out", "a.mp4", "--every", "-1"], "every"),
        ([str(path), "--checkpoint", "best"], "no best.pt"),
        ([str(path), "--policy", "random"], "--policy has no effect with a run folder, which is the policy."),
        (["--task", "Near", "--checkpoint", "best", "--out", "a.png"], "--checkpoint has no effect without a run"),
        ([str(path), "--large"], "--large has no effect without --tiled"),
        ([str(path), "--tiled", "--task", "Near"], "--task has no effect with --tiled, which shows all classes"),
        (["--suite", "MT4", "--tiled", "--task", "Near", "--out", "a.png"], "--task has no effect with --tiled"),
    ):
        assert main(["render", *flags]) == 2
        assert told in capsys.readouterr().err
