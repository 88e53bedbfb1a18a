"""``--teacher``: short runs on real physics with scripts and with a run's policy, and what is refused."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.config import RunConfig
from bidex_meta.experiments.policies import load_policy
from bidex_meta.experiments.run_teachers import teachers_of
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.utils.paths import shipped_policy
from bidex_meta.worlds import open_worlds
from tests.cli.conftest import Command

SMALL = "--algo dagger --num-envs 4 --threads 1 --device cpu --logger none --no-evaluate --learner.hidden 32 "
SMALL += "--learner.batch-size 64 --learner.updates-per-iteration 10 --learner.teacher-steps 100"
SUITE = """
name = "pair"
version = 1
kind = "multi-task"
description = "A class with a script and one without"
observation = "one-hot"
task_id = "class"
reward = "v2"
variation = "wide"
success = "at-end"
starts = "jittered"
base = "moving"
tasks_per_class = 2
classes = [{ name = "CatchAbreast" }, { name = "Switch" }]
"""


def run(path: Path, steps: int, *words: str) -> list[dict[str, float]]:
    assert main(["run", *words, *SMALL.split(), "--steps", str(steps), "--run-dir", str(path)]) == 0
    return read_metrics(path / "metrics.jsonl")


@pytest.fixture(scope="module")
def student(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that learned Switch from its script."""
    path = tmp_path_factory.mktemp("teachers") / "student"
    rows = run(path, 256, "--task", "Switch-v2", "--teacher", "scripts")
    assert rows[-1]["Loss/imitation"] < 0.3 * rows[0]["Loss/imitation"]
    return path


def test_a_run_with_scripts_is_resumed_with_new_episodes(student: Path) -> None:
    assert main(["run", "--resume", str(student), "--steps", "320", "--no-evaluate"]) == 0
    assert [row["step"] for row in read_metrics(student / "metrics.jsonl")] == [*range(32, 321, 32)]


