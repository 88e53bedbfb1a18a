"""What ``bidex-meta run`` was asked for, resolved to values: flags, presets, and the config of a run to be resumed."""

import dataclasses
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from bidex_meta.commands import run_demonstrations, run_offline
from bidex_meta.commands.learners import LearnerKind, choose_preset, learner_kind, resolve_device
from bidex_meta.commands.parsing import StepCount, Switch, parse, peek
from bidex_meta.data import part_files
from bidex_meta.errors import BidexError, one_line
from bidex_meta.memory import POINT_BYTES, ROW_BYTES, check_memory
from bidex_meta.reading import absolute
from bidex_meta.record.folder import RunFolder, flat
from bidex_meta.record.stopping import ENDS
from bidex_meta.suite import MOST_POINTS
from bidex_meta.train.launch import launch, resume_command
from bidex_meta.worlds import Worlds

_MAY_CHANGE = ("steps", "minutes", "evaluate_every", "video_every", "logger", *ENDS)
"""What a resumed run may be given anew: nothing of it changes what is learned."""
_EXAMPLE = "MT4"  # a suite whose defaults `run --help` shows


@dataclass(frozen=True)
class RunFlags:
    """Train a learner on a suite or on a single task, then evaluate it beside a random policy.

    Example: bidex-meta run --suite MT4 --algo mtppo --learner.gamma 0.99
    """

    suite: str | None = None
    """Suite to train on: a name (see `bidex-meta list suites`) or the path of a TOML file."""
    task: str | None = None
    """Train on this task class alone, instead of a suite; or on package.module:Class of your own (docs/own-task.md)."""
    base: Literal["own", "moving", "fixed"] = "own"
    """With --task: whether the hands' bases move; own: as the class has it alone. Suites move them, HandOver alone
    does not."""
    points: int = 0
    """Points of the cloud that observations show in the place of objects' states, as a depth camera would (768 in the
    original; docs/points.md); 0: the states, or what the suite's file says."""
    object: str | None = None
    """With --task: what is thrown in the place of the class's own object: a name of the shelf or the path of an MJCF
    file (docs/objects.md)."""
    algo: str = "mtppo"
    """Learner (see `bidex-meta list algos`), or package.module:Class of your own (docs/own-learner.md)."""
    preset: str = "auto"
    """Values of the learner's config that no flag sets; auto: metaworld for a suite of Meta-World's, else laptop on a
    CPU, on a GPU paper (of maml and promp laptop there too)."""
    num_envs: int = 0
    """Rows stepped together by each process, over all tasks."""
    steps: StepCount = 0
    """Environment steps to train for, over all rows of all processes; 2e7 is understood. Of what learns from --dataset:
    gradient updates."""
    dataset: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Learn from this data set (a name of `bidex-meta data list`, or a folder) instead of playing, with --algo bc, bcq,
    td3bc or iql, for the suite or task that it was recorded of. Given several times: from all of them."""
    demonstrations: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Imitate this data set too (as --dataset; see `bidex-meta record demonstrations`), ever less: with --algo mtppo
    and ppo, see --learner.demonstration-weight. Given several times: all of them."""
    minutes: float | None = None
    """Minutes to train for, counted from the first step of the world and without the evaluation; training ends with
    whichever is up first, these or --steps. None: as long as --steps take."""
    seed: int = 0
    """Seed of tasks, starts and learner."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics: C MuJoCo on the CPU, mujoco_warp on either; auto: the one that is fast on the device."""
    threads: int | None = None
    """Threads of torch and of the physics in each process; None: one per core, shared by the processes of a machine. A
    resumed run keeps its own."""
    start_from: Path | None = None
    """Begin with the policy of this run's last checkpoint, network and observation statistics, instead of a fresh
    one."""
    run_dir: Path | None = None
    """Folder of this run; None: runs/SUITE/ALGO/DATE_seedSEED."""
    resume: Path | None = None
    """Continue this run from its last checkpoint, with its own config; only --steps and --minutes may change, which
    count what it has done already, and --logger, --evaluate-every and --video-every."""
    evaluate_every: int | None = None
    """Evaluate every so many iterations, one episode of ten tasks of each class (ten at least in all; what adapts: one
    shot on train tasks), and keep the policy that did best as checkpoints/best.pt. Changes nothing of the training.
    None: never."""
    video_every: int | None = None
    """Film every so many iterations, a row of each class, into videos/ and the logger. None: never."""
    logger: Literal["tensorboard", "wandb", "none"] = "tensorboard"
    """Where metrics, config and films go beside metrics.jsonl."""
    record: StepCount = 0
    """Keep about so many transitions of the training as the data set replay/ in the run's folder, those of whole
    episodes in some of the rows (docs/data.md). 0: none."""
    stop_at_return: float | None = None
    """End as soon as the mean return reaches this: of the evaluations with --evaluate-every, else of training."""
    stop_at_success: float | None = None
    """End as soon as this share of the episodes succeeds, such as 0.8: of the evaluations with --evaluate-every, else
    of training, whose actions explore."""
    stop_at_score: float | None = None
    """End as soon as the normalised score of the evaluations reaches this; 33 is a third of the expert's. Needs
    --evaluate-every."""
    evaluate: bool = True
    """Evaluate at the end."""
    episodes: int | None = None
    """Episodes of each task in that evaluation; None: 4, or 1 where a task fixes its start (metaworld/...); for what
    adapts, as many as --rollouts."""
    split: Literal["auto", "train", "test", "both"] = "auto"
    """Tasks of that evaluation where the learner adapts (maml, promp, rl2, ...). auto: both, on ML20 fifteen classes
    beside the five unseen ones."""
    shots: int | None = None
    """There: adapt so often, one after the other. None: 1."""
    rollouts: int | None = None
    """There: episodes of each task in a shot. None: as in training, but 40 at most."""
    tasks: int | None = None
    """There: the first so many tasks of each class. None: 5."""
    print_config: Switch = False
    """Print the resolved config as JSON and stop."""


