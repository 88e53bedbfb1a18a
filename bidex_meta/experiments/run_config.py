"""Resolves and checks a run's config: complete names, the preset's values, sizes that suit the device."""

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bidex_meta.data import part_files
from bidex_meta.errors import BidexError, one_line, shortened, unknown_name
from bidex_meta.experiments import run_data, run_teachers
from bidex_meta.experiments.conditions import check_worlds_of
from bidex_meta.experiments.learners import choose_preset, learner_kind, resolve_device
from bidex_meta.experiments.metatest import check_worlds
from bidex_meta.runs.folder import AnyConfig, RunFolder
from bidex_meta.training.launch import launch, resume_command
from bidex_meta.training.learner import Capability, LearnerConfig
from bidex_meta.utils.files import absolute
from bidex_meta.utils.memory import POINT_BYTES, ROW_BYTES, check_memory, usable_cores
from bidex_meta.worlds import open_worlds

# Maximum count of numbers that one step of an environment holds: two observations, actions and computed values.
_WIDTH = 1200


def resolve(config: AnyConfig, where: str = "run") -> AnyConfig:
    """Return a run's config in which every value is filled in; ``config.json`` stores this config.

    Values that are None or ``"auto"``, and fields that ``learner`` does not set, get values that suit the suite, the
    learner and the device. Paths become absolute, because a run may be resumed from another folder. Resolving a
    resolved config changes nothing. ``where`` names the config in error messages. Raises BidexError for unknown names,
    devices and settings.
    """
    dataset = run_data.whole_paths(config.dataset)
    datasets = run_data.open_datasets(dataset)
    if config.suite is None and config.task is None:
        config = replace(config, **run_data.implied(datasets))
    _check_names(config)
    named = {name: vars(config)[name] for name in ("suite", "task", "object", "tasks_per_class")}
    source = open_worlds(named)
    kind = learner_kind(config.algo, source.class_name)
    device = resolve_device(config.device, source.on_gpu)
    preset, _ = choose_preset(kind, config.preset, device, source.preset)
    if config.preset == "auto" and isinstance(config.learner, LearnerConfig):
        # If the given values equal a preset, the run has that preset's name.
        preset = next((name for name, values in kind.presets.items() if values == config.learner), preset)
    num_envs, steps = source.rows_and_steps(device, Capability.ADAPTS in kind.capabilities)
    if kind.learner_class.environments_per_class and device == "cpu":
        num_envs = kind.learner_class.environments_per_class * len(source.tasks("train"))
    if Capability.OFFLINE in kind.capabilities:
        num_envs = max(1, len(source.tasks("train")))  # the learner takes sizes and names from its world
        steps = run_data.UPDATES
    given: dict[str, Any] = {}
    if config.suite is not None:
        given["suite"] = _written(source.name)
    if config.task is not None:
        given["task"] = source.class_name or source.name
    if config.start_from is not None:
        given["start_from"] = str(absolute(config.start_from))
    if config.task_seed is None:
        given["task_seed"] = run_data.task_seed(datasets)
    if config.num_envs is None:
        given["num_envs"] = num_envs
    if config.steps is None:
        given["steps"] = steps
    if config.threads is None:
        given["threads"] = max(1, usable_cores() // launch().local_count)
    config = replace(
        config,
        object=_written(config.object),
        dataset=dataset,
        demonstrations=run_data.whole_paths(config.demonstrations),
        teacher=run_teachers.whole_paths(config.teacher),
        algo=kind.name,
        preset=preset,
        learner=_learner_config(kind.presets[preset], config, where),
        processes=launch().count,
        device=device,
        **given,
    )
    share = config.record / max(config.steps, 1)
    return replace(config, record_share=config.record_share or share)


def check(config: AnyConfig, with_memory: bool = True) -> None:
    """Raise BidexError if entries of a resolved config do not go together, or need more memory than there is."""
    kind = learner_kind(config.algo, config.task)
    worlds = open_worlds(config.to_json())
    if config.stop_at_score is not None and config.evaluate_every is None:
        raise BidexError(
            "--stop-at-score is measured in evaluations during training. Add for example --evaluate-every 50."
        )
    if Capability.ADAPTS in kind.capabilities:
        check_worlds(worlds, config.algo)
    if config.record:
        part_files.hdf5()  # raises BidexError if h5py is not installed
    if config.stops_by_training and Capability.OFFLINE in kind.capabilities:
        raise BidexError(
            f"{config.algo} learns from data and plays no episodes: --stop-at-return and --stop-at-success need "
            "evaluations. Add for example --evaluate-every 50."
        )
    run_data.check_offline(kind, config.record, run_data.open_datasets(config.dataset), worlds)
    run_data.check_demonstrations(kind, config.demonstrations, worlds)
    run_teachers.check_teachers(kind, config, worlds)
    if isinstance(config.learner, LearnerConfig):
        config.learner.check_environments(config.num_envs, worlds.train_tasks())
    if with_memory and config.device.startswith("cpu"):
        of_learner = kind.learner_class.bytes_held(config.learner, config.num_envs, _WIDTH + 3 * config.points)
        needed = launch().local_count * (of_learner + config.num_envs * (ROW_BYTES + config.points * POINT_BYTES))
        what = f"--num-envs {config.num_envs} ({of_learner / 1e9:,.1f} GB of it the learner's)"
        check_memory(needed, what, "Lower it, or the learner's layers, steps or replay.")


def resumed(folder: RunFolder, config: AnyConfig) -> AnyConfig:
    """Return the config with which a run continues, given a resolved config; it records the same environments.

    Raises BidexError if the config differs from the run's in other fields than those that may change. The number of
    processes, the physics and the suite must be the same as when the run was made.
    """
    stored = resolve(folder.config(), str(folder.config_path))
    processes = folder.config().processes
    if processes != config.processes:
        raise BidexError(
            f"{folder.path} has worlds of {processes} process(es), not {config.processes}. "
            f"Continue: {resume_command(folder.path, processes)}"
        )
    done = folder.checkpoints.newest_step() or 0
    if config.steps < min(stored.steps, done):
        raise BidexError(
            f"{folder.path} has trained for {done:,} steps, expected --steps of at least that, got {config.steps:,}. "
            "Raise it, or leave it out."
        )
    for name, before, after in stored.differences(config, ignored=("record_share",)):
        flag = "--" + name.replace("_", "-")
        raise BidexError(
            f"{flag} is {before} in {folder.path}, not {after}: a resumed run keeps its config. Leave {flag} out, or "
            "start a new run."
        )
    mend = "Resume with the versions in versions.json, or start a new run from it: --start-from RUN."
    check_worlds_of(folder, open_worlds(config.to_json()), mend)
    return replace(config, record_share=stored.record_share)


def preset_reason(config: AnyConfig) -> str:
    """Return in words why a resolved config has its preset."""
    source = open_worlds({"suite": config.suite, "task": config.task, "object": config.object})
    kind = learner_kind(config.algo, source.class_name)
    name, reason = choose_preset(kind, "auto", config.device, source.preset)
    return reason if name == config.preset else "as asked"


def _check_names(config: AnyConfig) -> None:
    if (config.suite is None) == (config.task is None):
        raise BidexError("Name what to train on: either --suite SUITE or --task TASK, for example --suite MT4.")
    if config.base != "own" and config.task is None:
        raise BidexError(f"--base {config.base} goes with --task; a suite's file says whether bases move.")
    if config.object is not None and config.task is None:
        raise BidexError("--object goes with --task; a suite's file names objects itself (docs/objects.md).")
    if config.tasks_per_class is not None and config.suite is None:
        raise BidexError(
            f"--tasks-per-class {config.tasks_per_class} goes with --suite, got --task {config.task}. Name a suite of "
            "the class, for example --suite MT1-Switch-v2."
        )


def _written(name: str | None) -> str | None:
    """Return a name as a config stores it: the absolute path of a file, any other name unchanged."""
    if name is not None and Path(name).suffix in (".toml", ".xml"):
        return str(absolute(name))
    return name


def _learner_config(preset: Any, config: AnyConfig, where: str) -> Any:
    """Return the learner's settings: unchanged, or a preset in which the given values replace the preset's values."""
    if not isinstance(config.learner, Mapping):
        if type(config.learner) is not type(preset):
            raise BidexError(
                f"{where}: learner: expected a {type(preset).__name__} or a mapping of options, got "
                f"{shortened(config.learner)}. Take one of the presets of {config.algo}."
            )
        return config.learner
    for name in config.learner:
        if not isinstance(name, str):
            raise BidexError(f"{where}: learner: expected names of options, got {shortened(name)}. Correct it.")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in config.learner.items()}
    known = [entry.name for entry in dataclasses.fields(preset)]
    for name in sorted(set(values) - set(known)):
        fault = unknown_name(f"option of {config.algo}", name, known)
        raise BidexError(f"{where}: {fault} A run of another version resumes with the version in its versions.json.")
    try:
        return replace(preset, **values)
    except BidexError as error:
        raise BidexError(f"{where}: {error}") from None
    except (TypeError, ValueError) as error:  # a learner of another package may raise these
        raise BidexError(f"{where}: learner: {one_line(error)}.") from None
