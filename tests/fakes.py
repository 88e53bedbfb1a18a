"""A small world that keeps the contract of ``bidex_meta.world.World``, without physics; and small runs."""

import functools
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.cli import main
from bidex_meta.config import RunConfig, config_of
from bidex_meta.runs import RunFolder
from tests.fake_world import FakeWorld

SLOT_TASKS = [3, 2]
SLOT_NAMES = ["Near", "Far"]
STEPS_OF_TASK = [4, 9, 6]
_RUNS = tempfile.TemporaryDirectory()


def run_config(**entries: Any) -> RunConfig[dict[str, Any]]:
    """A run's config; on MT4 where no suite or task is named."""
    usual = {"suite": None if entries.get("task") else "MT4", "task": None, "algo": "mtppo", "learner": {}}
    return config_of({**usual, "num_envs": 8, "steps": 1000, "seed": 0, **entries}, "a test's config")


@functools.cache
def trained_run(algo: str) -> Path:
    """Return the folder of a run of one iteration on real worlds, made once per process. Copy it to change it."""
    path = Path(_RUNS.name) / algo
    suite = "MT4" if algo.startswith("mt") else "ML1"
    words = ["--suite", suite, "--algo", algo, "--seed", "3", "--num-envs", "8", "--device", "cpu", "--threads", "1"]
    words += ["--learner.hidden", "8", "--steps", "8", "--no-evaluate", "--run-dir", str(path)]
    assert main(["run", *words]) == 0
    return path


def change(path: Path, **entries: Any) -> Path:
    """Other entries in a run's ``config.json``."""
    folder = RunFolder.open(path)
    folder.change_config(run_config(**{**folder.config().to_json(), **entries}))
    return path


def evaluated_run(
    root: Path, seed: int, successes: dict[str, float], algo: str = "mtppo", task: str | None = None, **learner: Any
) -> Path:
    """A run's folder with metrics and an evaluation of classes with these success rates."""
    path = root / f"{algo}_{task}_{seed}_{learner}"
    folder = RunFolder.create(run_config(task=task, algo=algo, seed=seed, learner=learner), path)
    metrics = [{"step": 500, "Perf/training_time": 1800.0}, {"step": 1000}]
    folder.metrics_path.write_text("".join(json.dumps(row) + "\n" for row in metrics))
    classes = {name: {"success": s, "return": 10 * s, "score": 100 * s} for name, s in successes.items()}
    (path / "evaluation.json").write_text(json.dumps({"policy": {"classes": classes}}))
    return path


def log(path: Path, *rows: dict) -> RunFolder:
    """A run's folder with these lines of metrics alone."""
    folder = RunFolder.open(path)
    folder.metrics_path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


class ToyWorld(FakeWorld):
    """A point on a line that shall go to its task's goal; the tasks' episodes differ in length.

    Row j of a slot keeps task j modulo the slot's number of tasks. Rewards are scaled by 10 and so differ from
    ``info["reward_unscaled"]``.
    """

    kept = ("x",)

    def __init__(self, num_envs: int, mode: str, seed: int = 0, slot_tasks: list[int] | None = None):
        tasks = dict(zip(SLOT_NAMES, slot_tasks or SLOT_TASKS, strict=False))
        super().__init__(tasks, num_envs, (2, 1), (0,) * len(tasks), mode, seed=seed)
        self.max_episode_steps = torch.tensor(STEPS_OF_TASK)[self.task_index]
        self.goal = (1.0 + self.task_id) * (1.0 + self.task_index) / 4
        self.x = torch.zeros(num_envs)

    def _start(self, mask: Tensor) -> None:
        start = torch.sin(torch.arange(self.num_envs) * 12.9898 + self.episodes.number * 78.233 + self.seed).mul(0.1)
        self.x = torch.where(mask, start, self.x)

    def _observe(self) -> Tensor:
        return torch.stack([self.x, self.goal], 1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.x = torch.where(active, self.x + 0.3 * action[:, 0], self.x)
        distance = (self.x - self.goal).abs()
        return 1 - distance, distance < 0.1, torch.zeros_like(active)

    def _scaled(self, unscaled: Tensor) -> Tensor:
        return 10 * unscaled

    def render(self, env_id: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        frame = np.zeros((height, width, 3), np.uint8)
        frame[:, int(self.episodes.elapsed[env_id]) :, env_id % 3] = 255
        return frame


class Seeker:
    """Walks towards the goal: solves every task of ToyWorld it has the time for."""

    def __init__(self) -> None:
        self.masks: list[Tensor] = []

    def eval_action(self, obs: Tensor) -> Tensor:
        return ((obs[:, 1] - obs[:, 0]) / 0.3).clamp(-1, 1)[:, None]

    def reset(self, env_mask: Tensor) -> None:
        self.masks.append(env_mask.clone())