@dataclass(frozen=True)
class RunPlan:
    """Everything decided before anything is made."""

    flags: RunFlags
    """As parsed."""
    kind: LearnerKind
    """The learner."""
    learner_config: Any
    """An instance of the learner's config dataclass."""
    config: dict[str, Any]
    """The resolved config as it is written to ``config.json``."""
    folder: RunFolder | None
    """The run to be resumed, if any."""
    preset_reason: str
    """Why this preset."""

    @cached_property
    def source(self) -> Worlds:
        """Where this process's worlds come from."""
        return Worlds.open({**self.config, "device": launch().own_device(self.config["device"])})


def plan_run(arguments: Sequence[str]) -> RunPlan:
    """Parse in two stages: algo, preset and device first, since they decide what the other flags are and default to.

    Raises:
        BidexError: Bad flags, or flags that contradict the run to be resumed.
    """
    resume = peek(arguments, "--resume")
    if resume and peek(arguments, "--run-dir"):
        raise BidexError("--resume goes on in the run's own folder. Leave --run-dir out, or start a new run there.")
    folder = RunFolder.open(Path(resume)) if resume else None
    # What older runs did not know.
    older = {"engine": "auto", "base": "own", "start_from": None, "minutes": None, "object": None}
    older |= {"points": 0, "evaluate_every": None, "video_every": None, "logger": "tensorboard"}
    older |= {"record": 0, "record_share": 0.0, **dict.fromkeys(ENDS)}
    older |= {"dataset": [], "task_seed": None, "demonstrations": None}
    stored = {**older, **folder.config("learner", "num_envs", "steps")} if folder else {}
    suite, task = (peek(arguments, f"--{name}") or stored.get(name) for name in ("suite", "task"))
    data: dict[str, Any] = {"dataset": run_offline.named(arguments, stored)}
    datasets = run_offline.opened(data["dataset"])
    implied = {} if suite or task else run_offline.implied(datasets)
    suite, task = suite or implied.get("suite"), task or implied.get("task")
    # Where neither is named, `run --help` still has defaults to show; without --help _resolved refuses it.
    thing = peek(arguments, "--object") or stored.get("object") or implied.get("object")
    source = Worlds.open({"suite": suite or (None if task else _EXAMPLE), "task": task, "object": thing})
    alone = source.class_name
    kind = learner_kind(peek(arguments, "--algo") or stored.get("algo", RunFlags.algo), alone)
    device = resolve_device(peek(arguments, "--device") or stored.get("device", RunFlags.device), source.on_gpu)
    asked = peek(arguments, "--preset") or stored.get("preset", RunFlags.preset)
    preset, reason = choose_preset(kind, asked, device, source.preset)
    learner_default = kind.presets[preset]
    if folder:
        learner_default = _stored_learner(type(learner_default), stored, folder)
        stored["learner"] = json.loads(json.dumps(dataclasses.asdict(learner_default)))  # with options it did not know
    sizes = run_offline.rows_and_steps(source) if kind.offline else source.rows_and_steps(device, kind.adapts)
    flags = parse(*_options(arguments, learner_default, {**stored, **implied}, sizes))
    run_offline.check(kind, flags.record, datasets, source)
    data["demonstrations"] = run_demonstrations.named(arguments, stored)
    names = {"source": alone or source.name, "algo": kind.name, "preset": preset}
    data["task_seed"] = stored.get("task_seed", run_offline.task_seed(datasets))
    config = _resolved(flags, names, device, stored, data)
    _check_meta_test(flags, kind)
    run_demonstrations.check(kind, config["demonstrations"], Worlds.open(config))
    if folder:
        _refuse_changes(stored, config, folder)
    return RunPlan(flags, kind, flags.learner, config, folder, reason)


