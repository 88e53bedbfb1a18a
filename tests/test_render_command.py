"""``bidex-meta render``: pictures and films, of policies that fit."""

import pytest

from bidex_meta.cli import main
from bidex_meta.commands import policies
from bidex_meta.sources.source import OwnSuite, SingleClass
from bidex_meta.tasks import registry
from tests.test_cli import run, toy, toy_worlds

__all__ = ["toy_worlds"]


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
    import imageio.v3 as imageio

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
    monkeypatch.setattr(policies, "policy_shape", lambda folder: {"observations": 7, "actions": 1})
    assert main([*flags, "--out", str(tmp_path / "b.png"), "--steps", "2"]) == 2
    assert "takes 7 observations" in capsys.readouterr().err
