"""``bidex-meta run``: config, world, learner, run folder, training, evaluation, in this order.

Of several processes (torchrun) each has a world and a learner; process 0 alone writes, speaks and evaluates.
"""

import contextlib
import json
import math
import signal
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bidex_meta.commands import run_demonstrations, run_offline, run_recording
from bidex_meta.commands.conditions import conditions
from bidex_meta.commands.learners import start_from
from bidex_meta.commands.run_config import RunPlan, plan_run
from bidex_meta.errors import BidexError
from bidex_meta.record.folder import check_new, new_folder_name
from bidex_meta.train.launch import launch, resume_command

if TYPE_CHECKING:
    from bidex_meta.world.contract import VectorWorld

Checkpoint = tuple[dict[str, Any], int]
"""State and environment steps."""


def main(arguments: Sequence[str]) -> None:
    """Train and evaluate.

    Raises:
        BidexError: Bad input. Nothing has been written then.
        SystemExit: Another process was lost (exit code 1), or has said what is wrong with the input (2); Ctrl-C (130),
            SIGHUP (129) or the end of what reads stderr (141) came while it trained, which has saved then.
    """
    from bidex_meta.train import distributed

    with contextlib.ExitStack() as held:
        _main(arguments, distributed, held)


def _main(arguments: Sequence[str], distributed: Any, held: contextlib.ExitStack) -> None:
    """Does what ``main`` does, and holds the lock of the run folder for as long as ``held`` is open."""
    try:
        distributed.init_from_environment()
        plan = distributed.together(lambda: plan_run(arguments))
        if plan.flags.print_config:
            if launch().rank == 0:
                print(json.dumps(plan.config, indent=2))
            distributed.shut_down()
            return
        folder, learner, stopped = _run(plan, distributed, held)
    except distributed.LostProcess as loss:
        _say_loss(loss, distributed)
        raise SystemExit(1) from None
    if not stopped and learner.env_steps < plan.config["steps"] and plan.config["minutes"] is not None:
        _say(f"The {plan.config['minutes']:g} minutes are up after {learner.env_steps:,} steps.")
    if stopped:
        # A batch system's SIGTERM asks for a checkpoint and gets it; the others break off whatever calls this too.
        command = resume_command(folder.path, launch().count)
        _say(f"Stopped after {learner.env_steps:,} steps and saved. Continue: {command}")
        if stopped != signal.SIGTERM:
            raise SystemExit(128 + stopped)
    elif plan.flags.evaluate and launch().rank == 0:
        _evaluate(plan, folder, learner)


def _run(plan: RunPlan, distributed: Any, held: contextlib.ExitStack) -> tuple[Any, Any, int]:
    """What all processes do: the run folder, the trained learner, and the signal that ended it early, or 0."""
    from bidex_meta.record import RunFolder
    from bidex_meta.world.threads import set_up_torch

    distributed.together(lambda: _check_folder(plan, held))
    loaded = distributed.together(lambda: _read(plan))
    plan = _agree(plan, loaded, distributed)
    config, count = plan.config, launch().count
    # Sums depend on how torch splits them over threads: a resumed run must use the number it began with.
    set_up_torch(config["threads"])
    times = f"{count} x " if count > 1 else ""
    _say(
        f"{config['algo']} on {plan.source.name}, {times}{config['num_envs']} rows on {config['device']}, "
        f"seed {config['seed']}"
    )
    _say(f"Preset {config['preset']}: {plan.preset_reason}.")
    world, learner, folder = distributed.together(lambda: _make(plan, loaded is None, held))
    folder = RunFolder(distributed.share(folder and folder.path)[0])
    _say(f"Run folder: {folder.path}")
    recorder = world if plan.config["record"] else None
    if recorder is not None:
        recorder.folder = folder.path / "replay"
        if loaded is None:  # a checkpoint knows which parts stay
            distributed.together(lambda: recorder.open(recorder.folder))
    waits = distributed.LostProcess("this one was asked to stop and waits for it")
    distributed.on_loss(lambda: _say_loss(waits, distributed, folder))
    try:
        stopped = _train(plan, folder, world, learner, loaded)
        if recorder is not None and launch().rank == 0:
            run_recording.complete(plan, recorder)
        distributed.shut_down()
    except distributed.LostProcess as loss:
        _say_loss(loss, distributed, folder)
        raise SystemExit(1) from None
    world.close()
    return folder, learner, stopped


