import json
from pathlib import Path
from typing import Any

import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import references
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED
from bidex_meta.evaluation.play import evaluate
from bidex_meta.evaluation.references import Reference
from bidex_meta.experiments import baselines
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.tasks import registry
from bidex_meta.utils import paths
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.own import OwnSuite
from tests.fakes import ToyWorld, run_config


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(paths, "assets_dir", lambda: tmp_path)
    return tmp_path / "references"


@pytest.mark.parametrize("base", ["own", "moving"])
def test_scores_of_another_day_are_told_by_todays_references(folder: Path, base: str) -> None:
    for kind, value in (("random", 1.0), ("expert", 5.0)):
        references.store(folder / f"{kind}.json", {name: {"return": value} for name in ("A", "B")}, {})
    scores = {"A": 90.0, "B": None, "Lamp": 7.0}
    rows = {name: ClassSummary(mean_return=2.0, success=0.5, score=score) for name, score in scores.items()}
    rescored = references.rescored(rows, run_config(base=base))
    today = ClassSummary(mean_return=2.0, success=0.5, score=25.0)
    assert rescored == {"A": today, "B": today, "Lamp": rows["Lamp"]}
    unscored = {"B": rows["B"]}  # nobody could say of what base, but where the run says so itself
    assert references.rescored(unscored, run_config(base=base))["B"].score == (25.0 if base == "moving" else None)


def test_storing_keeps_the_other_classes_and_how_each_was_made(folder: Path) -> None:
    references.store(folder / "random.json", {"HandOver": {"return": 0.4}, "Switch": {"return": 9.0}}, {"seed": 0})
    references.store(folder / "random.json", {"Switch": {"return": 8.0}}, {"seed": 1})
    assert references.load("random") == {
        "HandOver": {"return": 0.4, "made": {"seed": 0}},
        "Switch": {"return": 8.0, "made": {"seed": 1}},
    }


def test_an_expert_that_doing_nothing_beats_gives_no_score(folder: Path) -> None:
    assert references.load("random") == {} == references.references()
    known = {"random": {"A": 1.0, "B": 1.0, "C": 5.0}, "zero": {"A": 3.0, "B": 3.0}, "expert": {"A": 2.0, "B": 4.0}}
    for kind, returns in known.items():
        references.store(folder / f"{kind}.json", {name: {"return": value} for name, value in returns.items()}, {})
    expected = {"A": Reference(1.0, None, 3.0), "B": Reference(1.0, 4.0, 3.0), "C": Reference(5.0)}
    assert references.references() == expected


def test_every_class_has_an_expert_that_solves_it_and_beats_doing_nothing_and_doing_anything() -> None:
    known = references.references()  # None where it does not
    assert all(known[name].expert is not None for name in registry.names())
    stored = references.load("expert")
    assert all(row["success"] >= 0.5 and "MT" not in row["source"] for row in stored.values())


@pytest.mark.parametrize(("what", "suite"), [("random", "MT4"), ("zero", "MT4-v2")])
def test_baseline_measures_every_class_and_stores_what_it_printed(
    what: str, suite: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OwnSuite, "world", lambda source: ToyWorld(6, "DISABLED", source.seed))
    out = tmp_path / "random.json"
    arguments = ["baseline", what, "--suite", suite, "--episodes", "1", "--out", str(out), "--json"]
    assert main(arguments) == 0
    printed, stored = json.loads(capsys.readouterr().out), json.loads(out.read_text())["classes"]
    ending = suite.removeprefix("MT4")
    assert {name + ending for name in printed} == stored.keys()
    for name, row in stored.items():
        assert row["return"] == printed[name.removesuffix(ending)]["return"]
        assert row["episodes"] == printed[name.removesuffix(ending)]["episodes"] > 0
        assert row["made"]["policy"].startswith({"random": "uniform", "zero": "zero"}[what])
        assert row["made"]["suite"] == suite and row["made"]["versions"]["packages"]["mujoco"]


