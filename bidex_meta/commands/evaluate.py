"""``bidex-meta evaluate``: how good is a trained run."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from bidex_meta.commands.parsing import RunPath, Switch, parse


@dataclass(frozen=True)
class EvaluateFlags:
    """Success and return of a run's policy (mean action), the same number of episodes for every task.

    Example: bidex-meta evaluate runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --random
    """

    run: RunPath
    """Run folder."""
    episodes: int | None = None
    """Episodes of each task; None: 4, or 1 where a task fixes its start (metaworld/...)."""
    split: Literal["train", "test"] = "train"
    """Tasks to play: those trained on, or a meta suite's unseen ones."""
    random: Switch = False
    """Also play a random policy, and show the difference."""
    seed: int | None = None
    """Seed of the episodes' starts; None: one that training does not use."""
    num_envs: int | None = None
    """Rows stepped together, a multiple of the number of tasks; None: one per task (metaworld/...: 5 per class)."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics; auto: the one that is fast on the device."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Evaluate the newest checkpoint and print a table or JSON."""
    flags = parse(EvaluateFlags, arguments, "evaluate")

    import torch

    from bidex_meta.commands import worlds
    from bidex_meta.commands.learners import resolve_device
    from bidex_meta.commands.tables import evaluation_table, print_table
    from bidex_meta.evaluate import RandomAgent, compare
    from bidex_meta.record import RunFolder

    folder = RunFolder.open(flags.run)
    stored = folder.config()
    config = {**stored, "device": resolve_device(flags.device, stored["suite"]), "engine": flags.engine}
    torch.set_num_threads(config["threads"])
    policy, step = worlds.load_policy(folder, config["device"])
    world = worlds.evaluation_world(config, flags.split, flags.num_envs)
    seed = worlds.EVALUATION_SEED if flags.seed is None else flags.seed
    found = worlds.judge(config, policy, world, flags.episodes, seed)
    random = None
    if flags.random:
        random = worlds.judge(config, RandomAgent(world.action_space), world, flags.episodes, seed)
    world.close()
    if not flags.json:
        title = f"{config['algo']} on {config['suite'] or config['task']}, {flags.split} tasks, {step:,} steps"
        print_table(evaluation_table(title, found, random))
        return
    result = {"run": str(folder.path), "steps": step, "split": flags.split, "seed": seed, "policy": found.to_json()}
    if random is not None:
        differences = {name: asdict(difference) for name, difference in compare(found, random).items()}
        result |= {"random": random.to_json(), "return_above_random": differences}
    print(json.dumps(result, indent=2))
