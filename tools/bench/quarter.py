"""Measure a GPU's speed and train policies on it within a quarter of an hour.

A second call continues where the first one stopped.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.runs.metrics import read_metrics, training_seconds
from bidex_meta.runs.versions import collect_versions

TRAININGS = {
    "rl2": ("ML1-v2", "rl2", "gpu", 0.5),
    "varibad": ("ML1-v2", "varibad", "gpu", 0.5),
    "goal-shown": ("MT1-v2", "mtppo", "v2", 1.0),
    "blind": ("ML1-v2", "mtppo", "v2", 1.0),
}
"""Suite, learner, preset and share of ``num_envs`` of each short training. Meta-learners use half of the environments,
because they store whole trials."""
_TAGS = ("Train/success_rate", "Train/success_first_episode", "Train/success_last_episode", "Train/mean_return")
_LEAST = 20.0
"""Seconds that must be left to begin a step; for a step with a shorter time limit, its limit must be left."""
_STARTING = 60.0
"""Seconds that a training may take to start and to save, in addition to its training time."""
_SAVING = 30.0
"""Seconds between asking a step's process to end and killing it."""


@dataclass(frozen=True)
class _Step:
    name: str
    words: list[str]
    """Command of the step, without the interpreter."""
    limit: float
    """Time limit of the step, seconds."""


def quarter(
    out: Path = Path("gpu-results"),
    device: str = "cuda:0",
    suite: str = "MT20-v2",
    sizes: Sequence[int] = (512, 8192, 32768),
    num_envs: int = 8192,
    seconds: float = 60.0,
    rest: float | None = None,
    minutes: float = 13.0,
    slack: float = 1.0,
) -> Json:
    """Measure and train what needs a GPU, in steps that fit into a given time.

    The steps are: compile kernels, run tests, measure switches, train some short runs, measure pictures, and use the
    remaining time for a longer run. Each step is a process with its own time limit. The next step begins even if a step
    fails or reaches its limit. Another call repeats such steps, continues their runs, and skips completed steps.

    Args:
        out: Folder for ``quarter.json`` (all results), logs and run folders.
        device: Where everything runs; on ``cpu`` the worlds of the measurements use Warp's CPU device.
        suite: Multi-task suite whose world is measured and on which the last run trains.
        sizes: Numbers of environments of the measurements.
        num_envs: Number of environments of the training runs.
        seconds: Training time of each short run, seconds.
        rest: Training time of the last run, seconds; None: until ``minutes`` have passed.
        minutes: Time limit of this call.
        slack: Factor of the steps' time limits, for a dry run on a busy machine.

    Returns:
        ``steps`` (state, seconds and last line of output by name), results of ``switches``, ``pictures`` and
        ``training`` (by name), ``setting``, and ``versions``.

    Raises BidexError if ``out`` holds measurements of other code or with other settings.
    """
    out.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60.0 * minutes
    file = out / "quarter.json"
    setting = {"device": device, "suite": suite, "sizes": [*sizes], "num_envs": num_envs, "seconds": seconds}
    result: Json = {"versions": collect_versions(), "setting": setting, "steps": {}}
    if file.exists():
        stored = json.loads(file.read_text())
        for what, known, now in (
            ("settings", stored.get("setting"), setting),
            ("code", stored["versions"].get("git"), result["versions"].get("git")),
        ):
            if known != now:
                raise BidexError(f"Expected {file} to be of the {what} {now}, got {known}. Name another --out.")
        result["steps"] = stored["steps"]
    for step in _steps(out, device, suite, sizes, num_envs, seconds, rest, end):
        left = end - time.monotonic()
        limit = min(slack * step.limit, left)
        if result["steps"].get(step.name, {}).get("state") == "done" or left < min(_LEAST, step.limit):
            continue
        print(f"{step.name}: at most {limit:.0f} s", file=sys.stderr, flush=True)
        result["steps"][step.name] = _run(step, limit, out / f"{step.name}.log")
        write_json(file, result | _results(out))
    return result | _results(out)


