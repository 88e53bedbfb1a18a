"""Runs that were made with other physics, suites or versions: every reader of runs says so, or refuses."""

import json
import shutil
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.experiments.policies import load_policy
from bidex_meta.runs.evaluations import Conditions
from bidex_meta.runs.provenance import differences
from bidex_meta.runs.versions import Versions
from tests.cli.conftest import SMALL
from tests.fakes import evaluated_run
from tests.pages import ROOT
from tools.collect import collect

OTHERS = {
    "mujoco": {"packages": {"mujoco": "3.9.9"}},
    "physics": {"physics": "0123456789ab"},
    "suite version": {"suite_version": 7},
    "suite digest": {"suite_digest": "0123456789ab"},
}
VALUES = {"mujoco": "3.9.9", "physics": "0123456789ab", "suite version": "7", "suite digest": "0123456789ab"}
TEXTS = {name: f"{name} {value} then, " for name, value in VALUES.items()}


def edited(run: Path, name: str) -> Path:
    """The run as if it had been made with something else."""
    versions = json.loads((run / "versions.json").read_text())
    other = OTHERS[name]
    packages = versions["packages"] | other.get("packages", {})
    (run / "versions.json").write_text(json.dumps(versions | other | {"packages": packages}))
    return run


def test_what_is_not_recorded_is_no_difference() -> None:
    now = Conditions(packages={"mujoco": "4.0.0", "torch": None}, physics="a", suite_version=2)
    assert differences(Versions(), now) == []
    then = Versions(packages={"mujoco": "3.9", "scipy": "1"}, physics="a", suite_version=1, suite_digest="b")
    found = differences(then, now)
    assert [(str(each), each.is_of_worlds) for each in found] == [
        ("mujoco 3.9 then, 4.0.0 now", True),
        ("suite version 1 then, 2 now", True),
    ]


def test_readers_of_one_run_say_it_in_a_line(run: Path, capsys, tmp_path: Path) -> None:
    def said(*words: object) -> list[str]:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 0, capsys.readouterr().err
        return [
            line for line in capsys.readouterr().err.splitlines() if "was made with" in line or "Conditions" in line
        ]

    start = ["run", *SMALL, "--steps", "24", "--no-evaluate", "--start-from", run]
    assert said("evaluate", run) == said(*start, "--run-dir", tmp_path / "s1") == []
    for name, words in (("mujoco", ["evaluate", run]), ("suite digest", [*start, "--run-dir", tmp_path / "s2"])):
        edited(run, name)
        (line,) = said(*words)
        assert line.startswith(f"{run} was made with "), words
        assert TEXTS[name] in f"{line}, ", words


@pytest.mark.parametrize("name", OTHERS)
def test_verify_and_what_loads_a_policy_say_it_in_a_line(name: str, run: Path, capsys, caplog) -> None:
    """``play``, ``render``, ``record``, ``export``, ``teachers``, ``validity`` and ``control`` load policies."""
    edited(run, name)
    caplog.set_level("INFO", "bidex_meta")
    load_policy(run)
    assert caplog.messages[-1].startswith(f"{run} was made with {TEXTS[name]}")
    evaluation = json.loads((run / "evaluation.json").read_text())
    evaluation["conditions"] = {"device": "cpu", "engine": "auto"}  # of an older one: verify asks the run's record
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    capsys.readouterr()
    assert main(["verify", str(run)]) == 0
    [line] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("Conditions: ")]
    assert line.startswith(f"Conditions: {TEXTS[name]}")


@pytest.mark.parametrize("name", OTHERS)
def test_a_run_whose_worlds_have_changed_is_neither_resumed_nor_submitted_nor_collected(
    name: str, run: Path, refused, tmp_path: Path
) -> None:
    edited(run, name)
    before = (run / "config.json").read_text()
    for words in (
        ["run", "--resume", run, "--steps", "192"],
        ["submit", run, "--out", tmp_path / "board", "--tuning", "1x1"],
    ):
        assert f"The worlds of {run} have changed: {TEXTS[name]}" in refused(*words)
    assert (run / "config.json").read_text() == before
    with pytest.raises(ValueError, match="other worlds than its evaluation's"):
        collect((run,), tmp_path / "data")


