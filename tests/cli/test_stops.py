"""Runs that end by time or by a signal, and their resumes."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from bidex_meta.cli import main
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.worlds.own import OwnSuite
from tests.algos.ranks import same
from tests.cli.small_runs import SMALL, final, run
from tests.fakes import ToyWorld


@pytest.mark.parametrize("algo", ["mtppo", "mtsac"])
def test_minutes_end_a_run_and_count_over_its_resumes(algo, toy_worlds, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # narrower tables leave columns out
    path = tmp_path / "r"
    flags = ["--suite", "MT4", "--num-envs", 6, "--threads", 1, "--device", "cpu", "--learner.hidden", 8]
    flags += ["--algo", algo, "--run-dir", path, "--episodes", 1]
    assert main(["run", *map(str, flags), "--minutes", "1e-6"]) == 0
    captured = capsys.readouterr()
    [line] = read_metrics(path / "metrics.jsonl")
    assert f"The 1e-06 minutes are up after {line['step']:,} steps." in captured.err
    assert "random return" in captured.out
    assert (RunFolder.open(path).config().minutes, final(path)[1]) == (1e-6, line["step"])
    # They are up: there is only the evaluation left.
    assert main(["run", "--resume", str(path)]) == 0
    captured = capsys.readouterr()
    assert "random return" in captured.out
    assert "--minutes 1e-06 counts them too. For 1e-06 more: --minutes 1." in captured.err
    assert len(read_metrics(path / "metrics.jsonl")) == 1
    # Steps come first, and the time goes on from where it was.
    goal = str(3 * line["step"])
    assert main(["run", "--resume", str(path), "--minutes", "1e6", "--steps", goal, "--no-evaluate"]) == 0
    assert RunFolder.open(path).config().minutes == 1e6
    times = [row["Perf/training_time"] for row in read_metrics(path / "metrics.jsonl")]
    assert len(times) == 3 and times[0] == line["Perf/training_time"] and times == sorted(times)
    # What the run took on another day is known from its metrics.
    rows = read_metrics(path / "metrics.jsonl")
    rows[-1]["Perf/training_time"] = 7200.0
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    more = ["--steps", str(10 * line["step"]), "--no-evaluate"]
    assert main(["run", "--resume", str(path), "--minutes", "119", *more]) == 0
    assert len(read_metrics(path / "metrics.jsonl")) == 3


def test_a_resume_with_all_steps_made_says_what_to_add(toy_worlds, tmp_path, capsys):
    assert run("--steps", 48, "--run-dir", tmp_path / "r", "--no-evaluate") == 0
    assert main(["run", "--resume", str(tmp_path / "r"), "--no-evaluate"]) == 0
    told = capsys.readouterr().err
    assert "Nothing to train: the run has made 48 steps, and --steps 48 counts them too." in told
    assert "For as many more: --steps 96." in told


def test_resume_refuses_a_changed_config_and_takes_the_same_one(toy_worlds, tmp_path, refused):
    path = tmp_path / "r"
    assert run("--steps", 24, "--run-dir", path, "--no-evaluate", "--seed", 4) == 0
    for flag, value in (("--learner.gamma", "0.5"), ("--num-envs", "12"), ("--seed", "5"), ("--suite", "MT1")):
        assert f"{flag} is " in refused("run", "--resume", path, flag, value)
    assert main(["run", "--resume", str(path), "--seed", "4", "--no-evaluate"]) == 0


def test_resume_without_a_checkpoint_starts_over(toy_worlds, tmp_path):
    path = tmp_path / "r"
    assert run("--steps", 48, "--run-dir", path, "--no-evaluate") == 0
    whole = final(path)
    for file in (path / "checkpoints").iterdir():
        file.unlink()
    assert main(["evaluate", str(path)]) == 2
    assert main(["run", "--resume", str(path), "--no-evaluate"]) == 0
    assert same(whole, final(path))
    assert [row["step"] for row in read_metrics(path / "metrics.jsonl")] == [24, 48]


class Signalling(ToyWorld):
    """Sends its process a signal at its thirtieth step, in the middle of an iteration."""

    number: int
    played = 0

    def step(self, action):
        self.played += 1
        if self.played == 30:
            os.kill(os.getpid(), self.number)
        return super().step(action)


def check_resumes(path, tmp_path):
    """A stopped run, resumed, ends as an unbroken one does."""
    stopped = final(path)[1]
    assert 0 < stopped == RunFolder.open(path).metrics()[-1]["step"]
    assert main(["run", "--resume", str(path), "--steps", str(stopped + 96), "--no-evaluate"]) == 0
    assert run("--steps", stopped + 96, "--run-dir", tmp_path / "whole", "--no-evaluate") == 0
    assert same(final(path), final(tmp_path / "whole"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR2])
def test_a_stopped_run_resumes_to_the_same_end(number, toy_worlds, tmp_path, monkeypatch, capsys):
    """SIGKILL: tests/test_real_run.py and tests/robust."""
    path = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(Signalling, "number", number, raising=False)
        patch.setattr(OwnSuite, "world", lambda source, split, rows, mode: Signalling(rows, mode, source.seed))
        if number == signal.SIGTERM:
            assert run("--steps", 1_000_000, "--run-dir", path) == 0
        else:
            with pytest.raises(SystemExit, match=f"^{128 + number}$"):
                run("--steps", 1_000_000, "--run-dir", path)
    assert f"bidex-meta run --resume {path}" in capsys.readouterr().err
    check_resumes(path, tmp_path)


_TRAIN = """
import functools, sys
import bidex_meta.runs.progress as progress
import bidex_meta.training.runner as runner
from bidex_meta.cli import main
from bidex_meta.worlds.own import OwnSuite
from tests.fakes import ToyWorld
OwnSuite.world = lambda source, split="train", rows=None, mode="DISABLED": ToyWorld(rows or 6, mode, source.seed)
runner.train = functools.partial(runner.train, checkpoint_seconds=0.0)
progress._PLAIN_SECONDS = 0.01
sys.exit(main(sys.argv[1:]))
"""


def test_a_run_whose_output_nobody_reads_any_more_resumes_to_the_same_end(toy_worlds, tmp_path):
    """As in ``bidex-meta run 2>&1 | head``."""
    path = tmp_path / "unread"
    command = [sys.executable, "-c", _TRAIN, "run", *SMALL, "--steps", "10000000", "--run-dir", str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    while not list(path.glob("checkpoints/step_*.pt")) and process.poll() is None:
        time.sleep(0.01)
    assert process.stderr is not None
    process.stderr.close()
    assert process.wait() == 141
    check_resumes(path, tmp_path)
