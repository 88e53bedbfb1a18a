"""The queue: order and pins, failures, a SIGKILL of everything, how long the rest takes."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bidex_meta.cli import main
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.experiments import sweep_progress
from bidex_meta.experiments import sweeping as queue
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.sweep_plan import PlannedRun, SweepPlan
from bidex_meta.experiments.sweep_progress import State, _played, state_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.evaluations import parse_evaluation
from tests.cli.test_sweep_plan import FILE
from tests.fakes import run_config
from tests.pages import ROOT

FAKE = (sys.executable, str(Path(__file__).with_name("fake_run.py")))
CORES = os.sched_getaffinity(0) if sys.platform == "linux" else {0}
CONFIG = run_config(task="HandOver", algo="ppo", steps=6)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(queue, "COMMAND", FAKE)
    # `bidex-meta run` tests configs; this stand-in has only a few entries.
    monkeypatch.setattr(sweep_progress, "_resolved", lambda run: CONFIG)
    path = tmp_path / "sweep.toml"
    path.write_text(FILE)
    return path


def starts(root: Path) -> dict[str, list[dict[str, Any]]]:
    found = sorted(root.glob("runs/tiny/*/starts"))
    return {path.parent.name: [json.loads(line) for line in path.read_text().splitlines()] for path in found}


def state(run: PlannedRun, config: RunConfig[Any] = CONFIG) -> State:
    return state_of(replace(run, config=replace(config, seed=run.seed, start_from=run.given.start_from)))


def planned() -> list[PlannedRun]:
    return [replace(run, config=replace(CONFIG, seed=run.seed)) for run in SweepPlan.read(Path("sweep.toml")).runs]


def test_all_runs_end_in_order_and_on_their_core(file: Path, tmp_path: Path, shown) -> None:
    core = max(CORES)
    assert "--run-dir=runs/tiny/HandOver-ppo-seed0" in shown("sweep", file, "--dry-run") and not Path("runs").exists()
    out = shown("sweep", file, "--cores", core)
    assert out.count(" done ") == 2 and "2 done, 0 runs, 0 failed, 0 left" in out
    begun = starts(tmp_path)
    assert [len(each) for each in begun.values()] == [1, 1]
    first, second = (each[0] for each in begun.values())
    assert first["at"] < second["at"]
    if sys.platform == "linux":
        assert first["cores"] == second["cores"] == [core]
        assert os.sched_getaffinity(0) == CORES, "the sweep itself stays free"
    shown("sweep", file)
    assert starts(tmp_path) == begun and not shown("sweep", file, "--dry-run"), "nothing is run twice"


def test_a_run_that_its_return_ended_is_done_at_the_steps_it_made(file: Path, tmp_path, monkeypatch, shown) -> None:
    file.write_text(FILE.replace("steps = 6", "steps = 6, stop_at_return = 4"))
    config = replace(CONFIG, stop_at_return=4.0)
    monkeypatch.setattr(sweep_progress, "_resolved", lambda run: config)
    assert "2 done, 0 runs, 0 failed, 0 left" in shown("sweep", file)
    begun = starts(tmp_path)
    shown("sweep", file)
    assert starts(tmp_path) == begun, "and not trained further"
    run = SweepPlan.read(file).runs[0]
    found = state(run, config)
    assert (found.state, found.step, found.goal) == ("done", 4, 4)
    (run.path / "evaluation.json").unlink()
    assert state(run, config).state == "left" and state(run, config).goal == 4


def test_a_failure_is_told_stops_no_other_and_is_tried_again(file: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # narrower tables leave columns out
    file.write_text(FILE.replace("[0, 1]", "[13, 1]"))
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", str(file)])
    told = capsys.readouterr()
    assert "HandOver-ppo-seed13 failed: bidex-meta: the physics broke." in told.err
    assert "1 done, 0 runs, 1 failed, 0 left" in told.out
    assert main(["sweep", str(file), "--status"]) == 0
    assert "the physics broke." in capsys.readouterr().out
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", str(file)])
    assert [len(each) for each in starts(tmp_path).values()] == [1, 2], "seed 1 once, seed 13 again"


STARTING = '[[arms]]\nname = "on"\nalgo = "ppo"\nstart_from = "ppo"\n'


def test_an_arm_starts_from_another_on_the_same_subject_seed_and_value(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(
        FILE.replace('["HandOver"]', '["HandOver", "Switch"]') + "[grid]\nlearner.gamma = [0.8, 0.9]\n" + STARTING
    )
    runs = [run for run in SweepPlan.read(path).runs if run.after is not None]
    assert len(runs) == 2 * 2 * 2
    for run in runs:
        assert run.after is not None and run.after.name == run.name.replace("-on-", "-ppo-")
        assert f"--start-from={run.after}" in run.begin
    own = STARTING.replace('"on"', '"on"\noverrides = { num_envs = 4 }')
    for text, told in (
        (own + "[grid]\nnum_envs = [8, 16]\n", "'ppo', of which there are 2 runs on HandOver"),
        (STARTING.replace('"ppo"\n', '"ppo"\ntasks = ["Switch"]\n', 1), "'ppo', of which there are 0 runs on Switch"),
        (STARTING.replace('start_from = "ppo"', 'start_from = "on"'), "'on', of which there are 0 runs on HandOver"),
    ):
        path.write_text(FILE + text)
        with pytest.raises(BidexError, match=told):
            SweepPlan.read(path)


def test_what_starts_from_another_waits_for_it_and_fails_with_it(file: Path, tmp_path: Path, capsys) -> None:
    file.write_text(FILE.replace("[0, 1]", "[13, 1]") + STARTING)
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", str(file), "--workers", str(min(2, len(CORES)))])
    told = capsys.readouterr()
    assert "HandOver-on-seed13 failed: it starts from HandOver-ppo-seed13, which has" in told.err
    assert "2 done, 0 runs, 1 failed, 1 left" in told.out
    first, second = (tmp_path / "runs/tiny" / f"HandOver-{arm}-seed1" for arm in ("ppo", "on"))
    begun = json.loads((second / "starts").read_text())["at"]
    assert begun >= (first / "evaluation.json").stat().st_mtime - 0.05
    assert json.loads((second / "config.json").read_text())["start_from"] == str(first)
    assert SweepPlan.read(file).runs[-1].after == first.relative_to(tmp_path)
    (second / "config.json").write_text((second / "config.json").read_text().replace("ppo-seed1", "ppo-seed2"))
    assert main(["sweep", str(file), "--status"]) == 2
    assert "start_from is" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found by /proc")
@pytest.mark.parametrize("how", ["all killed", "sweep killed", "sweep asked to stop"])
def test_a_sweep_that_was_stopped_loses_no_run(file: Path, tmp_path: Path, how: str) -> None:
    """SIGKILL of the sweep, and of its runs or not, which then go on and are waited for; or SIGTERM of the sweep."""
    code = (
        "import signal; from bidex_meta.experiments import sweeping as queue; "
        "from tests.cli.test_sweep import planned; "
        "signal.signal(signal.SIGTERM, signal.default_int_handler); "
        f"queue.COMMAND = {FAKE!r}; queue.work(planned(), [None, None])"
    )
    environment = {**os.environ, "FAKE_SECONDS": "0.4", "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "algos")])}
    Path("runs/tiny").mkdir(parents=True)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    sweep = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=environment, **quiet)
    _wait(lambda: len(list(tmp_path.glob("runs/tiny/*/checkpoints/step"))) == 2)
    runs = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit() and _parent(path) == sweep.pid]
    assert len(runs) == 2
    sweep.send_signal(signal.SIGTERM if how == "sweep asked to stop" else signal.SIGKILL)
    sweep.wait()
    for pid in runs if how == "all killed" else ():
        os.kill(pid, signal.SIGKILL)
    _wait(lambda: how == "sweep killed" or not any(Path(f"/proc/{pid}/cwd").exists() for pid in runs))
    assert not list(tmp_path.glob("runs/tiny/*.failed"))
    assert main(["sweep", str(file), "--workers", "1"]) == 0
    begun = [[start["resumed"] for start in each] for each in starts(tmp_path).values()]
    assert begun == [[False] if how == "sweep killed" else [False, True]] * 2
    for run in SweepPlan.read(file).runs:
        assert state(run).state == "done" and [row["step"] for row in run.folder.metrics()] == [1, 2, 3, 4, 5, 6]


def _parent(process: Path) -> int | None:
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return None


def _wait(so: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not so():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_one_sweep_works_in_a_folder_and_a_changed_file_is_noticed(file: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "runs" / "tiny").mkdir(parents=True)
    with RunFolder(tmp_path / "runs" / "tiny").locked():
        assert main(["sweep", str(file)]) == 2
        assert "Another sweep works in" in capsys.readouterr().err
    assert main(["sweep", str(file)]) == 0
    with pytest.raises(BidexError, match="num_envs is 8, not 16"):
        state(SweepPlan.read(file).runs[0], replace(CONFIG, num_envs=16))
    more = state(SweepPlan.read(file).runs[0], replace(CONFIG, steps=12))
    assert (more.state, more.step, more.speed) == ("left", 6, 2.0), "more steps: the run goes on"
    run = SweepPlan.read(file).runs[0]
    others = replace(run, final=FinalEvaluation(other_tasks=True))
    assert (state(run, CONFIG).state, state(others, CONFIG).state) == ("done", "left"), "it is evaluated again"
    with pytest.raises(BidexError, match="has trained for 6 steps, expected at most 3"):
        state(run, replace(CONFIG, steps=3))
    with pytest.raises(BidexError, match="has ended with evaluate_every None, expected 2"):
        state(run, replace(CONFIG, evaluate_every=2))
    limited = replace(CONFIG, steps=100, minutes=0.5)
    assert state(run, limited).state == "left", "it had no time limit and six steps before"


def test_an_evaluation_has_the_parts_that_a_file_asks_for() -> None:
    splits = {}
    for split, tasks in (("train", 3), ("test", 1)):
        row = {"episodes_per_task": 4, "classes": {"CatchUnderarm": {"success": 0.5, "return": 1.0, "tasks": tasks}}}
        splits[split] = {"shots": 2, "rollouts": 7, "trials": 1, "before": row, "after": row, "by_shot": [row]}
    found = parse_evaluation({"splits": splits}, "here")
    run = PlannedRun(Path("x"), CONFIG, "x", config=run_config(suite="ML1", algo="rl2", seed=0))
    for final, done in (
        (FinalEvaluation(rollouts=7, episodes=4, tasks=3), True),
        (FinalEvaluation(tasks=50), True),  # ML1 has three train tasks and one test task
        (FinalEvaluation(tasks=2), False),
        (FinalEvaluation(rollouts=8), False),
        (FinalEvaluation(episodes=5), False),
        (FinalEvaluation(), True),
        (FinalEvaluation(split="test", shots=2), True),
        (FinalEvaluation(split="unseen"), False),
        (FinalEvaluation(shots=1), False),
        (FinalEvaluation(hidden_rewards=True), False),
    ):
        assert _played(replace(run, final=final), found) is done
    one = parse_evaluation({"policy": row}, "here")
    for episodes, done in ((None, True), (4, True), (3, False)):
        assert _played(replace(run, final=FinalEvaluation(episodes=episodes)), one) is done


@pytest.mark.parametrize(
    "asked, count, told",
    [("x", None, "expected numbers"), ("1-", None, "expected numbers"), ("99999", None, "expected numbers"),
     ("9" * 5000, None, "expected numbers"), (None, 100_000, "expected at most")],
)  # fmt: skip
def test_cores_that_are_not_there(asked: str | None, count: int | None, told: str) -> None:
    with pytest.raises(BidexError, match=told):
        queue.choose_cores(asked, count)


def test_how_long_the_rest_takes(file: Path, monkeypatch, shown) -> None:
    """At the run's own speed, else at the mean of those on its suite; where time ends it, that."""
    file.write_text(FILE.replace("[0, 1]", "[0, 1, 2]"))
    run = SweepPlan.read(file).runs[0]
    run.path.mkdir(parents=True)
    (run.path / "config.json").write_text(json.dumps(CONFIG.to_json()))
    (run.path / "metrics.jsonl").write_text('{"step": 3, "Perf/training_time": 3600}\n')
    left = "0 done, 0 runs, 0 failed, 3 left; about 5.00 core-hours"
    assert left in shown("sweep", file, "--status"), "1 h of 2, and 2 · 2 h"
    timed = replace(CONFIG, minutes=90.0)
    monkeypatch.setattr(sweep_progress, "_resolved", lambda run: timed)
    assert "about 3.50 core-hours" in shown("sweep", file, "--status"), "0.5 h, and 2 · 1.5 h"


