"""Submissions that are played, checked and ranked."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from bidex_meta.evaluation import leaderboard
from bidex_meta.evaluation.entries import Entry, evaluation_seed
from bidex_meta.evaluation.entry_rows import class_row
from bidex_meta.evaluation.leaderboard import (
    read_entry,
    sealed,
)
from bidex_meta.experiments import submitted_runs
from bidex_meta.runs import RunFolder
from bidex_meta.suite import Suite
from bidex_meta.utils.files import portable
from bidex_meta.worlds.own import OwnSuite
from tests.cli.conftest import COUNTS, FINDER, SMALL, points
from tests.fakes import SLOT_NAMES, SLOT_TASKS, change, run_config, trained_run
from tests.pages import ROOT
from tools.pages.leaderboard import leaderboard_table

SHIPPED = sorted((ROOT / "results" / "leaderboard").glob("*.json"))
TUNED = ["--tuning", "12x1"]


@pytest.fixture
def toy_suite(toy_worlds, few_resamples, monkeypatch: pytest.MonkeyPatch) -> None:
    pools = {name: list(map(str, range(count))) for name, count in zip(SLOT_NAMES, SLOT_TASKS, strict=True)}
    monkeypatch.setattr(Suite, "task_names", lambda suite, split: pools)


@pytest.fixture
def runs(toy_suite, tmp_path: Path, shown) -> list[Path]:
    """Two runs that differ in the seed."""
    folders = [tmp_path / f"r{seed}" for seed in (0, 1)]
    for seed, run in enumerate(folders):
        shown("run", *SMALL, "--steps", "96", "--run-dir", run, "--seed", seed, "--no-evaluate")
    return folders


def copied(run: Path, **entries: Any) -> Path:
    """A copy of a run whose config says otherwise, and that tells nothing of its versions."""
    path = shutil.copytree(run, run.parent / f"copy{len(list(run.parent.iterdir()))}")
    (path / "versions.json").write_text("{}")
    return change(path, **entries)


def test_a_submission_is_played_by_the_seed_of_its_weights_and_ranked(
    runs, tmp_path: Path, shown, refused, monkeypatch
) -> None:
    out = tmp_path / "leaderboard"
    assert "--tuning: expected the number of settings" in refused("submit", *runs, "--out", out)
    assert "got '12'" in refused("submit", *runs, "--out", out, "--tuning", 12)
    copy = copied(runs[0], seed=2)
    assert "they are one run" in refused("submit", *runs, copy, "--out", out, *TUNED)
    task_seeds: list[int] = []
    make = OwnSuite.world
    monkeypatch.setattr(
        OwnSuite, "world", lambda source, *given: (task_seeds.append(source.seed), make(source, *given))[1]
    )
    shown("submit", *runs, "--out", out, "--episodes", "2", "--device", "cpu", *TUNED)
    entry = read_entry(out / "MT4-mtppo.json")
    assert isinstance(entry, Entry) and entry.verified and entry.track == "multi-task"
    assert (entry.suite, entry.stated.seeds, entry.steps) == ("MT4", [0, 1], [96, 96])
    assert list(entry.own.shots[0]) == ["Near", "Far"] and entry.stated.device == "cpu, 1 thread"
    assert (entry.tuning.trials, entry.tuning.seeds) == (12, 1)
    assert len({*entry.receipt.weights}) == len({*entry.receipt.config}) == 2
    assert entry.seed == evaluation_seed(entry.receipt.weights) and sorted(task_seeds) == [0, 1, *[entry.seed] * 2]
    lines = list(leaderboard_table("MT4", tmp_path / "data"))
    assert lines[0] == "**MT4, multi-task**" and lines[4].startswith("| 1 | mtppo | ")
    assert "exists already" in refused("submit", *runs, "--out", out, *TUNED)
    assert "Two of the runs have the same seed" in refused(
        "submit", runs[0], runs[0], "--name", "x", "--out", out, *TUNED
    )
    for words in ({"seed": 2}, {"seed": 2, "suite": "MT4-v2"}):
        told = refused("submit", copied(runs[0], **words), "--name", "x", "--out", out, *TUNED)
        assert f"is already in {out / 'MT4-mtppo.json'}" in told


def test_check_repeats_an_entry_and_finds_a_forgery(runs, tmp_path: Path, shown, refused, capsys) -> None:
    out = tmp_path / "leaderboard"
    path = out / "MT4-mtppo.json"
    shown("submit", *runs, "--out", out, "--episodes", "2", "--device", "cpu", *TUNED)
    before = path.read_bytes()
    again = ["submit", "--check", path, *runs[::-1], "--device", "cpu"]
    assert shown(*again).splitlines()[-1] == f"{path}: equal" and path.read_bytes() == before
    assert "belongs to other runs" in refused(*again[:3], runs[0])
    assert "--check takes" in refused(*again, *TUNED)
    forge(path, 1)
    assert shown(*again).splitlines()[-1] == f"{path}: within the interval"
    forge(path, 40)
    change(runs[0], evaluate_every=5)
    with pytest.raises(SystemExit, match="1"):
        submit_main(again)
    assert "different, receipt.config differs" in capsys.readouterr().out


def test_an_entry_outlives_new_options(runs, tmp_path: Path, shown) -> None:
    """Options that a run's version did not have do not make its entry differ."""
    for run in runs:
        config = json.loads((run / "config.json").read_text())
        del config["switches"]
        (run / "config.json").write_text(json.dumps(config))
    shown("submit", *runs, "--out", tmp_path, "--device", "cpu", *TUNED)
    expected = [leaderboard.content_digest(portable(json.loads((run / "config.json").read_text()))) for run in runs]
    path = tmp_path / "MT4-mtppo.json"
    assert read_entry(path).receipt.config == expected


