"""What ``bidex-meta run`` was asked for, resolved to values: flags, presets, and the config of a run to be resumed."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Generic, Literal

import tyro

from bidex_meta.cli.parsing import Switch, parse, peek, peek_all
from bidex_meta.cli.tables import Json
from bidex_meta.config import LearnerSettings, RunConfig
from bidex_meta.data import part_files
from bidex_meta.errors import BidexError, one_line
from bidex_meta.experiments import run_data, run_teachers
from bidex_meta.experiments.conditions import check_worlds_of
from bidex_meta.experiments.learners import LearnerKind, choose_preset, learner_kind, resolve_device
from bidex_meta.runs.folder import RunFolder
from bidex_meta.train.launch import launch, resume_command
from bidex_meta.utils.files import absolute
from bidex_meta.utils.memory import POINT_BYTES, ROW_BYTES, check_memory, usable_cores
from bidex_meta.utils.validation import Count, Few, Shots
from bidex_meta.worlds import Worlds

_EXAMPLE = "MT4"  # a suite whose defaults `run --help` shows
_WIDTH = 1200  # numbers that a step of one environment holds at most: two observations, actions, what is computed


@dataclass(frozen=True)
class RunFlags(Generic[LearnerSettings]):
    """Train a learner on a suite or on a single task, then evaluate it beside a random policy.

    Example: bidex-meta run --suite MT4 --algo mtppo --learner.gamma 0.99
    """

    config: Annotated[RunConfig[LearnerSettings], tyro.conf.arg(name="")]
    run_dir: Path | None = None  # Folder of this run; None: runs/SUITE/ALGO/DATE_seedSEED.
    resume: Path | None = None
    """Continue this run from its last checkpoint, with its own config; only --steps and --minutes may change, which
    count what it has done already, and --logger, --evaluate-every, --video-every and --stop-at-...."""
    evaluate: bool = True  # Evaluate at the end.
    episodes: Few | None = None
    """Episodes of each task in that evaluation; None: 4, or 1 where a task fixes its start (metaworld/...); for
    learners that adapt, as many as --rollouts."""
    other_tasks: Switch = False
    """Evaluate on as many tasks that the run was not trained on, too; learners that adapt have --split others."""
    split: Literal["auto", "train", "test", "others", "both"] = "auto"
    """Tasks of that evaluation where the learner adapts (maml, promp, rl2, ...). auto: train and test, on ML20
    fifteen classes beside the five unseen ones; others: tasks of the train classes that the run was not trained on."""
    shots: Shots | None = None  # There: adapt so often, one after the other. None: 1.
    rollouts: Few | None = None  # There: episodes of each task in a shot. None: as in training, but 40 at most.
    tasks: Count | None = None  # There: the first so many tasks of each class. None: 5.
    print_config: Switch = False  # Print the resolved config as JSON and stop.


@dataclass(frozen=True)
class RunPlan:
    """Everything decided before anything is made."""

    flags: RunFlags
    kind: LearnerKind
    config: RunConfig  # resolved, as it is written to config.json
    folder: RunFolder | None  # the run to be resumed, if any
    preset_reason: str  # why this preset

    @cached_property
    def source(self) -> Worlds:
        """Where this process's worlds come from."""
        return Worlds.open({**self.config.to_json(), "device": launch().own_device(self.config.device)})


