"""``bidex-meta run``: config, folder, worlds, learner, training, evaluation, in this order.

Of several processes (torchrun) each has a world and a learner; process 0 alone writes, reports and evaluates.
"""

import contextlib
import math
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bidex_meta.cli import run_recording, watching
from bidex_meta.cli.evaluate import judged, judged_on_others
from bidex_meta.cli.run_config import RunPlan, plan_run
from bidex_meta.cli.tables import Json, print_meta_test, print_table
from bidex_meta.config import RunConfig, printed
from bidex_meta.data.joined import join
from bidex_meta.errors import BidexError
from bidex_meta.experiments import metatest, run_data, run_teachers
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.policies import checkpoint, fitting, say_other_rules
from bidex_meta.runs import Recorder, RunFolder, mend, training_seconds
from bidex_meta.runs.atomic import write_json
from bidex_meta.runs.folder import check_new, new_folder_name
from bidex_meta.train import distributed, runner
from bidex_meta.train.distributed import together
from bidex_meta.train.launch import launch, resume_command, say
from bidex_meta.utils.files import portable
from bidex_meta.utils.waiting import note
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.threads import set_up_torch

Checkpoint = tuple[Json, int]  # state and environment steps


def main(arguments: Sequence[str]) -> None:
    """Train and evaluate. After bad input nothing has been written.

    Raises SystemExit where another process was lost (exit code 1), or has reported what is wrong with the input (2);
    where a signal other than SIGTERM (128 and its number) or the end of what reads stderr (141) came while it trained,
    which has saved then.
    """
    try:
        distributed.init_from_environment()
        plan = together(lambda: plan_run(arguments))
        if plan.flags.print_config:
            if launch().rank == 0:
                print(printed(plan.config))
            distributed.shut_down()
            return
        run(plan)
    except distributed.LostProcess as loss:
        _report_loss(loss)
        raise SystemExit(1) from None


def run(plan: RunPlan) -> None:
    """Trains what was planned, from its last checkpoint where there is one, and evaluates it.

    Raises LostProcess where another process is gone before the training has begun, SystemExit as :func:`main`.
    """
    with contextlib.ExitStack() as held:  # the lock of the run's folder
        together(lambda: _check(plan, held))
        loaded = together(lambda: plan.folder.checkpoints.load() if plan.folder else None)
        plan = _agree(plan, loaded)
        config = plan.config
        # Sums depend on how torch splits them over threads: a resumed run must use the number it began with.
        set_up_torch(config.threads)
        rows = f"{launch().count} x {config.num_envs}" if launch().count > 1 else f"{config.num_envs}"
        say(f"{config.algo} on {plan.source.name}, {rows} environments on {config.device}, seed {config.seed}")
        say(f"Preset {config.preset}: {plan.preset_reason}.")
        autoreset = plan.kind.autoreset(config.learner_values)
        note(f"Building the world of {plan.source.name}")
        world: Any = together(lambda: plan.source.world("train", config.num_envs, autoreset))
        if config.record:
            world = together(lambda: run_recording.recorded(plan, world))
        note("Making the learner")
        learner = together(lambda: _make_learner(plan, world, fresh=loaded is None))
        own = together(lambda: plan.folder or (_new_folder(plan, held) if launch().rank == 0 else None))
        path = distributed.share(own and own.path)[0]  # process 0's
        assert path is not None
        folder = RunFolder(path)
        say(f"Run folder: {folder.path}")
        try:
            if config.record:
                together(lambda: run_recording.begin(world, folder.path, fresh=loaded is None))
            waits = distributed.LostProcess("this one was asked to stop and waits for it")
            distributed.on_loss(lambda: _report_loss(waits, folder))
            stopped = _train(plan, folder, world, learner, loaded)
            if config.record and launch().rank == 0:
                run_recording.complete(plan, world)
            distributed.shut_down()
        except distributed.LostProcess as loss:
            _report_loss(loss, folder)
            raise SystemExit(1) from None
        world.close()
        if stopped:
            command = resume_command(folder.path, launch().count)
            say(f"Stopped after {learner.env_steps:,} steps and saved. Continue: {command}")
            # A batch system's SIGTERM asks for a checkpoint and gets it; the others break off whatever calls this too.
            if stopped != signal.SIGTERM:
                raise SystemExit(128 + stopped)
        elif plan.flags.evaluate and launch().rank == 0:
            _evaluate(plan, folder, learner)