def _options(
    arguments: Sequence[str], learner: Any, stored: dict[str, Any], rows_and_steps: tuple[int, int]
) -> tuple[Any, ...]:
    """The arguments of ``parse``: ``RunFlags`` with a field ``learner``, and the defaults."""
    # The learner's dataclass is known only now, and its fields shall be flags with their help texts.
    options = dataclasses.make_dataclass(
        "RunOptions", [("learner", type(learner), field(default=learner))], bases=(RunFlags,), frozen=True
    )
    options.__doc__ = RunFlags.__doc__
    rows, steps = rows_and_steps
    names = {entry.name for entry in dataclasses.fields(RunFlags)}
    known = {name: value for name, value in stored.items() if name in names}
    if known.get("start_from") is not None:
        known["start_from"] = Path(known["start_from"])
    if "dataset" in known:
        known["dataset"] = tuple(known["dataset"])
        known["demonstrations"] = run_demonstrations.listed(known["demonstrations"])
    default = options(**{"num_envs": rows, "steps": steps, **known, "learner": learner})
    return options, arguments, "run", default


def _resolved(
    flags: Any, names: dict[str, str], device: str, stored: dict[str, Any], data: dict[str, Any]
) -> dict[str, Any]:
    """The config, with names as they are written (``MT4`` where ``--suite mt4`` was given); ``data``: its data sets."""
    if (flags.suite is None) == (flags.task is None):
        raise BidexError("Name what to train on: either --suite SUITE or --task TASK, for example --suite MT4.")
    if flags.base != "own" and flags.task is None:
        raise BidexError(f"--base {flags.base} goes with --task; a suite's file says whether bases move.")
    if flags.object is not None and flags.task is None:
        raise BidexError("--object goes with --task; a suite's file names objects itself (docs/objects.md).")
    for name in ("num_envs", "threads", "episodes", "shots", "rollouts", "tasks", "evaluate_every", "video_every"):
        value = getattr(flags, name)
        if value is not None and value < 1:
            raise BidexError(f"--{name.replace('_', '-')} must be at least 1, not {value}.")
    if not 0 <= flags.points <= MOST_POINTS:
        raise BidexError(f"--points must be a whole number from 0 to {MOST_POINTS:,}, not {flags.points}.")
    if flags.minutes is not None and not 0.0 < flags.minutes < math.inf:
        raise BidexError(f"--minutes must be a number above 0, such as 4 or 0.5, not {flags.minutes:g}.")
    if flags.stop_at_success is not None and not 0.0 < flags.stop_at_success <= 1.0:
        raise BidexError(f"--stop-at-success is a share above 0 up to 1, such as 0.8, not {flags.stop_at_success:g}.")
    if flags.stop_at_score is not None and flags.evaluate_every is None:
        raise BidexError("--stop-at-score is judged by evaluations while training. Add --evaluate-every 50, say.")
    if flags.record:
        part_files.hdf5()  # refuses it where it is not installed
    if device.startswith("cpu") and not flags.print_config:
        _check_memory(flags)
    suite = names["source"] if flags.suite else None
    if suite is not None and suite.endswith(".toml"):
        suite = str(absolute(suite))  # a run may be resumed from another folder
    config = {
        "suite": suite,
        "task": names["source"] if flags.task else None,
        "base": flags.base,
        "points": flags.points,
        "object": _placed(flags.object),
        "start_from": None if flags.start_from is None else str(absolute(flags.start_from)),
        "algo": names["algo"],
        "preset": names["preset"],
        "learner": dataclasses.asdict(flags.learner),
        "num_envs": flags.num_envs,
        "steps": flags.steps,
        "minutes": flags.minutes,
        "evaluate_every": flags.evaluate_every,
        "video_every": flags.video_every,
        "logger": flags.logger,
        **data,
        "record": flags.record,
        # A resumed run that takes more steps goes on with the rows that it began with.
        "record_share": stored.get("record_share", flags.record / max(flags.steps, 1)),
        **{name: getattr(flags, name) for name in ENDS},
        "processes": launch().count,
        "seed": flags.seed,
        "device": device,
        "engine": flags.engine,
        "threads": flags.threads or stored.get("threads") or max(1, _cores() // launch().local_count),
    }
    return json.loads(json.dumps(config))  # tuples to lists, so that it equals what is read back


def _check_meta_test(flags: Any, kind: LearnerKind) -> None:
    asked = [name for name in ("split", "shots", "rollouts", "tasks") if getattr(flags, name) not in (None, "auto")]
    if asked and not kind.adapts:
        raise BidexError(f"--{asked[0]} is of what adapts (maml, promp, rl2, ...), not of {kind.name}. Leave it out.")


def _placed(thing: str | None) -> str | None:
    """An object's name, of a file its whole path: a run may be resumed from another folder."""
    return str(absolute(thing)) if thing is not None and thing.endswith(".xml") else thing


_WIDTH = 1200
"""Numbers that a row's step holds at most: an observation before and after, actions and what was computed of them."""


def _check_memory(flags: Any) -> None:
    """Refuses a world, and what the learner says it holds (``bytes_held``), that this machine has no room for."""
    held = getattr(flags.learner, "bytes_held", None)
    of_learner = 0 if held is None else held(flags.num_envs, _WIDTH + 3 * flags.points)
    needed = launch().local_count * (flags.num_envs * (ROW_BYTES + flags.points * POINT_BYTES) + of_learner)
    told = f"--num-envs {flags.num_envs} ({of_learner / 1e9:,.1f} GB of it the learner's)"
    check_memory(needed, told, "Lower it, or the learner's layers, steps or replay.")


def _cores() -> int:
    # The cores we may use, not those of the machine: containers and batch systems give a share.
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _stored_learner(config_class: Any, stored: dict[str, Any], folder: RunFolder) -> Any:
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in stored.get("learner", {}).items()}
    unknown = set(values) - {entry.name for entry in dataclasses.fields(config_class)}
    if unknown:
        raise BidexError(
            f"{folder.config_path} sets {', '.join(sorted(unknown))}, which this version of {stored['algo']} does not "
            "have. Resume with the version in versions.json."
        )
    try:
        return config_class(**values)
    except BidexError as error:
        raise BidexError(f"{folder.config_path}: {error}") from None
    except (TypeError, ValueError) as error:  # of a learner from elsewhere
        raise BidexError(f"{folder.config_path}: learner: {one_line(error)}.") from None


def _refuse_changes(stored: dict[str, Any], config: dict[str, Any], folder: RunFolder) -> None:
    before, after = flat({"processes": 1, **stored}), flat(config)
    if before["processes"] != after["processes"]:
        raise BidexError(
            f"{folder.path} has worlds of {before['processes']} process(es), not {after['processes']}. "
            f"Continue: {resume_command(folder.path, before['processes'])}"
        )
    for name in sorted(before.keys() | after.keys()):
        if name not in _MAY_CHANGE and before.get(name) != after.get(name):
            flag = "--" + name.replace("_", "-")
            raise BidexError(
                f"{flag} is {before.get(name)} in {folder.path}, not {after.get(name)}: "
                f"a resumed run keeps its config. Leave {flag} out, or start a new run."
            )
