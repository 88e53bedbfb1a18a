"""Train a learner: resolve the config, lock the run's folder, build the world and the learner, and train.

If torchrun started several processes, each has its own world and learner. Only process 0 writes, logs and calls
``on_event``.
"""

import contextlib
import math
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from bidex_meta.data.collector import RunCollector
from bidex_meta.data.joined import join
from bidex_meta.errors import BidexError
from bidex_meta.experiments import run_data, run_recording, run_teachers, watching
from bidex_meta.experiments.learners import LearnerKind, learner_kind
from bidex_meta.experiments.policies import fitting, load_checkpoint, say_other_classes, say_other_rules
from bidex_meta.experiments.processes import Checkpoint, agree, report_loss
from bidex_meta.experiments.run_config import check, preset_reason, resolve, resumed
from bidex_meta.runs import Recorder, RunFolder, mend, training_seconds
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.folder import AnyConfig, check_new, new_folder_name
from bidex_meta.training import distributed, runner
from bidex_meta.training.distributed import together
from bidex_meta.training.launch import launch, say
from bidex_meta.training.learner import NO_SOURCES, Learner, Sources
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.waiting import note
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.threads import set_up_torch, torch_settings_kept
from bidex_meta.worlds import Worlds, open_worlds


@dataclass(frozen=True)
class Event:
    """An event during training, passed to the callback of :func:`train` in process 0."""

    kind: Literal["started", "iteration", "ended"]
    folder: RunFolder
    step: int
    """Environment steps so far, over all environments of all processes."""
    metrics: Mapping[str, float]
    """Metrics of an iteration by tag (docs/metrics.md); empty for other events."""


class Stopped(KeyboardInterrupt):
    """A signal ended training early. The run has saved and can be resumed."""

    def __init__(self, folder: RunFolder, step: int, number: int) -> None:
        super().__init__(f"{signal.Signals(number).name} after {step:,} steps")
        self.folder = folder
        self.step = step
        self.number = number


@checked_arguments
@torch_settings_kept()
def train(
    config: AnyConfig | None = None,
    *,
    run_dir: str | Path | None = None,
    resume: RunFolder | str | Path | None = None,
    on_event: Callable[[Event], None] | None = None,
    show_progress: bool = False,
) -> RunFolder:
    """Train a learner, from the last checkpoint of ``resume`` if that is given, and return the run's folder.

    The logger ``bidex_meta`` logs the progress at level INFO. If there are several processes, all must call this
    function with equal arguments.

    Args:
        config: Config of the run; values that are left out are resolved (``bidex_meta.experiments.run_config``). None:
            the config of ``resume``.
        run_dir: A new folder for the run; None: runs/SUITE/ALGO/DATE_seedSEED.
        resume: A run to continue. Only fields of its config that have the metadata ``MAY_CHANGE`` may change.
        on_event: Called when training starts, after each iteration, and when training has ended.
        show_progress: Whether a table, or a line every few seconds, is printed on stderr.

    Raises BidexError for bad input, before anything is written; Stopped if a signal ended training, after the run has
    saved; FloatingPointError if training diverged; LostProcess if another process is gone.
    """
    distributed.init_from_environment()
    folder = None
    try:
        with contextlib.ExitStack() as locks:
            # The caller may have switched gradients off.
            locks.enter_context(torch.inference_mode(False))
            locks.enter_context(torch.enable_grad())
            resumed_run = together(lambda: None if resume is None else _opened(resume, run_dir))
            own_config = together(lambda: _checked(config, resumed_run))
            new_path = None if run_dir is None else Path(run_dir)
            together(lambda: _lock(resumed_run, locks))
            together(lambda: _check_start(own_config, resumed_run, new_path))
            loaded = together(lambda: resumed_run.checkpoints.load() if resumed_run else None)
            agreed = agree(own_config, loaded)
            run = _begin(agreed, resumed_run, new_path, loaded, locks)
            folder = run.folder
            stopped = _train(run, agreed, loaded, on_event, show_progress)
            distributed.shut_down()
            run.world.close()
    except distributed.LostProcess as loss:
        report_loss(loss, folder)
        raise
    if stopped:
        raise Stopped(folder, run.learner.env_steps, stopped)
    return folder


@dataclass(frozen=True)
class _Run:
    """The objects with which one process trains a run: the run's folder, its learner and its worlds."""

    folder: RunFolder
    kind: LearnerKind
    worlds: Worlds
    world: VectorWorld
    collector: RunCollector | None
    """The world again, if the run records its episodes."""
    learner: Learner
    is_resumed: bool


def _opened(resume: RunFolder | str | Path, run_dir: object) -> RunFolder:
    if run_dir is not None:
        raise BidexError("--resume continues in the run's own folder. Leave --run-dir out, or start a new run there.")
    return RunFolder.open(resume.path if isinstance(resume, RunFolder) else resume)


