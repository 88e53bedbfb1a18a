"""Our TD3+BC and IQL beside d3rlpy's on the same data; d3rlpy lives in an environment of its own.

    python -m tests.offline.against_d3rlpy CatchUnderarm/medium-v0 --python ENV/bin/python --updates 20000

prints the normalised scores (or returns) of each seed, their means and 95 % t-intervals, and whether these overlap.
Both have the preset ``paper``, which is Table 46. The environment needs `pip install torch d3rlpy`.
"""

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
from torch import Tensor

from bidex_meta.data import open_dataset
from bidex_meta.data.joined import Joined, join
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.run_data import implied, task_seed
from bidex_meta.training.learner import Sources
from bidex_meta.worlds import open_worlds

ALGOS = ("td3bc", "iql")
TRAIN = Path(__file__).with_name("d3rlpy_train.py")


class Scripted:
    """An agent of a TorchScript that maps raw observations to actions."""

    def __init__(self, path: Path):
        self._policy = torch.jit.load(str(path))

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        return self._policy(obs).clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget."""


def against(
    data: Joined, world: Any, judge: Callable[[Any], float], python: str, updates: int, seeds: int = 3,
    algos: Sequence[str] = ALGOS
) -> dict[str, Any]:  # fmt: skip
    """What both reach: per algo ``ours`` and ``theirs`` (a number a seed), intervals, ``overlap``."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.npz"
        ends = data.left.numpy() == 0
        np.savez(
            path, observations=data.observations[data.at].numpy(), actions=data.actions.numpy(),
            rewards=data.rewards.numpy()[:, None], terminals=data.terminated.float().numpy(),
            timeouts=(ends & ~data.terminated.numpy()).astype(np.float32)
        )  # fmt: skip
        for algo in algos:
            ours, theirs = [], []
            for seed in range(seeds):
                kind = learner_kind(algo)
                config = replace(kind.presets["paper"], updates_per_iteration=min(updates, 1000))
                learner = kind.learner_class(world, config, seed, Sources(data))
                while learner.env_steps < updates:
                    learner.iterate()
                ours.append(judge(learner))
                out = Path(folder) / f"{algo}{seed}.pt"
                _train([python, TRAIN, path, algo, str(updates), str(seed), out])
                theirs.append(judge(Scripted(out)))
            spans = [
                scipy.stats.t.interval(0.95, seeds - 1, np.mean(each), scipy.stats.sem(each)) for each in (ours, theirs)
            ]
            overlap = max(span[0] for span in spans) <= min(span[1] for span in spans)
            found[algo] = {"ours": ours, "theirs": theirs, "intervals": spans, "overlap": overlap}
    return found


def _train(command: Sequence[Any]) -> None:
    others = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [*map(str, command)], env=others | {"OMP_NUM_THREADS": "1"}, stderr=subprocess.STDOUT, stdout=subprocess.PIPE,
        text=True, check=False
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{command} ended with {done.returncode}: {done.stdout[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset")
    parser.add_argument("--python", required=True)
    parser.add_argument("--updates", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=4)
    flags = parser.parse_args()
    dataset = open_dataset(flags.dataset)
    config = {"suite": None, "task": None, **implied([dataset]), "task_seed": task_seed([dataset])}
    source = open_worlds(config)
    world, tested = source.world("train", len(source.tasks("train")), "SAME_STEP"), source.world()

    def judge(agent: Any) -> float:
        classes = source.evaluate(agent, tested, source.protocol("train", flags.episodes)).classes.values()
        return float(np.mean([each.mean_return if each.score is None else each.score for each in classes]))

    found = against(join([dataset], world), world, judge, flags.python, flags.updates, flags.seeds)
    print(json.dumps({"data": dataset.name, "updates": flags.updates, **found}, indent=2))


if __name__ == "__main__":
    main()
