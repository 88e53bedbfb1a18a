"""``bidex-meta evaluate``: measure success and return of a trained run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from bidex_meta.cli.parsing import Device, Engine, JsonSwitch, RunPath, Switch, parse
from bidex_meta.cli.tables import print_evaluation, print_meta_test
from bidex_meta.errors import BidexError
from bidex_meta.experiments.evaluating import RunMetaTest, evaluate, meta_test
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.metatest import Options, Played
from bidex_meta.runs import RunFolder
from bidex_meta.suite import OTHERS
from bidex_meta.training.learner import Capability


@dataclass(frozen=True, kw_only=True)
class EvaluateFlags(Options):
    """Measure success and return of a run's policy (mean action), with the same number of episodes for every task.

    Example: bidex-meta evaluate runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --random

    Learners that adapt (maml, promp, rl2, ...) are evaluated on train and on test tasks, before adaptation and after
    each shot up to --shots.
    """

    run: RunPath  # Folder of the run to evaluate.
    checkpoint: str = "last"
    """Checkpoint to evaluate: last, best (kept by `bidex-meta run --evaluate-every N`) or a file."""
    split: Played = "auto"
    """Tasks to play. train: the tasks of training; test: a meta suite's unseen tasks. For learners that adapt also
    others: unseen tasks of the train classes; unseen: others and test. auto: train, and for learners that adapt train
    and test."""
    random: Switch = False  # Also play a random policy on the same tasks and print the difference.
    other_tasks: Switch = False
    """Also play an equal number of tasks that the run was not trained on, drawn from another seed."""
    randomisation: Path | None = None
    """Randomise the worlds by the table in this TOML file (docs/randomisation.md); None: no randomisation."""
    device: Device = "auto"
    engine: Engine = "auto"
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Evaluate a checkpoint and print a table or JSON."""
    flags = parse(EvaluateFlags, arguments, "evaluate")
    config = RunFolder.open(flags.run).config()
    where: dict[str, Any] = {"checkpoint": flags.checkpoint, "device": flags.device, "engine": flags.engine}
    if Capability.ADAPTS in learner_kind(config.algo, config.task).capabilities:
        _refuse_for_adapting(flags, config.algo)
        size = {entry.name: getattr(flags, entry.name) for entry in fields(Options)}
        found = meta_test(flags.run, split=flags.split, randomisation=flags.randomisation, **size, **where)
    else:
        _refuse_for_fixed(flags, config.algo)
        found = evaluate(
            flags.run, split="train" if flags.split == "auto" else flags.split, random=flags.random,
            other_tasks=flags.other_tasks, episodes=flags.episodes, num_envs=flags.num_envs, seed=flags.seed,
            randomisation=flags.randomisation, **where,
        )  # fmt: skip
    if flags.json:
        print(json.dumps(found.to_json(), indent=2))
    elif isinstance(found, RunMetaTest):
        print_meta_test(found)
    else:
        print_evaluation(found)


def _refuse_for_adapting(flags: EvaluateFlags, algo: str) -> None:
    if flags.random:
        raise BidexError(f"{algo} adapts, so it is compared with itself before adaptation. Leave --random out.")
    if flags.other_tasks:
        raise BidexError(f"{algo} adapts: --split others plays unseen tasks of its train classes.")


def _refuse_for_fixed(flags: EvaluateFlags, algo: str) -> None:
    flags.refuse_adaptation(algo)
    if flags.split == "unseen":
        raise BidexError(
            f"{algo} does not adapt to tasks: each split is evaluated separately. Use --split train or test."
        )
    if flags.split == OTHERS:
        raise BidexError(f"{algo} does not adapt to tasks: --other-tasks plays unseen tasks in addition to its own.")