def submit_main(words: list[object]) -> None:
    from bidex_meta.cli.submit import main

    main(list(map(str, words[1:])))


def forge(path: Path, tasks: int) -> None:
    """Solve up to this many tasks more, and give all else the values that fit."""
    content = json.loads(path.read_text())
    for part in ("own", "new"):
        for name, row in content[part]["shots"][0].items():
            for of_run in row["solved"]:
                for task, solved in enumerate(of_run):
                    if solved < 2 and tasks > 0:
                        of_run[task] += 1
                        tasks -= 1
            content[part]["shots"][0][name] = class_row(row["solved"], 2)
    path.write_text(json.dumps(sealed(content, Entry, str(path))))
    read_entry(path)


def test_runs_that_adapt_play_trials_of_three_episodes_on_both_splits(
    finder, tmp_path: Path, shown, refused, few_resamples, monkeypatch
) -> None:
    pools = {split: {name: [""] * count for name, count in counts.items()} for split, counts in COUNTS.items()}
    monkeypatch.setattr(Suite, "task_names", lambda suite, split: pools[split])
    task_seeds: list[tuple[str, int]] = []

    def world(source: OwnSuite, split: str = "train", *given: Any) -> Any:
        task_seeds.append((split, source.seed))
        return points(source, split, *given)

    folders = [tmp_path / f"r{seed}" for seed in (0, 1)]
    for seed, run in enumerate(folders):
        shown("run", *FINDER, "--run-dir", run, "--no-evaluate", "--seed", seed)
    monkeypatch.setattr(OwnSuite, "world", world)
    out = tmp_path / "leaderboard"
    assert "--track is for --evaluation" in refused("submit", *folders, "--track", "privileged", *TUNED)
    shown("submit", *folders, "--out", out, "--device", "cpu", *TUNED)
    entry = read_entry(out / "ML4-finder.json")
    assert isinstance(entry, Entry) and (entry.track, entry.episodes) == ("reward-only", 10)
    assert len(entry.own.shots) == len(entry.new.shots) == 3 and entry.new.trials == 3 and entry.new.rollouts == 4
    assert list(entry.own.shots[0]) == ["Near", "Far"] and list(entry.new.shots[0]) == ["Near"]
    before, after = (entry.new.tables(entry.episodes, shot)[0].mean() for shot in (0, -1))
    assert after > before
    assert {*task_seeds} == {("train", 0), ("train", 1), ("test", entry.seed)}
    copy = copied(folders[0], seed=2)
    assert "they are one run" in refused("submit", *folders, copy, "--name", "x", "--out", out, *TUNED)
    assert "is already in" in refused("submit", copy, "--name", "x", "--out", out, *TUNED)
    last = shown("submit", "--check", out / "ML4-finder.json", *folders, "--device", "cpu").splitlines()[-1]
    assert last.endswith(": equal")


@pytest.mark.parametrize(
    ("entries", "start", "privileged"),
    [
        ({"algo": "rl2"}, None, False),
        ({"algo": "icl"}, None, True),
        ({"algo": "maml"}, {"suite": "ML1"}, False),
        ({"algo": "maml"}, {"suite": "MT1"}, True),
        ({"algo": "maml"}, {"suite": "ML1", "teacher": ("scripts",)}, True),
        ({"algo": "maml"}, {"suite": "ML1", "start_from": "not/here"}, None),
    ],
)
def test_a_track_follows_from_the_learner_and_what_it_learned_from(
    entries: dict, start: dict | None, privileged: bool | None, tmp_path: Path
) -> None:
    if start is not None:
        RunFolder.create(run_config(**start), tmp_path / "start")
        entries = {**entries, "start_from": str(tmp_path / "start")}
    assert submitted_runs._was_privileged(run_config(suite="ML1", **entries)) is privileged


def test_runs_that_nobody_else_could_play_are_refused(toy_suite, tmp_path: Path, shown, refused) -> None:
    suite = shutil.copyfile(ROOT / "suites" / "MT4.toml", tmp_path / "mine.toml")
    run = tmp_path / "r"
    shown("run", *SMALL[2:], "--suite", suite, "--steps", "24", "--run-dir", run, "--no-evaluate")
    told = refused("submit", run, "--out", tmp_path, *TUNED)
    assert "trained on mine.toml. The leaderboard is for shipped suites" in told
    listed = copied(run, suite="MT1-Switch-choice4")
    assert "expected a suite with unseen tasks" in refused("submit", listed, "--out", tmp_path, *TUNED)
    change(run, suite="MT4", points=16)
    assert "saw clouds of points" in refused("submit", run, "--out", tmp_path, *TUNED)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["rl2", "varibad", "pearl", "maml", "promp"])
def test_every_learner_that_adapts_is_played_and_repeated(algo: str, tmp_path: Path, shown, few_resamples) -> None:
    run = trained_run(algo)
    shown("submit", run, "--out", tmp_path, "--episodes", 1, "--device", "cpu", *TUNED)
    entry = read_entry(tmp_path / f"ML1-{algo}.json")
    assert entry.track == "reward-only" and len(entry.new.shots) == 3 and entry.new.rollouts > 0
    again = shown("submit", "--check", tmp_path / f"ML1-{algo}.json", run, "--device", "cpu")
    assert again.splitlines()[-1].endswith(": equal")