def _check_folder(plan: RunPlan, held: contextlib.ExitStack) -> None:
    """Makes sure that the run's folder can be written, and that nobody else trains there, before anything is built."""
    if launch().rank > 0:
        return
    if plan.folder is not None:
        plan.folder.check_own()
        held.enter_context(plan.folder.locked())
    else:
        # Of a name that no other run has, should one begin in this second too.
        name = new_folder_name(plan.config)
        check_new(plan.flags.run_dir or name.with_name(f"{name.name}_0"))


def _read(plan: RunPlan) -> Checkpoint | None:
    from bidex_meta.commands.policies import checkpoint
    from bidex_meta.record import RunFolder

    if plan.kind.adapts:
        from bidex_meta.commands.metatest import check_source, splits_of

        check_source(plan.source, plan.config["algo"])
        splits_of(plan.source, plan.flags.split)
    if launch().rank == 0:
        from bidex_meta.commands import watching

        watching.check(plan)
    if plan.folder is None and plan.config["start_from"] is not None:
        start = RunFolder.open(Path(plan.config["start_from"]))
        if start.checkpoints.newest_step() is None:
            checkpoint(start)  # refuses it now rather than when the world has been built
    return plan.folder.checkpoints.load() if plan.folder else None


def _agree(plan: RunPlan, loaded: Checkpoint | None, distributed: Any) -> RunPlan:
    """The plan with process 0's config.

    Raises:
        BidexError: The processes were started with different flags, or see different checkpoints.
    """
    everyone = distributed.share((plan.config, loaded and loaded[1]))

    def check() -> None:
        config, step = everyone[0]
        for number, (other, other_step) in enumerate(everyone):
            # Machines may differ in cores; the run keeps the threads of process 0.
            differ = [f"{name} = {other[name]}, not {config[name]}" for name in config if other[name] != config[name]]
            differ = [text for text in differ if not text.startswith("threads")]
            if differ:
                raise BidexError(f"Process {number} has {differ[0]} as process 0. Start all with the same flags.")
            if other_step != step:
                raise BidexError(
                    f"Process {number} finds a checkpoint at {other_step} steps, process 0 at {step}. The run folder "
                    "must be one that all machines see."
                )

    distributed.together(check)
    return replace(plan, config=everyone[0][0])


def _make(plan: RunPlan, fresh: bool, held: contextlib.ExitStack) -> tuple[Any, Any, Any]:
    """World, learner (a fresh one with the weights it shall start from) and, in process 0, the run folder."""
    from bidex_meta.commands.policies import checkpoint, fitting
    from bidex_meta.record import RunFolder

    world = plan.source.world("train", plan.config["num_envs"], plan.kind.autoreset(plan.config["learner"]))
    if plan.config["record"]:
        world = run_recording.recorded(plan, world)
    learner = plan.kind.make(world, plan.learner_config, plan.config["seed"])
    if plan.kind.offline:
        run_offline.give(plan.config["dataset"], learner)
    if plan.config["demonstrations"] is not None:
        run_demonstrations.give(plan.config["demonstrations"], learner)
    if fresh and plan.config["start_from"] is not None:
        start = RunFolder.open(Path(plan.config["start_from"]))
        state, step = checkpoint(start)
        with fitting(start.path):
            start_from(learner, state["learner"]["policy"])
        _say(f"Starting from the policy of {plan.config['start_from']} at {step:,} steps.")
    if launch().rank > 0:
        return world, learner, None
    if plan.folder is not None:
        return world, learner, plan.folder
    folder = RunFolder.create(plan.config, plan.flags.run_dir, identity=plan.source.identity())
    held.enter_context(folder.locked())
    return world, learner, folder


def _train(plan: RunPlan, folder: Any, world: "VectorWorld", learner: Any, loaded: Checkpoint | None) -> int:
    """Train to the end; the signal that ended it early, or 0."""
    from bidex_meta.commands.policies import fitting
    from bidex_meta.record import Recorder, mend, training_seconds
    from bidex_meta.train import distributed, runner

    resume_step = None
    if loaded is not None:
        state, resume_step = loaded
        with fitting(folder.path):
            distributed.together(lambda: runner.resume(learner, world, state))
        _say(f"Continuing at {resume_step:,} steps.")
    elif plan.folder is not None:
        resume_step = 0  # killed before its first checkpoint: the same seed takes it there again
        _say("No checkpoint yet: starting from the beginning.")
    budget = _budget(plan.config)
    if launch().rank > 0:
        return runner.train(
            learner, world, **budget, record=None, enough=run_recording.enough(plan.config)
        )  # process 0's clock decides
    folder.finish(resume_step)
    if plan.folder is not None and folder.config() != plan.config:
        folder.change_config(plan.config)  # more steps, say; not before it is known that the run goes on
    done = mend(folder.metrics_path, resume_step or 0)
    logger, total = plan.config["logger"], dict(budget)
    budget["spent_seconds"] = training_seconds(done)
    last = done[-1] if done and done[-1]["step"] == resume_step else None
    with Recorder(folder, **total, resume_step=resume_step, logger=logger) as record, contextlib.ExitStack() as stack:
        watch = None
        if plan.config["evaluate_every"] or plan.config["video_every"]:
            from bidex_meta.commands.watching import Watch

            watch = Watch(plan, folder, learner, record, iterations=len(done))
            stack.callback(watch.close)
        return runner.train(
            learner, world, **budget, record=record, watch=watch, enough=run_recording.enough(plan.config), last=last
        )


