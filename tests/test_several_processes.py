"""`torchrun --nproc-per-node 2 -m bidex_meta.cli run` on real physics, as small as it goes."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.cli.run_flags import run_flags
from bidex_meta.config import config_of
from bidex_meta.errors import BidexError
from bidex_meta.experiments import processes, run_config
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.training.distributed import TIMEOUT
from bidex_meta.training.launch import launch, resume_command
from tests.algos.ranks import same
from tests.test_real_run import environment, final

SMALL = ["--suite", "MT4", "--num-envs", "4", "--threads", "1", "--device", "cpu", "--seed", "3", "--no-evaluate"]
SMALL += ["--learner.hidden", "16", "--learner.rollout-steps", "4", "--learner.num-minibatches", "2"]
ITERATION = 2 * 4 * 4

# Checkpoints come once a minute, but here after every iteration. The weights of each process are kept for comparison.
_SCRIPT = """
import os, sys
import torch
import bidex_meta.training.runner as runner
from bidex_meta.cli import main
train = runner.train
def often(learner, world, **keywords):
    stopped = train(learner, world, checkpoint_seconds=0.0, **keywords)
    torch.save(learner.state_dict(), f"weights{os.environ['RANK']}.pt")
    return stopped
runner.train = often
sys.exit(main(sys.argv[1:]))
"""


def start(folder: Path, *arguments: object) -> subprocess.Popen[str]:
    script = folder / "often.py"
    script.write_text(_SCRIPT)
    # --standalone finds a free port, so that tests may run side by side.
    line = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script), "run"]
    line += map(str, arguments)
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(line, env=environment(), cwd=folder, text=True, **output)


def finish(process: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """Exit code, and what our processes (hardly torchrun) said."""
    _, errors = process.communicate(timeout=500)
    lines = errors.splitlines()
    return process.returncode, [line for line in lines if line and ("torch" not in line or "--resume" in line)]


def workers(process: subprocess.Popen[str]) -> dict[int, int]:
    """Process ids by rank."""
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True).stdout
    found = {}
    for pid in listed.split():
        try:
            names = Path(f"/proc/{pid}/environ").read_text().split("\0")
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended meanwhile
        found |= {int(name.removeprefix("RANK=")): int(pid) for name in names if name.startswith("RANK=")}
    return found


def wait_for_iterations(process: subprocess.Popen[str], path: Path, count: int) -> None:
    deadline = time.monotonic() + 500
    while process.poll() is None and time.monotonic() < deadline:
        if any(int(file.stem[5:]) >= count * ITERATION for file in path.glob("checkpoints/step_*.pt")):
            return
        time.sleep(0.01)
    raise AssertionError(finish(process))


def test_two_processes_train_mt4_and_end_with_equal_networks(tmp_path: Path) -> None:
    code, said = finish(start(tmp_path, *SMALL, "--steps", 6 * ITERATION, "--run-dir", "r"))
    assert code == 0, said
    assert said.count("mtppo on MT4, 2 x 4 environments on cpu, seed 3") == 1
    assert len([line for line in said if line.startswith("Run folder")]) == 1
    rows = read_metrics(tmp_path / "r" / "metrics.jsonl")
    assert [row["step"] for row in rows] == [ITERATION * (i + 1) for i in range(6)]
    a, b = (torch.load(tmp_path / f"weights{rank}.pt", weights_only=True) for rank in range(2))
    for name in ("policy", "critic", "return_stats", "actor_adam", "critic_adam", "learning_rate", "env_steps"):
        assert same(a[name], b[name]), name
    assert not torch.equal(a["obs"], b["obs"])
    state, step = final(tmp_path / "r")
    assert step == 6 * ITERATION and same(state["learner"]["policy"], b["policy"])
    worlds = [state["env"], state["others"][0]["env"]]
    assert worlds[0]["seed"] == 3 != worlds[1]["seed"]
    assert same(worlds[0]["tasks"], worlds[1]["tasks"])  # the same benchmark, other starts


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_ends_the_run_which_then_resumes_bit_for_bit(victim: int, tmp_path: Path) -> None:
    process = start(tmp_path, *SMALL, "--steps", 10_000_000, "--run-dir", "r")
    wait_for_iterations(process, tmp_path / "r", 5)
    os.kill(workers(process)[victim], signal.SIGKILL)
    killed = time.monotonic()
    code, said = finish(process)
    assert code == 1
    # This takes seconds on a quiet machine, and in any case ends long before a collective operation times out.
    assert time.monotonic() - killed < TIMEOUT.total_seconds() / 3
    [message] = [line for line in said if line.startswith("bidex-meta: ")]
    assert message.startswith(f"bidex-meta: process {victim} of 2 is gone or stuck")
    _, stopped = final(tmp_path / "r")
    assert f"The last checkpoint is at {stopped:,} steps" in message
    assert message.endswith("Continue: torchrun --nproc-per-node 2 -m bidex_meta.cli run --resume r")
    goal = stopped + 20 * ITERATION
    code, said = finish(start(tmp_path, "--resume", "r", "--steps", goal, "--no-evaluate"))
    assert code == 0, said
    code, said = finish(start(tmp_path, *SMALL, "--steps", goal, "--run-dir", "whole"))
    assert code == 0, said
    assert same(final(tmp_path / "r"), final(tmp_path / "whole"))


@pytest.mark.slow
def test_a_stuck_process_is_named_when_the_run_is_asked_to_stop(tmp_path: Path) -> None:
    process = start(tmp_path, *SMALL, "--steps", 10_000_000, "--run-dir", "r")
    wait_for_iterations(process, tmp_path / "r", 2)
    stuck = workers(process)[1]
    os.kill(stuck, signal.SIGSTOP)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    # The message must come before torchrun, which kills 30 s after its request, ends the process silently.
    while process.poll() is None and 0 in workers(process):
        time.sleep(0.1)
    with contextlib.suppress(ProcessLookupError):
        os.kill(stuck, signal.SIGKILL)
    code, said = finish(process)
    [message] = [line for line in said if line.startswith("bidex-meta: ")]
    assert code != 0 and "process 1 of 2 is gone or stuck (this one was asked to stop" in message
    assert final(tmp_path / "r")[1] >= 2 * ITERATION


@pytest.mark.slow
def test_sigterm_to_torchrun_saves_in_all_processes(tmp_path: Path) -> None:
    process = start(tmp_path, *SMALL, "--steps", 10_000_000, "--run-dir", "r")
    wait_for_iterations(process, tmp_path / "r", 2)
    process.send_signal(signal.SIGTERM)
    _, said = finish(process)
    [message] = [line for line in said if "saved" in line]
    state, step = final(tmp_path / "r")
    assert message.startswith(f"Stopped after {step:,} steps and saved. Continue: torchrun --nproc-per-node 2")
    assert len(state["others"]) == 1 and state["learner"]["env_steps"] == step


@pytest.mark.slow
def test_bad_input_is_said_once_and_nothing_is_written(tmp_path: Path) -> None:
    for arguments, expected in (("--suite MT5", "Did you mean 'MT4'?"), ("--suite MT4 --num-envs 3", "at least 4")):
        code, said = finish(start(tmp_path, *arguments.split(), "--device", "cpu"))
        assert code == 1  # torchrun's own
        assert [line for line in said if line.startswith("bidex-meta: ") and expected in line]
        assert len([line for line in said if line.startswith("bidex-meta: ")]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["often.py"]


def test_a_run_of_two_processes_is_not_resumed_by_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r"
    assert main(["run", *SMALL, "--print-config"]) == 0
    config = json.loads(capsys.readouterr().out)
    assert config["processes"] == 1
    RunFolder.create(config_of({**config, "processes": 2}, "a test"), path)
    assert main(["run", "--resume", str(path)]) == 2
    message = capsys.readouterr().err
    assert f"Continue: torchrun --nproc-per-node 2 -m bidex_meta.cli run --resume {path}" in message
    assert message.count("\n") == 1


def test_each_process_takes_its_share_of_threads_and_a_gpu_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    places = {"RANK": 5, "WORLD_SIZE": 8, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 4, "MASTER_ADDR": "a"}
    for name, value in places.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(run_config, "usable_cores", lambda: 10)
    config = run_flags(["--suite", "MT4", "--device", "cpu"]).config
    assert (config.threads, config.processes, config.device) == (2, 8, "cpu")
    assert launch().own_device("cuda") == "cuda:1"
    assert resume_command(Path("r"), 8).startswith("torchrun --nnodes 2 --nproc-per-node 4 -m bidex_meta.cli")
    monkeypatch.delenv("MASTER_ADDR")
    assert launch().own_device("cuda") == "cuda" and resume_command(Path("r"), 1) == "bidex-meta run --resume r"


def test_a_run_from_before_several_processes_is_one_of_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = RunFolder.create(run_flags(SMALL).config, tmp_path / "r")
    config = folder.config().to_json()
    del config["processes"]
    folder.config_path.write_text(json.dumps(config))
    assert run_flags(["--resume", str(tmp_path / "r")]).config.processes == 1


def test_processes_that_disagree_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    config = run_flags(SMALL).config

    def agree(step: int | None = None, **other: object) -> AnyConfig:
        everyone = SimpleNamespace(share=lambda mine: [mine, (replace(config, **other), step)])
        monkeypatch.setattr(processes, "distributed", everyone)
        return processes.agree(config, None)

    assert agree(threads=99).threads == 1
    with pytest.raises(BidexError, match=r"Process 1 has steps = 5, not .* Start all with the same flags"):
        agree(steps=5)
    with pytest.raises(BidexError, match="Process 1 finds a checkpoint at 64 steps, process 0 at None"):
        agree(64)