def _checked(config: AnyConfig | None, resumed_run: RunFolder | None) -> AnyConfig:
    if config is None and resumed_run is None:
        raise BidexError('Expected a config or a run to resume, got neither. Pass RunConfig(suite="MT4-v2").')
    if resumed_run is None:
        assert config is not None
        config = resolve(config)
    else:
        config = resolve(resumed_run.config() if config is None else config, str(resumed_run.config_path))
        config = resumed(resumed_run, config)
    check(config)
    return config


def _lock(resumed_run: RunFolder | None, locks: contextlib.ExitStack) -> None:
    """Lock the folder of a resumed run; a new run's folder is locked when it is made."""
    if launch().rank == 0 and resumed_run is not None:
        resumed_run.check_own()
        locks.enter_context(resumed_run.locked())


def _check_start(config: AnyConfig, resumed_run: RunFolder | None, new_path: Path | None) -> None:
    """Raise BidexError at once for what would fail in the middle of training, or only after the world is built."""
    if launch().rank == 0:
        if resumed_run is None:
            # The check uses a name that no other run has, even if another run begins in the same second.
            name = new_folder_name(config)
            check_new(new_path or name.with_name(f"{name.name}_0"))
        watching.check(config, open_worlds(config.to_json()))
    if resumed_run is None and config.start_from is not None:
        start = RunFolder.open(Path(config.start_from))
        if start.checkpoints.newest_step() is None:
            load_checkpoint(start)  # raises BidexError if the run has no checkpoint


def _begin(
    config: AnyConfig,
    resumed_run: RunFolder | None,
    new_path: Path | None,
    loaded: Checkpoint | None,
    locks: contextlib.ExitStack,
) -> _Run:
    """Make the world, the learner and the folder; all processes use the folder of process 0."""
    # Sums depend on how torch splits them over threads: a resumed run must use the number it began with.
    set_up_torch(config.threads, config.deterministic)
    kind = learner_kind(config.algo, config.task)
    worlds = open_worlds({**config.to_json(), "device": launch().own_device(config.device)})
    if launch().count > 1:
        rows = f"{launch().count} x {config.num_envs}"
    else:
        rows = f"{config.num_envs}"
    say(f"{config.algo} on {worlds.name}, {rows} environments on {config.device}, seed {config.seed}")
    say(f"Preset {config.preset}: {preset_reason(config)}.")
    note(f"Building the world of {worlds.name}")
    autoreset = kind.autoreset(config.learner_values)
    plain_world = together(lambda: worlds.world("train", config.num_envs, autoreset))
    collector = None
    if config.record:
        if resumed_run:
            place = resumed_run.path
        else:
            place = new_path or new_folder_name(config)
        collector = together(lambda: run_recording.recorded(config, place, plain_world))
    world: VectorWorld = plain_world if collector is None else collector
    note("Making the learner")
    sources = together(lambda: _sources(config, worlds, world, resumed_run))
    learner = together(lambda: _make_learner(config, kind, worlds, world, sources, fresh=loaded is None))
    identity: Json = dict(worlds.identity())
    if sources.teachers is not None:
        identity["teacher_steps"] = run_teachers.steps_of(sources.teachers)
    if resumed_run is None:
        folder = _new_folder(config, new_path, identity, locks)
    else:
        folder = resumed_run
    say(f"Run folder: {folder.path}")
    if collector is not None:
        together(lambda: run_recording.begin(collector, folder.path, fresh=loaded is None))
    return _Run(folder, kind, worlds, world, collector, learner, is_resumed=resumed_run is not None)


def _make_learner(
    config: AnyConfig, kind: LearnerKind, worlds: Worlds, world: VectorWorld, sources: Sources, fresh: bool
) -> Learner:
    """Return the learner of a config.

    If the run is ``fresh``, that is, not resumed, the learner starts from the policy of ``config.start_from``, if that
    is set.
    """
    # A learner of another package that takes no sources may lack this argument.
    if sources == NO_SOURCES:
        more = {}
    else:
        more = {"sources": sources}
    learner = kind.learner_class(world, config.learner, config.seed, **more)
    if fresh and config.start_from is not None:
        start = RunFolder.open(Path(config.start_from))
        state, step = load_checkpoint(start)
        with fitting(start.path):
            learner.start_from(state["learner"]["policy"])
        say(f"Starting from the policy of {config.start_from} at {step:,} steps.")
        say_other_rules(start, worlds)
        say_other_classes(start, worlds)
    return learner