def _budget(config: dict[str, Any]) -> dict[str, Any]:
    """When training ends: whichever of the two comes first."""
    minutes = math.inf if config["minutes"] is None else config["minutes"]
    return {"total_steps": config["steps"], "total_seconds": 60.0 * minutes}


def _say_loss(loss: Exception, distributed: Any, folder: Any = None) -> None:
    """Say that another process is gone, and what is left; but only in the first process that notices."""
    missing = distributed.report_loss()
    if missing is None:
        return
    count, which = launch().count, ", ".join(map(str, missing))
    gone = f"process {which} of {count} is gone or stuck" if which else f"one of {count} processes has ended"
    left = "Training had not begun." if folder is None else _what_is_left(folder, count)
    print(f"bidex-meta: {gone} ({loss}). {left}", file=sys.stderr, flush=True)


def _what_is_left(folder: Any, processes: int) -> str:
    step = folder.checkpoints.newest_step() if folder.checkpoints_path.is_dir() else None
    saved = "There is no checkpoint yet" if step is None else f"The last checkpoint is at {step:,} steps"
    return f"{saved}, in {folder.checkpoints_path}. Continue: {resume_command(folder.path, processes)}"


def _evaluate(plan: RunPlan, folder: Any, learner: Any) -> None:
    if plan.kind.adapts:
        _meta_test(plan, folder, learner)
        return
    from bidex_meta.commands.tables import evaluation_table, print_table
    from bidex_meta.evaluation.play import EVALUATION_SEED
    from bidex_meta.evaluation.results import compare
    from bidex_meta.evaluation.untrained import RandomAgent
    from bidex_meta.record.atomic import write_json

    source, seed = plan.source, EVALUATION_SEED
    episodes = plan.flags.episodes or source.default_episodes
    _say(f"Evaluating: {episodes} episode{'s' * (episodes > 1)} of each task, and as many of a random policy.")
    world = source.world()
    trained = source.judge(learner, world, episodes, seed)
    random = source.judge(RandomAgent(world.action_space), world, episodes, seed)
    world.close()
    above = {name: asdict(difference) for name, difference in compare(trained, random).items()}
    found = {"run": str(folder.path), "steps": learner.env_steps, "split": "train", "seed": seed}
    found |= {"policy": trained.to_json(), "random": random.to_json(), "return_above_random": above}
    found["conditions"] = conditions(source)
    write_json(folder.path / "evaluation.json", found)
    title = f"{plan.config['algo']} on {source.name}, {learner.env_steps:,} steps"
    print_table(evaluation_table(title, trained, random))
    _say(f"Again: bidex-meta evaluate {folder.path}   Curves: bidex-meta plot {folder.path}")


def _meta_test(plan: RunPlan, folder: Any, learner: Any) -> None:
    from bidex_meta.commands import metatest
    from bidex_meta.record.atomic import write_json

    state, device = learner.policy_state_dict(), launch().own_device(plan.config["device"])
    flags, source = plan.flags, plan.source
    options = metatest.Options(flags.shots, flags.rollouts, flags.episodes, flags.tasks)
    load = partial(plan.kind.make.load_policy, state, device)
    splits = metatest.splits_of(source, flags.split)
    found = metatest.meta_test(source, plan.config, load, options, splits, _say)
    report = {"steps": learner.env_steps, "seed": options.seed, "splits": metatest.report(found)}
    report["conditions"] = conditions(source)
    write_json(folder.path / "evaluation.json", report)
    metatest.print_tables(f"{plan.config['algo']} on {source.name}, {learner.env_steps:,} steps", found)
    _say(f"More: bidex-meta evaluate {folder.path} --shots 3 --tasks 50   See bidex-meta plot --help for curves.")


def _say(text: str) -> None:
    if launch().rank == 0:
        print(text, file=sys.stderr, flush=True)
