"""``bidex-meta run``: config, world, learner, run folder, training, evaluation, in this order."""

import importlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from bidex_meta.commands.run_config import RunPlan, plan_run


def main(arguments: Sequence[str]) -> None:
    """Train and evaluate.

    Raises:
        BidexError: Bad input. Nothing has been written then.
    """
    plan = plan_run(arguments)
    if plan.flags.print_config:
        print(json.dumps(plan.config, indent=2))
        return
    import torch

    from bidex_meta.commands import worlds
    from bidex_meta.record import RunFolder

    config = plan.config
    worlds.check_names(config)
    # Sums depend on how torch splits them over threads: a resumed run must use the number it began with.
    torch.set_num_threads(config["threads"])
    subject = config["suite"] or config["task"]
    _say(f"{config['algo']} on {subject}, {config['num_envs']} rows on {config['device']}, seed {config['seed']}")
    _say(f"Preset {config['preset']}: {plan.preset_reason}.")
    loaded = plan.folder.checkpoints.load() if plan.folder else None
    world = worlds.training_world(config)
    learner = plan.kind.make(world, plan.learner_config, config["seed"])
    folder = plan.folder or RunFolder.create(config, plan.flags.run_dir)
    if folder.config() != config:
        folder.change_config(config)  # a resumed run with more steps
    _say(f"Run folder: {folder.path}")
    stopped = _train(plan, folder, world, learner, loaded)
    world.close()
    if stopped:
        _say(f"Stopped after {learner.env_steps:,} steps and saved. Continue: bidex-meta run --resume {folder.path}")
    elif plan.flags.evaluate:
        _evaluate(plan, folder, learner)


def _train(plan: RunPlan, folder: Any, world: Any, learner: Any, loaded: tuple[dict[str, Any], int] | None) -> bool:
    """Train to the end; True if a signal ended it early."""
    from bidex_meta.record import Recorder

    runner = importlib.import_module("bidex_algos.runner")
    resume_step = None
    if loaded is not None:
        state, resume_step = loaded
        runner.resume(learner, world, state)
        _say(f"Continuing at {resume_step:,} steps.")
    elif plan.folder is not None:
        resume_step = 0  # killed before its first checkpoint: the same seed takes it there again
        _say("No checkpoint yet: starting from the beginning.")
    with Recorder(folder, plan.config["steps"], resume_step) as record:
        return runner.train(learner, world, total_steps=plan.config["steps"], record=record)


def _evaluate(plan: RunPlan, folder: Any, learner: Any) -> None:
    from bidex_meta.commands import worlds
    from bidex_meta.commands.tables import evaluation_table, print_table
    from bidex_meta.evaluate import RandomAgent, compare, evaluate
    from bidex_meta.record.atomic import write_json
    from bidex_meta.references import references

    _say(f"Evaluating: {plan.flags.episodes} episodes of each task, and as many of a random policy.")
    world = worlds.evaluation_world(plan.config)
    seed, episodes = worlds.EVALUATION_SEED, plan.flags.episodes
    # Both references are of moving bases, as suites have them.
    known = references() if plan.config["suite"] is not None else {}
    trained = evaluate(learner, world, episodes, seed=seed, references=known)
    random = evaluate(RandomAgent(world.action_space), world, episodes, seed=seed, references=known)
    world.close()
    above = {name: asdict(difference) for name, difference in compare(trained, random).items()}
    found = {"policy": trained.to_json(), "random": random.to_json(), "return_above_random": above}
    write_json(folder.path / "evaluation.json", found)
    title = f"{plan.config['algo']} on {plan.config['suite'] or plan.config['task']}, {learner.env_steps:,} steps"
    print_table(evaluation_table(title, trained, random))
    _say(f"Again: bidex-meta evaluate {folder.path}   Curves: bidex-meta plot {folder.path}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