def test_a_suite_learns_from_a_run_of_one_class_and_leaves_others_out(
    student: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pair.toml").write_text(SUITE)
    words = "--suite", str(tmp_path / "pair.toml"), "--teacher", str(student), "--teacher", "scripts"
    rows = run(tmp_path / "r", 64, *words)
    said = capsys.readouterr().err
    assert f"Teacher {student}: Switch." in said and "Teacher scripts: no class is left for it." in said
    assert "Without a teacher, and not learned: CatchAbreast." in said
    assert "Loss/imitation/Switch" in rows[-1] and "Loss/imitation/CatchAbreast" not in rows[-1]
    assert RunFolder.open(tmp_path / "r").config().teacher == (str(student), "scripts")


def test_a_suite_that_shows_no_task_id_teaches_one_that_does(student: Path, tmp_path: Path) -> None:
    (tmp_path / "pair.toml").write_text(SUITE)
    (tmp_path / "plain.toml").write_text(SUITE.replace('"one-hot"', '"plain"'))
    words = "--suite", str(tmp_path / "pair.toml"), "--teacher", "scripts"
    run(tmp_path / "teacher", 32, *words)
    rows = run(tmp_path / "r", 32, "--suite", str(tmp_path / "plain.toml"), "--teacher", str(tmp_path / "teacher"))
    assert "Loss/imitation/Switch" in rows[-1]


def test_a_teacher_that_learned_on_is_told_when_its_pupil_is_resumed(student: Path, tmp_path: Path, refused) -> None:
    teacher = tmp_path / "teacher"
    shutil.copytree(student, teacher)
    begun = RunFolder.open(teacher).checkpoints.newest_step() or 0
    run(tmp_path / "pupil", 32, "--task", "Switch-v2", "--teacher", str(teacher), "--teacher", "scripts")
    resume = ["run", "--resume", str(tmp_path / "pupil"), "--no-evaluate"]
    assert main([*resume, "--steps", "64"]) == 0
    assert main(["run", "--resume", str(teacher), "--steps", str(begun + 32), "--no-evaluate"]) == 0
    told = f"its teacher {teacher} had {begun} steps when the run began, and has {begun + 32} now"
    assert told in refused(*resume, "--steps", "96")


def test_a_memory_learns_from_scripts_and_a_run_what_a_suite_hides(
    student: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hides = (
        SUITE.replace('"one-hot"', '"masked"').replace('"multi-task"', '"meta"').replace('" }', '", split = "train" }')
    )
    hides = hides.replace('"CatchAbreast"', '"PushBlock"')
    (tmp_path / "hides.toml").write_text(hides.replace("[{", '[{ name = "HandOver", split = "test" }, {'))
    words = ["--teacher", str(student), "--teacher", "scripts", *SMALL.replace("dagger", "icl").split()[:-6]]
    words += ["--learner.episodes-per-trial", "1", "--learner.updates-per-iteration", "2", "--learner.hidden", "8"]
    path = tmp_path / "r"
    assert main(["run", "--suite", str(tmp_path / "hides.toml"), *words, "--steps", "9", "--run-dir", str(path)]) == 0
    assert f"Teacher {student}: Switch." in capsys.readouterr().err
    (row,) = read_metrics(path / "metrics.jsonl")
    assert row["Loss/goal"] > 0.0 and {"Loss/imitation/Switch", "Loss/imitation/PushBlock"} < set(row)


@pytest.mark.parametrize(("suite", "task"), [("ML2-Doors-shared", None), (None, "DoorCloseInward-v2")])
def test_a_policy_of_a_suite_teaches_any_of_its_classes(suite: str | None, task: str | None) -> None:
    given = (str(shipped_policy()),)
    config = RunConfig(suite=suite, task=task, algo="icl", teacher=given, device="cpu", threads=1)
    worlds = open_worlds(config.to_json())
    world = worlds.world("train", 8)
    teachers = teachers_of(config, worlds, world)
    assert bool(teachers.known.all())
    obs, _ = world.reset(seed=0)
    teachers.reset(torch.ones(8, dtype=torch.bool))
    info = {}
    for _ in range(int(world.max_episode_steps.max())):
        obs, _, _, _, info = world.step(teachers.eval_action(obs))
    assert info["running"]["success"].float().mean() > 0.7  # with another padding or task id there is no success


def test_a_shipped_policy_acts_in_a_suite_that_hides_goals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = str(shipped_policy())
    words = ["run", "--suite", "ML1-Switch-v2", *SMALL.replace("dagger", "icl").split()[:-6], "--steps", "9"]
    words += ["--learner.hidden", "8", "--learner.head", "8", "--learner.candidates", "8", "--learner.actor", "teacher"]
    words += [
        "--learner.max-adapt-steps",
        "5",
        "--learner.updates-per-iteration",
        "2",
        "--run-dir",
        str(tmp_path / "r"),
    ]
    assert main([*words, "--teacher", shipped]) == 0
    agent: Any = load_policy(tmp_path / "r")[0]
    borrowed = agent.policy.borrowed
    entries = len(borrowed.state["entries"])
    task = torch.zeros(2, dtype=torch.int64)
    acted = borrowed.eval_action(torch.zeros(2, 600), torch.zeros(2, entries), task)
    assert acted.shape == (2, 52) and acted.abs().max() > 0.01
    assert main([*words[:-1], str(tmp_path / "s"), "--teacher", "scripts"]) == 2
    assert "got 0 run(s) and scripts, which teach 1. Name one run as --teacher" in capsys.readouterr().err


def test_ppo_starts_from_a_student_has_its_teachers_and_is_resumed(student: Path, tmp_path: Path) -> None:
    words = f"--algo ppo --num-envs 4 --threads 1 --device cpu --logger none --learner.hidden 32 --start-from {student}"
    words += f" --teacher scripts --learner.std-range 0.01 0.05 --learner.critic-first 32 --run-dir {tmp_path / 'r'}"
    assert main(["run", "--task", "Switch-v2", *words.split(), "--steps", "96", "--no-evaluate"]) == 0
    assert main(["run", "--resume", str(tmp_path / "r"), "--steps", "128", "--no-evaluate"]) == 0
    rows = read_metrics(tmp_path / "r" / "metrics.jsonl")
    assert [row["step"] for row in rows] == [32, 64, 96, 128]
    assert all(row["Policy/teacher_weight/Switch-v2"] == 1.0 for row in rows)
    assert "Loss/imitation" not in rows[0] and all(row["Loss/imitation"] > 0.0 for row in rows[1:])
    assert rows[0]["Policy/kl"] == 0.0 and rows[0]["Policy/std"] == pytest.approx(0.05)


def test_teachers_that_do_not_fit_are_refused(student: Path, refused: Command) -> None:
    def message(*words: object) -> str:
        return refused("run", "--device", "cpu", *words)

    assert "Add --teacher scripts" in message("--suite", "MT4-v2", "--algo", "dagger")
    assert "goes with mtppo, ppo, dagger, icl" in message(
        "--suite", "MT4-v2", "--algo", "mtsac", "--teacher", "scripts"
    )
    assert "No class of MT1 has" in message("--suite", "MT1", "--algo", "dagger", "--teacher", "scripts")
    assert "that ML20-v2 hides" in message("--suite", "ML20-v2", "--algo", "dagger", "--teacher", "scripts")
    for words in (("--suite", "MT4-v2"), ("--task", "Switch")):
        assert "in the same form" in message(*words, "--algo", "dagger", "--teacher", student)
    fixed = "--task", "Switch-v2", "--base", "fixed", "--algo", "dagger", "--teacher", "scripts"
    assert "Add --base moving" in message(*fixed)
    warp = "--task", "Switch-v2", "--engine", "warp", "--algo", "dagger", "--teacher", "scripts"
    assert "leave --engine out" in message(*warp)
