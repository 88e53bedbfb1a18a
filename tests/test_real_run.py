"""From the command to the checkpoint and back on real physics, as small as it goes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.utils import gl_backend
from bidex_meta.world.contract import State

SMALL = ["--suite", "MT4", "--num-envs", "8", "--threads", "1", "--device", "cpu", "--seed", "3"]
SMALL += ["--learner.hidden", "16", "--learner.rollout-steps", "4", "--learner.num-minibatches", "2"]
ITERATION = 8 * 4
ROOT = Path(__file__).parents[1]

# Checkpoints come once a minute, but here after every iteration.
_OFTEN = """
import functools, sys
import bidex_meta.training.runner as runner
from bidex_meta.cli import main
runner.train = functools.partial(runner.train, checkpoint_seconds=0.0)
sys.exit(main(sys.argv[1:]))
"""


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "algos")))}


def final(path: Path) -> tuple[State, int]:
    loaded = RunFolder.open(path).checkpoints.load()
    assert loaded is not None
    return loaded


def metrics(path: Path) -> list[dict[str, float]]:
    """A run's metrics without times."""
    rows = read_metrics(path / "metrics.jsonl")
    return [{k: v for k, v in row.items() if k != "time" and not k.startswith("Perf/")} for row in rows]


def differences(a: object, b: object, where: str = "") -> list[str]:
    """Where two states differ."""
    if isinstance(a, dict):
        missing = [f"{where}/{key}" for key in a.keys() ^ b.keys()]
        return missing + [d for key in a.keys() & b.keys() for d in differences(a[key], b[key], f"{where}/{key}")]
    if isinstance(a, list | tuple):
        assert len(a) == len(b)
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}/{i}")]
    same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    return [] if same else [where]


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """A run that SIGKILL met, then resumed to its end; and that end."""
    path = tmp_path_factory.mktemp("killed") / "run"
    line = [sys.executable, "-c", _OFTEN, "run", *SMALL, "--steps", "10000000", "--run-dir", str(path)]
    process = subprocess.Popen(line, env=environment(), cwd=path.parent, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 500
    while process.poll() is None and time.monotonic() < deadline:
        if any(int(file.stem[5:]) >= 20 * ITERATION for file in path.glob("checkpoints/step_*.pt")):
            break
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors
    stopped = final(path)[1]
    assert stopped >= 19 * ITERATION  # the last file itself may not have been replaced yet
    goal = stopped + 40 * ITERATION
    assert main(["run", "--resume", str(path), "--steps", str(goal), "--no-evaluate"]) == 0
    return path, goal


def test_a_killed_run_resumes_to_the_end_of_an_unbroken_one(
    killed: tuple[Path, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, goal = killed
    whole = tmp_path / "whole"
    monkeypatch.chdir(tmp_path)
    assert main(["run", *SMALL, "--steps", str(goal), "--run-dir", str(whole), "--no-evaluate"]) == 0
    a, b = final(path), final(whole)
    assert a[1] == b[1] == goal
    assert differences(a[0], b[0]) == []
    episodes = b[0]["env"]["episodes"]["number"]
    assert int(episodes.min()) >= 1  # every row was reset on the way
    rows = [metrics(folder) for folder in (path, whole)]
    assert [row["step"] for row in rows[0]] == list(range(ITERATION, goal + 1, ITERATION))
    assert rows[0] == rows[1]
    assert {file.name for file in tmp_path.iterdir()} == {"whole"}  # nothing is left beside the run, no MuJoCo log


def trained(path: Path, threads: int, *options: str, stop: int | None = None) -> tuple[State, list[dict[str, float]]]:
    """Four iterations in this process, broken off and resumed after ``stop``; the end, and the metrics."""
    words = ["run", *SMALL, *options, "--threads", str(threads), "--run-dir", str(path), "--no-evaluate"]
    assert main([*words, "--steps", str((stop or 4) * ITERATION)]) == 0
    if stop is not None:
        torch.set_num_threads(1)  # whatever the machine, the run keeps its threads
        assert main(["run", "--resume", str(path), "--steps", str(4 * ITERATION), "--no-evaluate"]) == 0
        assert RunFolder.open(path).config().threads == threads
    return final(path)[0], metrics(path)


def test_threads_change_nothing_in_a_small_run_resumed_or_not(tmp_path: Path) -> None:
    one = trained(tmp_path / "one", 1)
    for name, stop in (("two", None), ("two resumed", 2)):
        two = trained(tmp_path / name, 2, stop=stop)
        assert differences(one[0], two[0]) == [] and one[1] == two[1]


def test_a_run_of_two_threads_resumes_to_its_own_bits(tmp_path: Path) -> None:
    """Of layers that are large enough for torch and MKL to split among threads; of one thread's they may differ."""
    large = ("--learner.hidden", "128")
    whole = trained(tmp_path / "whole", 2, *large)
    assert max(weight.numel() for weight in whole[0]["learner"]["policy"]["weights"].values()) > 32_768
    parts = trained(tmp_path / "parts", 2, *large, stop=2)
    assert differences(whole[0], parts[0]) == [] and whole[1] == parts[1]


def test_render_writes_a_picture_with_something_on_it(tmp_path: Path) -> None:
    try:
        gl_backend.prepare()
    except BidexError as error:
        pytest.skip(str(error))
    out = tmp_path / "x.png"
    assert main(["render", "--task", "HandOver", "--width", "160", "--height", "120", "--out", str(out)]) == 0
    picture = imageio.imread(out)
    assert picture.shape == (120, 160, 3) and picture.std() > 5.0