def plan_run(arguments: Sequence[str]) -> RunPlan:
    """Parse in two stages: algo, preset and device first, since they decide what the other flags are and default to."""
    resume = peek(arguments, "--resume")
    if resume and peek(arguments, "--run-dir"):
        raise BidexError("--resume goes on in the run's own folder. Leave --run-dir out, or start a new run there.")
    folder = RunFolder.open(Path(resume)) if resume else None
    stored = folder.config() if folder else None

    def given(name: str) -> str | None:
        return peek(arguments, f"--{name}") or (stored and vars(stored)[name])

    dataset = run_data.whole_paths(peek_all(arguments, "--dataset")) or (stored.dataset if stored else ())
    datasets = run_data.open_datasets(dataset)
    implied = {} if given("suite") or given("task") else run_data.implied(datasets)
    suite, task = (given(name) or implied.get(name) for name in ("suite", "task"))
    # Where neither is named, `run --help` still has defaults to show; without --help _resolved refuses it.
    named = {"suite": suite or (None if task else _EXAMPLE), "task": task}
    source = Worlds.open({**named, "object": given("object") or implied.get("object")})
    kind = learner_kind(given("algo") or "mtppo", source.class_name)
    make = kind.make
    device = resolve_device(given("device") or "auto", source.on_gpu)
    preset, reason = choose_preset(kind, given("preset") or "auto", device, source.preset)
    if folder and stored:
        default = replace(stored, learner=_stored_learner(type(kind.presets[preset]), stored, folder))
    else:
        # An offline learner takes sizes and names from its world.
        offline = max(1, len(source.tasks("train"))), run_data.UPDATES
        sizes = offline if make.offline else source.rows_and_steps(device, make.adapts)
        default = RunConfig(
            **{"suite": None, "task": None, **implied},
            algo=kind.name, learner=kind.presets[preset], num_envs=sizes[0], steps=sizes[1], seed=0,
            task_seed=run_data.task_seed(datasets), threads=max(1, usable_cores() // launch().local_count),
        )  # fmt: skip
    # The learner's flags are among those of its config; lists begin empty, since flags add to them.
    options: type[RunFlags] = RunFlags[type(default.learner)]  # pyright: ignore
    flags = parse(options, arguments, "run", RunFlags(replace(default, dataset=(), demonstrations=(), teacher=())))
    run_data.check_offline(kind, flags.config.record, datasets, source)
    demonstrations = run_data.whole_paths(flags.config.demonstrations) or default.demonstrations
    teacher = run_teachers.whole_paths(flags.config.teacher) or default.teacher
    config = replace(
        flags.config, dataset=dataset, demonstrations=demonstrations, teacher=teacher, algo=kind.name, preset=preset
    )
    config = _resolved(config, source, device, fresh=folder is None)
    _check(flags, config, kind)
    worlds = Worlds.open(config.to_json())
    run_data.check_demonstrations(kind, config.demonstrations, worlds)
    run_teachers.check_teachers(kind, config, worlds)
    if folder and stored:
        _refuse_changes(default, config, folder)
        mend = "Resume with the versions in versions.json, or start a new run from it: --start-from RUN."
        check_worlds_of(folder, worlds, mend)
    return RunPlan(flags, kind, config, folder, reason)


def _resolved(config: RunConfig, source: Worlds, device: str, fresh: bool) -> RunConfig:
    """The config with names as they are written (``MT4`` of ``mt4``) and whole paths: a resume may be elsewhere."""
    if (config.suite is None) == (config.task is None):
        raise BidexError("Name what to train on: either --suite SUITE or --task TASK, for example --suite MT4.")
    if config.base != "own" and config.task is None:
        raise BidexError(f"--base {config.base} goes with --task; a suite's file says whether bases move.")
    if config.object is not None and config.task is None:
        raise BidexError("--object goes with --task; a suite's file names objects itself (docs/objects.md).")
    name = source.class_name or source.name
    suite = None if config.suite is None else str(absolute(name)) if name.endswith(".toml") else name
    return replace(
        config, suite=suite, task=None if config.task is None else name,
        object=str(absolute(held)) if (held := config.object) and held.endswith(".xml") else held,
        start_from=None if config.start_from is None else str(absolute(config.start_from)),
        record_share=config.record / max(config.steps, 1) if fresh else config.record_share, processes=launch().count,
        device=device,
    )  # fmt: skip


def _check(flags: RunFlags, config: RunConfig, kind: LearnerKind) -> None:
    """Refuses what does not go together, and what this machine has no room for."""
    if config.stop_at_score is not None and config.evaluate_every is None:
        raise BidexError("--stop-at-score is judged by evaluations while training. Add --evaluate-every 50, say.")
    asked = [name for name in ("split", "shots", "rollouts", "tasks") if vars(flags)[name] not in (None, "auto")]
    if asked and not kind.make.adapts:
        raise BidexError(f"--{asked[0]} is for learners that adapt (maml, promp, rl2), not {kind.name}. Leave it out.")
    if flags.other_tasks and kind.make.adapts:
        raise BidexError(f"{kind.name} adapts: --split others plays other tasks of its train classes.")
    if config.record:
        part_files.hdf5()  # refuses it where it is not installed
    if config.device.startswith("cpu") and not flags.print_config:
        of_learner = kind.make.bytes_held(config.learner, config.num_envs, _WIDTH + 3 * config.points)
        needed = launch().local_count * (of_learner + config.num_envs * (ROW_BYTES + config.points * POINT_BYTES))
        what = f"--num-envs {config.num_envs} ({of_learner / 1e9:,.1f} GB of it the learner's)"
        check_memory(needed, what, "Lower it, or the learner's layers, steps or replay.")


def _stored_learner(config_class: type, stored: RunConfig[Json], folder: RunFolder) -> object:
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in stored.learner.items()}
    unknown = set(values) - {entry.name for entry in dataclasses.fields(config_class)}
    if unknown:
        raise BidexError(
            f"{folder.config_path} sets {', '.join(sorted(unknown))}, which this version of {stored.algo} does not "
            "have. Resume with the version in versions.json."
        )
    try:
        return config_class(**values)
    except BidexError as error:
        raise BidexError(f"{folder.config_path}: {error}") from None
    except (TypeError, ValueError) as error:  # of a learner from elsewhere
        raise BidexError(f"{folder.config_path}: learner: {one_line(error)}.") from None


def _refuse_changes(stored: RunConfig, config: RunConfig, folder: RunFolder) -> None:
    if stored.processes != config.processes:
        raise BidexError(
            f"{folder.path} has worlds of {stored.processes} process(es), not {config.processes}. "
            f"Continue: {resume_command(folder.path, stored.processes)}"
        )
    for name, before, after in stored.differences(config, ignored=("record_share",)):
        flag = "--" + name.replace("_", "-")
        raise BidexError(
            f"{flag} is {before} in {folder.path}, not {after}: a resumed run keeps its config. Leave {flag} out, or "
            "start a new run."
        )