def _check(plan: RunPlan, held: contextlib.ExitStack) -> None:
    """Locks the run's folder, and refuses what would fail in the middle of the training, before anything is built."""
    if launch().rank == 0:
        if plan.folder is not None:
            plan.folder.check_own()
            held.enter_context(plan.folder.locked())
        else:
            # Of a name that no other run has, should one begin in this second too.
            name = new_folder_name(plan.config)
            check_new(plan.flags.run_dir or name.with_name(f"{name.name}_0"))
        watching.check(plan)
    if plan.kind.make.adapts:
        metatest.check_worlds(plan.source, plan.config.algo)
        metatest.splits_of(plan.source, plan.flags.split)
    if plan.folder is None and plan.config.start_from is not None:
        start = RunFolder.open(Path(plan.config.start_from))
        if start.checkpoints.newest_step() is None:
            checkpoint(start)  # refuses it


def _agree(plan: RunPlan, loaded: Checkpoint | None) -> RunPlan:
    """The plan with process 0's config; refuses processes that have other flags, or see other checkpoints."""
    everyone = distributed.share((plan.config, loaded and loaded[1]))

    def check() -> None:
        config, step = everyone[0]
        for number, (other, other_step) in enumerate(everyone):
            here, there = config.flat(), other.flat()
            # Machines may differ in cores; the run keeps the threads of process 0.
            for name in here.keys() - {"threads"}:
                if here[name] != there.get(name):
                    raise BidexError(
                        f"Process {number} has {name} = {there.get(name)}, not {here[name]} as process 0. Start all "
                        "with the same flags."
                    )
            if other_step != step:
                raise BidexError(
                    f"Process {number} finds a checkpoint at {other_step} steps, process 0 at {step}. The run folder "
                    "must be one that all machines see."
                )

    together(check)
    return replace(plan, config=everyone[0][0])


def _make_learner(plan: RunPlan, world: VectorWorld, fresh: bool) -> Any:
    """The learner with its data and teachers; a fresh one with the weights that it shall start from."""
    config = plan.config
    learner = plan.kind.make(world, config.learner, config.seed)
    if plan.kind.make.offline:
        learner.learn_from(join(run_data.announced(config.dataset, "Reading", plan.source), world))
    if config.demonstrations:
        demonstrations = run_data.announced(config.demonstrations, "Demonstrations:", plan.source)
        learner.learn_from_demonstrations(join(demonstrations, world, every=False))
    if config.teacher:
        learner.learn_from_teachers(run_teachers.teachers_of(config, plan.source, world))
    if fresh and config.start_from is not None:
        start = RunFolder.open(Path(config.start_from))
        state, step = checkpoint(start)
        with fitting(start.path):
            learner.start_from(state["learner"]["policy"])
        say(f"Starting from the policy of {config.start_from} at {step:,} steps.")
        say_other_rules(start, plan.source)
    return learner


def _new_folder(plan: RunPlan, held: contextlib.ExitStack) -> RunFolder:
    folder = RunFolder.create(plan.config, plan.flags.run_dir, identity=plan.source.identity())
    held.enter_context(folder.locked())
    return folder


def _train(plan: RunPlan, folder: RunFolder, world: VectorWorld, learner: Any, loaded: Checkpoint | None) -> int:
    """Train to the end; the signal that ended it early, or 0."""
    config, resume_step = plan.config, None
    if loaded is not None:
        state, resume_step = loaded
        with fitting(folder.path):
            together(lambda: runner.resume(learner, world, state))
        say(f"Continuing at {resume_step:,} steps.")
    elif plan.folder is not None:
        resume_step = 0  # killed before its first checkpoint: the same seed takes it there again
        say("No checkpoint yet: starting from the beginning.")
    seconds = math.inf if config.minutes is None else 60.0 * config.minutes
    train = partial(
        runner.train, learner, world, total_steps=config.steps, total_seconds=seconds, enough=_early_end(config)
    )
    if launch().rank > 0:
        return train(record=None)  # process 0's clock decides
    folder.finish(resume_step)
    if plan.folder is not None:
        folder.change_config(config)  # more steps, say; not before it is known that the run goes on
    rows = mend(folder.metrics_path, resume_step or 0)
    last = rows[-1] if rows and rows[-1]["step"] == resume_step else None
    with contextlib.ExitStack() as stack:
        size = runner.checkpoint_bytes(learner, world, config.learner, config.steps)
        stack.enter_context(folder.checkpoints.room(size))
        record, watch = stack.enter_context(Recorder(folder, config.steps, seconds, resume_step, config.logger)), None
        if config.evaluate_every is not None or config.video_every is not None:
            watch = watching.Watch(plan, folder, learner, record, len(rows))
            stack.callback(watch.close)
        stopped = train(record=record, watch=watch, last=last, spent_seconds=training_seconds(rows))
    if not stopped and plan.folder is not None and learner.env_steps == resume_step:
        say(_nothing_left(config, learner.env_steps, training_seconds(rows) / 60.0))
    elif not stopped and learner.env_steps < config.steps and config.minutes is not None:
        say(f"The {config.minutes:g} minutes are up after {learner.env_steps:,} steps.")
    return stopped