def test_submit_without_submitit_is_one_line(file: Path, monkeypatch, refused) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert "bidex-meta[slurm]" in refused("sweep", file, "--submit", "slurm")


def test_jobs_of_the_local_executor(file: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("submitit", reason="needs the extra slurm")
    out, runs = Path("runs/tiny"), planned()[:1]
    out.mkdir(parents=True)
    for job in queue.submit(runs, out, "local", {"timeout_min": 2}).values():
        assert job.result()
    assert all(state(run).state == "done" for run in runs)
    with pytest.raises(BidexError, match="submitit: "):
        queue.submit(runs, out, "local", {"timeout": 2})
    assert queue.QueuedJob(runs[0], FAKE).checkpoint().function.run == runs[0]


class Scheduler:
    """Stands for Slurm: has submitit's own handlers call it, and sends real signals when a run has begun."""

    def __init__(self, run: PlannedRun, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        from submitit.core import job_environment, utils

        self.requeued = False
        self.job = queue.QueuedJob(run, FAKE)
        monkeypatch.setenv("FAKE_SECONDS", "0.1")
        environment = type("Slurm", (job_environment.JobEnvironment,), {"_requeue": self._requeue})
        environment._env = {"global_rank": "NO_RANK"}
        submission = utils.DelayedSubmission(self.job)
        submission.set_timeout(60, 3)
        environment()._handle_signals(utils.JobPaths(tmp_path, "1"), submission)

    def _requeue(self, countdown: int) -> None:
        assert self.job.process is not None and self.job.process.returncode is not None, "the run has ended by then"
        self.requeued = True

    def send(self, *signals: tuple[str, int]) -> None:
        """Signals to the ``job`` or to its ``run``, once that has saved something."""
        saved = self.job.run.path / "checkpoints" / "step"
        _wait(saved.is_file)
        assert self.job.process is not None
        for to, number in signals:
            os.kill(os.getpid() if to == "job" else self.job.process.pid, number)


USR1, USR2, TERM = signal.SIGUSR1, signal.SIGUSR2, signal.SIGTERM


@pytest.mark.parametrize(
    ("signals", "requeued"),
    [
        ([("job", USR2), ("run", USR2), ("job", TERM)], True),
        ([("run", USR1)], True),
        ([("run", TERM)], False),
        ([("job", TERM), ("run", TERM)], False),
    ],
    ids=["time limit", "run alone", "run cancelled", "all cancelled"],
)
def test_a_job_whose_time_is_up_saves_and_is_queued_again(
    file: Path, tmp_path: Path, monkeypatch, signals: list, requeued: bool
) -> None:
    pytest.importorskip("submitit", reason="needs the extra slurm")
    numbers = (USR1, USR2, TERM, signal.SIGCONT)
    before = {number: signal.getsignal(number) for number in numbers}
    run = planned()[0]
    run.path.parent.mkdir(parents=True)
    scheduler = Scheduler(run, monkeypatch, tmp_path)
    handlers = {number: signal.getsignal(number) for number in numbers}
    sender = threading.Thread(target=scheduler.send, args=signals)
    sender.start()
    try:
        if requeued:
            with pytest.raises(SystemExit):  # as submitit ends the job
                scheduler.job()
        else:
            assert not scheduler.job()
        sender.join()
        assert {number: signal.getsignal(number) for number in numbers} == handlers
        assert scheduler.requeued == requeued
        assert state(run).state == "left" and 0 < state(run).step < 6
        assert queue.QueuedJob(run, FAKE)(), "queued again it ends"
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert state(run).state == "done" and [row["step"] for row in run.folder.metrics()] == [1, 2, 3, 4, 5, 6]
    assert [start["resumed"] for start in starts(tmp_path)[run.name]] == [False, True]


def test_a_run_that_a_signal_stopped_has_not_failed(file: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("FAKE_SECONDS", "0.1")
    file.write_text(FILE.replace("[0, 1]", "[0]") + STARTING)

    def stop() -> None:
        _wait((tmp_path / "runs/tiny/HandOver-ppo-seed0/checkpoints/step").is_file)
        for path in Path("/proc").iterdir():
            if path.name.isdigit() and _parent(path) == os.getpid():
                os.kill(int(path.name), signal.SIGTERM)

    threading.Thread(target=stop).start()
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", str(file)])
    told = capsys.readouterr()
    assert "HandOver-ppo-seed0 was stopped by a signal" in told.err
    assert "HandOver-on-seed0 failed: it starts from HandOver-ppo-seed0, which was stopped" in told.err
    assert "0 done, 0 runs, 0 failed, 2 left" in told.out and not list(tmp_path.glob("runs/tiny/*.failed"))


@pytest.mark.slow
def test_real_runs_survive_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two small runs of PPO, killed with their sweep while they train, end as if nothing had been."""
    monkeypatch.chdir(tmp_path)
    Path("s.toml").write_text(
        FILE.replace("steps = 6, num_envs = 8", 'steps = 20_000, num_envs = 64, episodes = 1, logger = "none"')
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "algos")])}
    command = [sys.executable, "-m", "bidex_meta.cli", "sweep", "s.toml"]
    sweep = subprocess.Popen(command, env=environment, start_new_session=True)
    first, second = SweepPlan.read(Path("s.toml")).runs
    _wait(lambda: first.folder.metrics_path.is_file() and len(first.folder.metrics()) > 5, 300)
    runs = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit() and _parent(path) == sweep.pid]
    sweep.kill()
    sweep.wait()
    for pid in runs:
        os.kill(pid, signal.SIGKILL)
    assert len(runs) == 1 and not first.folder.evaluated
    subprocess.run(command, env=environment, check=True)
    for run in (first, second):
        steps = [row["step"] for row in run.folder.metrics()]
        assert run.folder.evaluated and steps == sorted(set(steps)) and steps[-1] >= 20_000