def _steps(
    out: Path,
    device: str,
    suite: str,
    sizes: Sequence[int],
    num_envs: int,
    seconds: float,
    rest: float | None,
    end: float,
) -> Iterator[_Step]:
    """Yield the steps; the time for the last training run is computed when the previous steps have run."""
    bench = ["-m", "tools.bench"]
    world = ["--device", device, "--suite", suite]
    tests = ["-m", "pytest", "-q", "-p", "no:cacheprovider"]
    yield _Step("kernels", [*bench, "kernels", *world], 180.0)
    yield _Step("tests", [*tests, "-m", "gpu and not slow and not parity"], 120.0)
    measured = ["--sizes", *map(str, sizes), "--out", str(out / "switches.json")]
    yield _Step("switches", [*bench, "switches", *world, *measured], 240.0)
    for name, (on, algo, preset, share) in TRAININGS.items():
        flags = ["--algo", algo, "--preset", preset, "--device", device, "--num-envs", str(round(share * num_envs))]
        yield _training(out / name, on, flags, seconds)
    drawn = ["--device", device, "--suites", suite, suite.replace("MT", "ML", 1)]
    drawn += ["--num-envs", str(max(1, sizes[-1] // 16))]
    yield _Step("pictures", [*bench, "pictures", *drawn, "--out", str(out / "pictures.json")], 90.0)
    if rest is None:
        rest = max(end - time.monotonic() - _STARTING, seconds)
    flags = ["--algo", "mtppo", "--preset", "v2", "--device", device, "--num-envs", str(num_envs)]
    yield _training(out / "rest", suite, flags, rest)
    yield _Step("parity", [*tests, "-m", "gpu and parity and not slow"], 300.0)
    yield _Step("repeatable", [*tests, "-m", "gpu and slow"], 600.0)


def _training(folder: Path, suite: str, flags: list[str], seconds: float) -> _Step:
    if (folder / "config.json").exists():
        begun = ["--resume", str(folder)]
    else:
        begun = ["--suite", suite, *flags, "--run-dir", str(folder), "--logger", "none"]
    words = ["-m", "bidex_meta.cli", "run", *begun, "--no-evaluate", "--minutes", str(round(seconds / 60.0, 3))]
    return _Step(folder.name, words, seconds + _STARTING)


def _run(step: _Step, limit: float, log: Path) -> Json:
    """Run a step and end it at its limit; return its state, its seconds and the last line of its output."""
    begin = time.monotonic()
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, *step.words], stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        state = "failed"
        try:
            process.wait(limit)
        except subprocess.TimeoutExpired:
            state = "cut"
            _end(process)
    if process.returncode == 0:
        state = "done"  # also a training that ended by itself while it was asked to
    lines = [line for line in log.read_text(errors="replace").splitlines() if any(map(str.isalnum, line))]
    return {"state": state, "seconds": round(time.monotonic() - begin, 1), "last": lines[-1].strip() if lines else ""}


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and its children: interrupt them, so that a training run saves, and later kill them."""
    for number in (signal.SIGINT, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            process.wait(_SAVING)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def _results(out: Path) -> Json:
    """Collect the results that the steps have written so far."""
    found: Json = {"training": {}}
    for name in ("switches", "pictures"):
        file = out / f"{name}.json"
        if file.exists():
            found[name] = json.loads(file.read_text())
    for name in (*TRAININGS, "rest"):
        metrics = out / name / "metrics.jsonl"
        rows = read_metrics(metrics) if metrics.exists() else []
        if rows:
            config = json.loads((out / name / "config.json").read_text())
            found["training"][name] = {
                **{key: config[key] for key in ("suite", "algo", "preset", "num_envs")},
                "steps": rows[-1]["step"],
                "seconds": round(training_seconds(rows), 1),
                **{tag: rows[-1][tag] for tag in _TAGS if rows[-1].get(tag) is not None},
            }
    return found