@pytest.mark.parametrize("package", ["bidex-meta", "torch"])
def test_another_release_alone_is_said_once_and_resumed(package: str, run: Path, capsys) -> None:
    versions = json.loads((run / "versions.json").read_text())
    versions["packages"][package] = "0.0.1"
    (run / "versions.json").write_text(json.dumps(versions))
    assert main(["run", "--resume", str(run), "--steps", "120", "--no-evaluate"]) == 0
    assert capsys.readouterr().err.count(f"{run} was made with {package} 0.0.1 then, ") == 1


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("where", ["training", "evaluation"])
def test_runs_of_other_worlds_are_not_pooled(name: str, where: str, shown, refused, tmp_path: Path) -> None:
    runs = [evaluated_run(tmp_path, seed, {"A": 0.5}) for seed in range(4)]
    (group,) = json.loads(shown("compare", *runs, "--json"))
    assert len(group["seeds"]) == 4
    for number, run in enumerate(runs):
        versions = json.loads((run / "versions.json").read_text())
        versions |= {"physics": "da96102fd588", "suite_version": 1, "suite_digest": "da96102fd588"}
        if where == "training":
            (run / "versions.json").write_text(json.dumps(versions))
            if number == 3:
                edited(run, name)
        else:
            made = {each: versions[each] for each in ("packages", "physics", "suite_version", "suite_digest")}
            made |= OTHERS[name] if number == 3 else {}
            evaluation = json.loads((run / "evaluation.json").read_text())
            (run / "evaluation.json").write_text(json.dumps(evaluation | {"conditions": made}))
    groups = json.loads(shown("compare", *runs, "--json"))
    assert [len(group["seeds"]) for group in groups] == [3, 1]
    assert all(f"{name} " in group["group"] for group in groups)
    assert VALUES[name] in groups[1]["group"]
    page = Path(shown("report", *runs, "--out", tmp_path / "page.html").strip()).read_text()
    assert groups[1]["group"] in page


def test_classes_with_physics_of_their_own_stay_one_group(shown, tmp_path: Path) -> None:
    runs = [evaluated_run(tmp_path, seed, {task: 0.5}, task=task) for seed in (0, 1) for task in ("HandOver", "Pen")]
    for run in runs:
        versions = json.loads((run / "versions.json").read_text())
        physics = {"physics": "a" * 12 if "HandOver" in run.name else "b" * 12}
        (run / "versions.json").write_text(json.dumps(versions | physics))
    (group,) = json.loads(shown("compare", *runs, "--json"))
    assert group["seeds"] == [0, 1]


def test_a_copy_with_another_seed_is_no_second_run(run: Path, refused, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"seed": 1}))
    for command in ("compare", "plot", "report"):
        words = ["--out", tmp_path / "page.html"] if command == "report" else ["--out", tmp_path / "a.png"]
        assert "is a copy of" in refused(command, run, copy, *words)


def test_a_suite_file_that_was_changed_is_found(shown, toy_worlds, tmp_path: Path, capsys) -> None:
    suite = Path(shutil.copyfile(ROOT / "suites" / "MT4.toml", tmp_path / "mine.toml"))
    words = [*SMALL[2:], "--steps", "24", "--no-evaluate", "--suite", suite, "--run-dir", tmp_path / "r"]
    shown("run", *words)
    text = suite.read_text()
    suite.write_text(text.replace("description = ", "description = 'another' # "))
    shown("evaluate", tmp_path / "r")
    assert "was made with" not in capsys.readouterr().err
    suite.write_text(text.replace("tasks_per_class = 50", "tasks_per_class = 49"))
    assert main(["evaluate", str(tmp_path / "r")]) == 0
    assert "was made with suite digest " in capsys.readouterr().err
