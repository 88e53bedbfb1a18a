"""Stands for ``bidex-meta run`` in tests of sweeps: the same folder, lock and files, a checkpoint a step, no physics.

Its seed says what becomes of it: 13 always fails. ``--stop-at-return`` ends it at that step, which is its return.
Signals end it after the step that it is at, as they do a run.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import bidex_meta.runs.folder
from bidex_meta.config import config_of
from bidex_meta.runs import RunFolder

bidex_meta.runs.folder.collect_versions = dict  # type: ignore[assignment]  (it takes seconds to import torch)
STEPS = 6
asked: list[int] = []


def main(words: list[str]) -> int:
    """As ``bidex-meta run``, of the flags that a sweep gives."""
    for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, lambda number, frame: asked.append(number))
    given = dict(word[2:].split("=", 1) for word in words if "=" in word)
    if "resume" in given:
        folder = RunFolder.open(Path(given["resume"]))
    else:
        config = {"suite": None, "task": "HandOver", "algo": "ppo", "seed": int(given["seed"]), "steps": STEPS}
        config |= {"num_envs": 8, "minutes": None, "learner": {}}
        config |= {"stop_at_return": float(given["stop-at-return"])} if "stop-at-return" in given else {}
        config |= {"start_from": str(Path(given["start-from"]).resolve())} if "start-from" in given else {}
        folder = RunFolder.create(config_of(config, "fake"), Path(given["run-dir"]))
    with folder.locked():
        with (folder.path / "starts").open("a") as starts:
            cores = sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else []
            starts.write(json.dumps({"at": time.time(), "cores": cores, "resumed": "resume" in given}) + "\n")
        if folder.config().seed == 13:
            print("some warning\nbidex-meta: the physics broke.\n", file=sys.stderr)
            return 2
        saved = folder.checkpoints_path / "step"
        done = int(saved.read_text()) if saved.is_file() else 0
        last = int(folder.config().stop_at_return or STEPS)
        for step in range(done + 1, last + 1):
            time.sleep(float(os.environ.get("FAKE_SECONDS", "0.01")))
            with folder.metrics_path.open("a") as metrics:
                row = {"step": step, "time": 1.0, "Train/mean_return": step, "Perf/training_time": 0.5 * step}
                metrics.write(json.dumps(row) + "\n")
            saved.write_text(str(step))
            if asked:
                return 0 if asked[0] == signal.SIGTERM else 128 + asked[0]
        row = {"success": 0.5, "return": 1.0, "score": None}
        evaluation = {"steps": last, "policy": {"classes": {"HandOver": row}}}
        (folder.path / "evaluation.json").write_text(json.dumps(evaluation))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[2:]))
