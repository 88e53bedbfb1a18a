"""``bidex-meta evaluate``: how good is a trained run."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from bidex_meta.agents import Agent
from bidex_meta.cli.parsing import Device, Engine, JsonSwitch, RunPath, Switch, parse
from bidex_meta.cli.tables import Json, Sheet, evaluation_table, print_meta_test, print_table, result_table
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import RandomAgent
from bidex_meta.evaluation.results import compare
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.metatest import Options, check_worlds, meta_test, splits_of
from bidex_meta.experiments.policies import load_policy, policy_loader
from bidex_meta.runs import RunFolder
from bidex_meta.suite import OTHERS
from bidex_meta.train.launch import say
from bidex_meta.utils.files import portable
from bidex_meta.utils.waiting import note
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds


@dataclass(frozen=True, kw_only=True)
class EvaluateFlags(Options):
    """Success and return of a run's policy (mean action), the same number of episodes for every task.

    Example: bidex-meta evaluate runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --random

    Learners that adapt (maml, promp, rl2, ...) are shown before and after --shots shots, on train and on test tasks.
    """

    run: RunPath  # Run folder.
    checkpoint: str = "last"  # Which policy: last, best (kept by `bidex-meta run --evaluate-every N`) or a file.
    split: Literal["auto", "train", "test", "others", "both"] = "auto"
    """Tasks to play: those trained on, a meta suite's unseen ones, or for learners that adapt others of the train
    classes; auto: train, and train and test for learners that adapt."""
    random: Switch = False  # Also play a random policy, and show the difference.
    other_tasks: Switch = False  # Also play as many tasks that no run trained on, drawn by another seed.
    randomisation: Path | None = None
    """Randomise the worlds by the table of this TOML file (docs/randomisation.md); None: not at all."""
    device: Device = "auto"
    engine: Engine = "auto"
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Evaluate a checkpoint and print a table or JSON."""
    flags = parse(EvaluateFlags, arguments, "evaluate")
    folder = RunFolder.open(flags.run)
    stored = folder.config()
    device = resolve_device(flags.device, Worlds.open(stored.to_json()).on_gpu)
    config = replace(stored, device=device, engine=flags.engine)
    randomisation = None if flags.randomisation is None else str(flags.randomisation)
    worlds = Worlds.open({**config.to_json(), "randomisation": randomisation})
    set_up_torch(config.threads)
    play = _meta_test if learner_kind(config.algo).make.adapts else _evaluate
    result = play(flags, folder, config, worlds)
    if flags.json:
        run = {"run": portable(str(folder.path)), **result, "conditions": conditions(worlds, flags.num_envs)}
        run |= {"randomisation": asdict(worlds.randomisation)} if worlds.randomisation else {}
        print(json.dumps(run, indent=2))


def _evaluate(flags: EvaluateFlags, folder: RunFolder, config: RunConfig, worlds: Worlds) -> Json:
    """Plays, and prints the table if no JSON is wanted."""
    asked = {"shots": flags.shots, "rollouts": flags.rollouts, "tasks": flags.tasks, "trials": flags.trials}
    for name, number in asked.items():
        if number is not None:
            raise BidexError(f"{config.algo} does not adapt to tasks, got --{name} {number}. Leave it out.")
    if flags.split == "both":
        raise BidexError(
            f"{config.algo} does not adapt to tasks: its splits are shown one by one. Use --split train or test."
        )
    if flags.split == OTHERS:
        raise BidexError(f"{config.algo} does not adapt to tasks: --other-tasks plays others beside its own.")
    policy, step = load_policy(folder, config.device, flags.checkpoint)
    split = "train" if flags.split == "auto" else flags.split
    title = f"{config.algo} on {worlds.name}, {split} tasks, {step:,} steps"
    title += f", randomised by {flags.randomisation}" if flags.randomisation else ""
    result, table = judged(worlds, policy, step, split, flags, flags.random, title)
    tables = [table]
    if flags.other_tasks:
        result["other_tasks"], table = judged_on_others(worlds, config.algo, policy, step, split, flags, flags.random)
        tables.append(table)
    if not flags.json:
        for table in tables:
            print_table(table)
    return result


def judged_on_others(
    worlds: Worlds,
    algo: str,
    policy: Agent,
    step: int,
    split: str,
    options: Options,
    random: bool,
    brief: bool = False,
) -> tuple[Json, Sheet]:
    """``judged`` on as many tasks of each class that the run was not trained on."""
    others = worlds.others
    title = f"{algo} on {others.name}, other tasks (seed {others.seed})"
    found, table = judged(others, policy, step, split, options, random, title, brief)
    return {"task_seed": others.seed, **found}, table


def judged(
    worlds: Worlds,
    policy: Agent,
    step: int,
    split: str,
    options: Options,
    random: bool,
    title: str,
    brief: bool = False,
) -> tuple[Json, Sheet]:
    """The evaluation of a policy on a split, beside that of a random one if asked, as JSON and as a table.

    ``brief`` ones, always beside random, have a table for a terminal.
    """
    note(f"Building the world of {worlds.name}")
    world = worlds.world(split, options.num_envs)
    protocol = worlds.protocol(split, options.episodes, options.seed)
    found = worlds.judge(policy, world, protocol)
    result = {"steps": step, "split": split, "seed": protocol.seed, "policy": found.to_json()}
    other = None
    if random:
        other = worlds.judge(RandomAgent(world.action_space), world, protocol)
        differences = {name: asdict(difference) for name, difference in compare(found, other).items()}
        result |= {"random": other.to_json(), "return_above_random": differences}
    world.close()
    return result, result_table(title, found, other) if brief and other else evaluation_table(title, found, other)


def _meta_test(flags: EvaluateFlags, folder: RunFolder, config: RunConfig, worlds: Worlds) -> Json:
    """As ``_evaluate``, of a learner that adapts."""
    if flags.random:
        raise BidexError(f"{config.algo} is compared with itself before adaptation. Leave --random out.")
    if flags.other_tasks:
        raise BidexError(f"{config.algo} adapts: --split others plays other tasks of its train classes.")
    check_worlds(worlds, config.algo)
    splits = splits_of(worlds, flags.split)
    load, step = policy_loader(folder, config.device, flags.checkpoint)
    found = meta_test(worlds, config, load, flags, splits, say)
    if not flags.json:
        print_meta_test(f"{config.algo} on {worlds.name}, {step:,} steps", found)
    tests = {split: result.to_json() for split, result in found.items()}
    return {"steps": step, "seed": flags.seed, "splits": tests}