def _sources(config: AnyConfig, worlds: Worlds, world: VectorWorld, resumed_run: RunFolder | None) -> Sources:
    """Return the data, demonstrations and teachers that a config names.

    Raises BidexError if a teacher has changed since the resumed run ``resumed_run`` began.
    """
    data = None
    demonstrations = None
    teachers = None
    if config.dataset:
        data = join(run_data.announced(config.dataset, "Reading", worlds), world)
    if config.demonstrations:
        found = run_data.announced(config.demonstrations, "Demonstrations:", worlds)
        demonstrations = join(found, world, every=False)
    if config.teacher:
        teachers = run_teachers.teachers_of(config, worlds, world)
        if resumed_run is not None:
            run_teachers.check_same(resumed_run, teachers)
    return Sources(data, demonstrations, teachers)


def _new_folder(config: AnyConfig, path: Path | None, identity: Json, locks: contextlib.ExitStack) -> RunFolder:
    """Return the run's folder, which process 0 makes and locks."""

    def made() -> Path | None:
        if launch().rank > 0:
            return None
        folder = RunFolder.create(config, path, identity=identity)
        locks.enter_context(folder.locked())
        return folder.path

    first = distributed.share(together(made))[0]
    assert first is not None
    return RunFolder(first)


def _train(
    run: _Run, config: AnyConfig, loaded: Checkpoint | None, on_event: Callable[[Event], None] | None, progress: bool
) -> int:
    """Train to the end; return the signal that ended training early, or 0."""
    folder = run.folder
    learner = run.learner
    waits = distributed.LostProcess("this one was asked to stop and waits for it")
    distributed.on_loss(lambda: report_loss(waits, folder))
    resume_step = None
    if loaded is not None:
        state, resume_step = loaded
        with fitting(folder.path):
            together(lambda: runner.resume(learner, run.world, state))
        say(f"Continuing at {resume_step:,} steps.")
    elif run.is_resumed:
        resume_step = 0  # the run was killed before its first checkpoint; the same seed repeats the lost steps
        say("No checkpoint yet: starting from the beginning.")
    if config.minutes is None:
        seconds = math.inf
    else:
        seconds = 60.0 * config.minutes
    iterate = partial(
        runner.train,
        learner,
        run.world,
        total_steps=config.steps,
        total_seconds=seconds,
        should_stop=_early_end(config),
    )
    if launch().rank > 0:
        return iterate(record=None)  # the clock of process 0 decides for all
    folder.finish(resume_step)
    if run.is_resumed:
        # Changes such as more steps are written only when it is certain that the run continues.
        folder.change_config(config)
    rows = mend(folder.metrics_path, resume_step or 0)
    if rows and rows[-1]["step"] == resume_step:
        last = rows[-1]
    else:
        last = None
    with contextlib.ExitStack() as stack:
        size = runner.checkpoint_bytes(learner, run.world, config.learner, config.steps)
        stack.enter_context(folder.checkpoints.room(size))
        recorder = Recorder(folder, config.steps, seconds, resume_step, config.logger, progress)
        record = stack.enter_context(recorder)
        watch = None
        if config.evaluate_every is not None or config.video_every is not None:
            watch = watching.Watch(config, run.kind, run.worlds, folder, learner, record, len(rows))
            stack.callback(watch.close)
        if config.stops_by_training:
            watch = watching.with_episodes(run.world, watch)
        if on_event is not None:
            call = on_event
            record.on_log = lambda metrics, step: call(Event("iteration", folder, step, metrics))
            on_event(Event("started", folder, learner.env_steps, {}))
        stopped = iterate(record=record, watch=watch, last=last, spent_seconds=training_seconds(rows))
    if run.collector is not None:
        run_recording.complete(config, run.worlds, run.collector)
    if on_event is not None:
        on_event(Event("ended", folder, learner.env_steps, {}))
    if not stopped and run.is_resumed and learner.env_steps == resume_step:
        say(_nothing_left(config, learner.env_steps, training_seconds(rows) / 60.0))
    elif not stopped and learner.env_steps < config.steps and config.minutes is not None:
        say(f"The {config.minutes:g} minutes are up after {learner.env_steps:,} steps.")
    return stopped


def _nothing_left(config: AnyConfig, steps: int, minutes: float) -> str:
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


def _early_end(config: AnyConfig) -> Callable[[Mapping[str, float]], bool] | None:
    """Return a function that checks whether the metrics of an iteration reach a limit that ends training early.

    Returns None if the config sets no limit of return, success or score.
    """
    if config.stop_at_return is None and config.stop_at_success is None and config.stop_at_score is None:
        return None

    def reached(metrics: Mapping[str, float]) -> bool:
        tag = config.early_end(metrics)
        if tag is not None:
            say(f"Enough: {tag} is {metrics[tag]:.4g}.")
        return tag is not None

    return reached
