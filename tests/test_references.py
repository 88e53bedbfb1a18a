import json
from pathlib import Path

import pytest

from bidex_meta import references
from bidex_meta.cli import main
from bidex_meta.commands import worlds
from tests.fakes import ToyWorld


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(references, "reference_path", lambda kind: tmp_path / f"{kind}.json")
    return tmp_path


def test_without_a_file_nothing_is_known(folder: Path) -> None:
    assert references.load("random") == {} == references.references()


def test_storing_keeps_the_other_classes_and_how_each_was_made(folder: Path) -> None:
    references.store("random", {"HandOver": {"return": 0.4}, "Switch": {"return": 9.0}}, {"seed": 0})
    references.store("random", {"Switch": {"return": 8.0}}, {"seed": 1})
    assert references.load("random") == {
        "HandOver": {"return": 0.4, "made": {"seed": 0}},
        "Switch": {"return": 8.0, "made": {"seed": 1}},
    }


def test_a_score_needs_both_ends(folder: Path) -> None:
    references.store("random", {"HandOver": {"return": 0.4}, "Switch": {"return": 9.0}}, {})
    references.store("expert", {"HandOver": {"return": 30.0}}, {})
    found = references.references()
    assert list(found) == ["HandOver"]
    assert (found["HandOver"].random, found["HandOver"].expert) == (0.4, 30.0)


@pytest.mark.parametrize("what", ["random", "zero"])
def test_baseline_measures_every_class_and_stores_what_it_printed(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worlds, "_world", lambda config, split, rows, mode: ToyWorld(rows or 6, mode, config["seed"]))
    out = tmp_path / "random.json"
    arguments = ["baseline", what, "--suite", "MT4", "--episodes", "1", "--out", str(out), "--json"]
    assert main(arguments) == 0
    printed, stored = json.loads(capsys.readouterr().out), json.loads(out.read_text())["classes"]
    assert printed.keys() == stored.keys()
    for name, row in stored.items():
        assert row["return"] == printed[name]["return"]
        assert row["episodes"] == printed[name]["episodes"] > 0
        assert row["made"]["policy"].startswith({"random": "uniform", "zero": "zero"}[what])
        assert row["made"]["suite"] == "MT4" and row["made"]["versions"]["packages"]["mujoco"]


def test_an_unknown_baseline_names_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["baseline", "randon"]) == 2
    assert "Did you mean 'random'?" in capsys.readouterr().err
