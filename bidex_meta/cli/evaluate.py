"""``bidex-meta evaluate``: how good is a trained run."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from bidex_meta.cli.parsing import RunPath, Switch, parse
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.worlds import Worlds


@dataclass(frozen=True)
class EvaluateFlags:
    """Success and return of a run's policy (mean action), the same number of episodes for every task.

    Example: bidex-meta evaluate runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --random

    What adapts to tasks (maml, promp, rl2, ...) is shown before and after --shots shots, on train and on test tasks.
    """

    run: RunPath
    """Run folder."""
    checkpoint: str = "last"
    """Which policy: last, best (kept by `bidex-meta run --evaluate-every N`) or a file."""
    episodes: Few | None = None
    """Episodes of each task; None: 4, or 1 where a task fixes its start (metaworld/...); for what adapts, as many as
    --rollouts."""
    split: Literal["auto", "train", "test", "both"] = "auto"
    """Tasks to play: those trained on, or a meta suite's unseen ones; auto: train, and both for what adapts."""
    shots: Shots | None = None
    """Adapt so often, one after the other, to --rollouts episodes each; None: 1."""
    rollouts: Few | None = None
    """Episodes of each task in a shot; None: as the run was trained, but 40 at most, else 10."""
    tasks: Few | None = None
    """Adapt to the first so many tasks of each class; None: 5."""
    trials: Few | None = None
    """Adapt to each task so often, each time from the start and to other episodes; None: once, or
    as often as makes five adaptations of each class."""
    random: Switch = False
    """Also play a random policy, and show the difference."""
    seed: Seed | None = None
    """Seed of the episodes' starts; None: one that training does not use."""
    num_envs: Environments | None = None
    """Rows stepped together, a multiple of the number of tasks; None: one per task (metaworld/...: 5 per class). For
    what adapts, at most so many, which bounds memory and not results' meaning; None: 1024."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics; auto: the one that is fast on the device."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Evaluate a checkpoint and print a table or JSON."""
    flags = parse(EvaluateFlags, arguments, "evaluate")

    from bidex_meta.cli.conditions import conditions
    from bidex_meta.cli.learners import learner_kind, resolve_device
    from bidex_meta.cli.policies import load_policy
    from bidex_meta.cli.tables import evaluation_table, print_table
    from bidex_meta.evaluation.play import EVALUATION_SEED, RandomAgent
    from bidex_meta.evaluation.results import compare
    from bidex_meta.runs import RunFolder
    from bidex_meta.world.threads import set_up_torch

    folder = RunFolder.open(flags.run)
    stored = folder.config()
    device = resolve_device(flags.device, Worlds.open(stored.to_json()).on_gpu)
    config = replace(stored, device=device, engine=flags.engine)
    source = Worlds.open(config.to_json())
    set_up_torch(config.threads)
    kind = learner_kind(stored.algo)
    if kind.make.adapts:
        _meta_test(flags, folder, config, source)
        return
    _refuse_adaptation(flags, stored.algo)
    policy, step = load_policy(folder, device, flags.checkpoint)
    split = "train" if flags.split == "auto" else flags.split
    world = source.world(split, flags.num_envs)
    seed = EVALUATION_SEED if flags.seed is None else flags.seed
    found = source.judge(policy, world, flags.episodes, seed)
    random = None
    if flags.random:
        random = source.judge(RandomAgent(world.action_space), world, flags.episodes, seed)
    world.close()
    if not flags.json:
        title = f"{config.algo} on {source.name}, {split} tasks, {step:,} steps"
        print_table(evaluation_table(title, found, random))
        return
    result = {"run": str(folder.path), "steps": step, "split": split, "seed": seed, "policy": found.to_json()}
    if random is not None:
        differences = {name: asdict(difference) for name, difference in compare(found, random).items()}
        result |= {"random": random.to_json(), "return_above_random": differences}
    result["conditions"] = conditions(source, flags.num_envs)
    print(json.dumps(result, indent=2))


def _refuse_adaptation(flags: EvaluateFlags, algo: str) -> None:
    for name in ("shots", "rollouts", "tasks", "trials"):
        if getattr(flags, name) is not None:
            raise BidexError(f"{algo} does not adapt to tasks, got --{name} {getattr(flags, name)}. Leave it out.")
    if flags.split == "both":
        raise BidexError(f"{algo} does not adapt to tasks: its splits are shown one by one. Use --split train or test.")


def _meta_test(flags: EvaluateFlags, folder: Any, config: RunConfig[Any], source: Worlds) -> None:
    import sys

    from bidex_meta.cli import metatest
    from bidex_meta.cli.conditions import conditions
    from bidex_meta.cli.policies import policy_loader
    from bidex_meta.evaluation.play import EVALUATION_SEED

    if flags.random:
        raise BidexError(f"{config.algo} is compared with itself before adaptation. Leave --random out.")
    metatest.check_source(source, config.algo)
    splits = metatest.splits_of(source, flags.split)
    seed = EVALUATION_SEED if flags.seed is None else flags.seed
    numbers = (flags.shots, flags.rollouts, flags.episodes, flags.tasks, flags.trials, flags.num_envs)
    load, step = policy_loader(folder, config.device, flags.checkpoint)
    found = metatest.meta_test(
        source,
        config,
        load,
        metatest.Options(*numbers, seed),
        splits,
        lambda text: print(text, file=sys.stderr, flush=True),
    )
    if not flags.json:
        metatest.print_tables(f"{config.algo} on {source.name}, {step:,} steps", found)
        return
    result = {"run": str(folder.path), "steps": step, "seed": seed, "splits": metatest.report(found)}
    result["conditions"] = conditions(source, flags.num_envs)
    print(json.dumps(result, indent=2))