def _nothing_left(config: RunConfig, steps: int, minutes: float) -> str:
    """Say why a resumed run has nothing to train, and which flag lets it go on."""
    if steps >= config.steps:
        return (
            f"Nothing to train: the run has made {steps:,} steps, and --steps {config.steps} counts them too. For as "
            f"many more: --steps {steps + config.steps}."
        )
    if config.minutes is not None and minutes >= config.minutes:
        more = math.ceil(minutes) + config.minutes
        return (
            f"Nothing to train: the run has trained for {minutes:.1f} minutes, and --minutes {config.minutes:g} counts "
            f"them too. For {config.minutes:g} more: --minutes {more:g}."
        )
    return "Nothing to train: the last iteration was enough. Raise --stop-at-success, -return or -score to go on."


def _early_end(config: RunConfig) -> Any:
    """What ends the training early, by its metrics; None where nothing does."""
    if config.stop_at_return is None and config.stop_at_success is None and config.stop_at_score is None:
        return None

    def reached(metrics: Json) -> bool:
        tag = config.early_end(metrics)
        if tag is not None:
            say(f"Enough: {tag} is {metrics[tag]:.4g}.")
        return tag is not None

    return reached


def _report_loss(loss: Exception, folder: RunFolder | None = None) -> None:
    """Reports that another process is gone, and what is left; but only in the first process that notices."""
    missing = distributed.report_loss()
    if missing is None:
        return
    count, which = launch().count, ", ".join(map(str, missing))
    gone = f"process {which} of {count} is gone or stuck" if which else f"one of {count} processes has ended"
    left = "Training had not begun."
    if folder is not None:
        step = folder.checkpoints.newest_step() if folder.checkpoints_path.is_dir() else None
        saved = "There is no checkpoint yet" if step is None else f"The last checkpoint is at {step:,} steps"
        left = f"{saved}, in {folder.checkpoints_path}. Continue: {resume_command(folder.path, count)}"
    print(f"bidex-meta: {gone} ({loss}). {left}", file=sys.stderr, flush=True)


def _evaluate(plan: RunPlan, folder: RunFolder, learner: Any) -> None:
    if plan.kind.make.adapts:
        _meta_test(plan, folder, learner)
        return
    source, episodes = plan.source, plan.flags.episodes or plan.source.default_episodes
    say(f"Evaluating: {episodes} episode{'s' * (episodes > 1)} of each task, and as many of a random policy.")
    title = f"{plan.config.algo} on {source.name}, {learner.env_steps:,} steps"
    options = metatest.Options(episodes=episodes)
    found, table = judged(source, learner, learner.env_steps, "train", options, random=True, title=title, brief=True)
    tables = [table]
    if plan.flags.other_tasks:
        algo, step = plan.config.algo, learner.env_steps
        found["other_tasks"], table = judged_on_others(source, algo, learner, step, "train", options, True, brief=True)
        tables.append(table)
    write_json(folder.evaluation_path, {"run": portable(str(folder.path)), **found, "conditions": conditions(source)})
    for table in tables:
        print_table(table)
    say(f"More columns: bidex-meta evaluate {folder.path}   Curves: bidex-meta plot {folder.path}")


def _meta_test(plan: RunPlan, folder: RunFolder, learner: Any) -> None:
    device = launch().own_device(plan.config.device)
    flags, source = plan.flags, plan.source
    options = metatest.Options(shots=flags.shots, rollouts=flags.rollouts, episodes=flags.episodes, tasks=flags.tasks)
    load = partial(plan.kind.make.load_policy, learner.policy_state_dict(), device)
    result = metatest.meta_test(source, plan.config, load, options, metatest.splits_of(source, flags.split), say)
    report = {"steps": learner.env_steps, "seed": options.seed}
    report["splits"] = {split: each.to_json() for split, each in result.items()}
    write_json(folder.evaluation_path, report | {"conditions": conditions(source)})
    print_meta_test(f"{plan.config.algo} on {source.name}, {learner.env_steps:,} steps", result)
    say(f"More: bidex-meta evaluate {folder.path} --shots 3 --tasks 50   See bidex-meta plot --help for curves.")
