"""Evaluations, films and the best policy of a learner during training. None of these influences training."""

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch

from bidex_meta.agents import Agent
from bidex_meta.config import EPISODES
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.filming import Look, film_tiles
from bidex_meta.evaluation.play import evaluate
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.experiments import metatest
from bidex_meta.experiments.learners import LearnerKind
from bidex_meta.experiments.policies import slots_of
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.runs import Recorder, RunFolder
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.video import check_films
from bidex_meta.runs.writers import check_logger
from bidex_meta.training.launch import launch, say
from bidex_meta.training.learner import Capability, Learner
from bidex_meta.utils import gl_backend
from bidex_meta.world.contract import PooledWorld
from bidex_meta.worlds import Worlds, open_worlds

TASKS = 10  # tasks of each class in such an evaluation, the first of its pool, with one episode each
# Minimum number of episodes over all classes: with fewer tasks each is played several times, so that one failure does
# not decide.
_LEAST = 10
_FILM: Look = {"width": 240, "height": 180}
_FILM_EVERY = 2
_MOST_FILM_STEPS = 300


def check(config: AnyConfig, worlds: Worlds) -> None:
    """Raise BidexError for settings that would fail in the middle of training.

    Such settings are a logger that is not installed, and films on a machine that cannot make them.
    """
    check_logger(config.logger)
    if config.video_every is not None:
        worlds.task_classes()
        check_films()
        gl_backend.prepare()


class Watch:
    """Evaluates and films the learner during training; the training loop calls it after each iteration.

    It acts in every N-th iteration. Iterations are counted from the beginning of the run, including those before a
    resume.
    """

    def __init__(
        self, config: AnyConfig, kind: LearnerKind, worlds: Worlds, folder: RunFolder, learner: Learner,
        record: Recorder, iterations: int
    ) -> None:  # fmt: skip
        self._config = config
        self._kind = kind
        self._source = worlds
        self._folder = folder
        self._learner = learner
        self._record = record
        self._iterations = iterations
        self._device = launch().own_device(config.device)
        self._worlds: dict[str, PooledWorld] = {}
        self._best = folder.checkpoints.found_of_best()

    def __call__(self) -> dict[str, float]:
        """Return the metrics of this iteration's evaluation, ``Eval/...``; none if there is no evaluation."""
        self._iterations += 1
        metrics: dict[str, float] = {}
        with undisturbed(torch.device(self._device)):
            if self._is_due(self._config.evaluate_every):
                metrics = self._evaluate()
            if self._is_due(self._config.video_every):
                self._film()
        return metrics

    def close(self) -> None:
        """Free the worlds."""
        for world in self._worlds.values():
            world.close()

    def _is_due(self, every: int | None) -> bool:
        return every is not None and self._iterations % every == 0

    def _policy(self, device: str) -> Agent:
        """Return a copy of the learner's policy.

        A copy is needed because an evaluation changes the memory of a recurrent policy and the weights of a policy that
        adapts.
        """
        return self._kind.learner_class.load_policy(self._learner.policy_state_dict(), device)

    def _evaluate(self) -> dict[str, float]:
        if Capability.ADAPTS in self._kind.capabilities:
            metrics = self._meta_test()
        else:
            metrics = _metrics(self._judge())
        ranks = ("Eval/success_rate", "Eval/score", "Eval/mean_return")
        found = {name: metrics[name] for name in ranks if name in metrics}
        if self._best is None or _better(found, self._best):
            self._best = found
            self._folder.checkpoints.save_best(self._learner.policy_state_dict(), self._learner.env_steps, found)
        return metrics

    def _judge(self) -> Evaluation:
        source = self._source
        pools = source.tasks("train")
        tasks, episodes = played(pools)
        if "evaluation" not in self._worlds:
            world = self._worlds["evaluation"] = source.world("train", tasks * len(pools) * episodes)
            if isinstance(world, PooledWorld):
                first = zip(world.task_names, world.pools, strict=True)
                world.set_tasks({name: pool[:tasks] for name, pool in first})
        world = self._worlds["evaluation"]
        policy = self._policy(self._device)
        return evaluate(policy, world, episodes, references=source.references())

    def _meta_test(self) -> dict[str, float]:
        """Run a meta-test on train tasks, and return its metrics.

        Test tasks are not used, because the best policy is selected by this result and later evaluated on the test
        tasks.
        """
        load = partial(self._policy, self._device)
        adaptation = metatest.Adaptation.of(self._source, self._config)
        found = metatest.meta_test(self._source, adaptation, load, metatest.Options(), ["train"])["train"]
        before = _metrics(found.before)["Eval/success_rate"]
        return {**_metrics(found.after), "Eval/success_before_adapt": before}

    def _film(self) -> None:
        """Film an environment of each class side by side; report a failure without ending training."""
        try:
            if "film" not in self._worlds:
                worlds = open_worlds({**self._config.to_json(), "device": "cpu", "engine": "auto"})
                self._worlds["film"] = worlds.world("train", len(slots_of(worlds)))
            world = self._worlds["film"]
            steps = min(_MOST_FILM_STEPS, int(world.max_episode_steps.max()))
            rows = range(world.num_envs)
            seed = self._config.seed
            frames = film_tiles(self._policy("cpu"), world, rows, steps, seed, _FILM_EVERY, large=False, **_FILM)
            self._record.film("training", frames, CONTROL_RATE / _FILM_EVERY, self._learner.env_steps)
        except (BidexError, OSError) as error:
            say(f"No film at {self._learner.env_steps:,} steps: {error}")