@pytest.mark.parametrize("what", ["random", "zero"])
def test_the_seed_of_a_baseline_draws_its_starts(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seed 0 keeps the starts of the stored references."""
    monkeypatch.setattr(OwnSuite, "world", lambda source: ToyWorld(6, "DISABLED"))
    seeds: list[int] = []

    def spy(*given: Any, seed: int, **options: Any) -> Any:
        seeds.append(seed)
        return evaluate(*given, seed=seed, **options)

    monkeypatch.setattr(baselines, "evaluate", spy)
    found = [baselines.baseline(what, "MT4", episodes=1, seed=seed).classes["Near"].returns for seed in (0, 7)]
    assert seeds == [EVALUATION_SEED, EVALUATION_SEED + 7] and list(found[0]) != list(found[1])


def test_a_baseline_without_out_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OwnSuite, "world", lambda source: ToyWorld(6, "DISABLED", source.seed))
    monkeypatch.setattr(references, "write_json", lambda *_: pytest.fail("something was written"))
    monkeypatch.chdir(tmp_path)
    assert main(["baseline", "random", "--suite", "MT4", "--episodes", "1"]) == 0
    assert capsys.readouterr().out and list(tmp_path.iterdir()) == []


def test_references_do_not_go_into_a_file_of_something_else(tmp_path: Path) -> None:
    for text in ("no json", "[1]", '{"other": 1}'):
        (tmp_path / "notes").write_text(text)
        with pytest.raises(BidexError, match="file of references"):
            references.store(tmp_path / "notes", {"HandOver": {"return": 1.0}}, {})
        assert (tmp_path / "notes").read_text() == text


def test_a_suite_with_fixed_bases_neither_has_nor_makes_references(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "mine.toml"
    text = (paths.suites_dir() / "MT1.toml").read_text().replace('base = "moving"', 'base = "alone"')
    suite.write_text(text.replace("CatchUnderarm", "HandOver"))
    assert open_worlds({"suite": str(suite)}).references() == {}
    assert open_worlds({"suite": "MT1"}).references().keys() >= {"CatchUnderarm"}
    both = {name: registry.get(name, moving) for name, moving in (("HandOver", False), ("CatchUnderarm", True))}
    assert references.references_for(both) == {}, "rescored takes one score for the proof that all bases moved"
    assert main(["baseline", "zero", "--suite", str(suite), "--out", str(tmp_path / "zero.json")]) == 2
    assert 'base = "moving"' in capsys.readouterr().err and not (tmp_path / "zero.json").exists()


def test_a_baseline_of_version_2_has_a_score_and_no_stored_returns() -> None:
    for suite, known in (("MT4-v2", True), ("MT4", False)):
        for name, found in baselines._without_returns(open_worlds({"suite": suite})).items():
            steps = registry.get(f"{name}-v2").episode_steps if known else None
            assert found == Reference(None, episode_steps=steps)


def test_a_suite_that_lists_tasks_makes_no_references(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "zero.json")
    for suite in ("MT1", "MT1-DoorOpenOutward-shared"):
        assert main(["baseline", "zero", "--suite", suite, "--out", out]) == 2
        assert "lists tasks" in capsys.readouterr().err and not (tmp_path / "zero.json").exists()


def test_a_suite_that_mixes_rules_makes_no_references(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = tmp_path / "mine.toml"
    text = (paths.suites_dir() / "MT1-v2.toml").read_text()
    suite.write_text(text.replace('variation = "wide"', 'variation = "narrow"'))
    assert main(["baseline", "zero", "--suite", str(suite), "--out", str(tmp_path / "zero.json")]) == 2
    assert "mixes" in capsys.readouterr().err and not (tmp_path / "zero.json").exists()
    (known,) = open_worlds({"suite": str(suite)}).references().values()
    assert (known.random, known.episode_steps) == (None, registry.get("CatchUnderarm").episode_steps)