def with_episodes(world: Any, watch: Callable[[], dict[str, float]] | None) -> Callable[[], dict[str, float]]:
    """Return a function that adds the number of finished episodes to the metrics of ``watch``, which may be None.

    The number is that of the class with the fewest. First episodes are left out, because they may be shortened.
    """

    def watched() -> dict[str, float]:
        finished = (world.episodes.number - 1).clamp(min=0).cpu()
        by_class = torch.bincount(world.task_id.cpu(), weights=finished, minlength=world.num_tasks)
        metrics = watch() if watch else {}
        return {**metrics, EPISODES: float(by_class.min())}

    return watched


def played(pools: Mapping[str, Sequence[str]]) -> tuple[int, int]:
    """Return the number of tasks per class and of episodes per task in an evaluation during training.

    ``pools`` has the names of each class's tasks.
    """
    tasks = min(TASKS, max(map(len, pools.values())))
    return tasks, math.ceil(_LEAST / (tasks * len(pools)))


@contextmanager
def undisturbed(device: torch.device) -> Iterator[None]:
    """Run the block without gradients, and afterwards restore all random number generators.

    Random draws inside the block therefore do not affect later draws outside the block.
    """
    python = random.getstate()
    legacy = np.random.get_state()
    with torch.random.fork_rng([device] if device.type == "cuda" else []), torch.no_grad():
        yield
    random.setstate(python)
    np.random.set_state(legacy)


def _metrics(found: Evaluation) -> dict[str, float]:
    """Return the metrics of an evaluation, for each class and as means over classes."""
    classes = found.classes
    metrics = {
        "Eval/success_rate": float(np.mean([result.success for result in classes.values()])),
        "Eval/mean_return": float(np.mean([result.mean_return for result in classes.values()])),
    }
    scores = [result.score for result in classes.values() if result.score is not None]
    if len(scores) == len(classes):
        metrics["Eval/score"] = float(np.mean(scores))
    for name, result in classes.items():
        metrics[f"Eval/success/{name}"] = result.success
        metrics[f"Eval/return/{name}"] = result.mean_return
    return metrics


def _better(found: dict[str, float], best: dict[str, float]) -> bool:
    """Return whether a result is better than ``best``: by success, then by score (by return if there is no score)."""
    if "Eval/score" in found and "Eval/score" in best:
        second = "Eval/score"
    else:
        second = "Eval/mean_return"
    return [found[name] for name in ("Eval/success_rate", second)] > [best["Eval/success_rate"], best[second]]
