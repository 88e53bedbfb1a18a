"""Record data sets of whole episodes, for learners that train offline."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from bidex_meta.agents import Agent
from bidex_meta.config import Steps, Switch
from bidex_meta.data import Dataset, open_dataset, part_files, writer
from bidex_meta.data.collect import (
    Actor,
    Progress,
    SamplingAgent,
    bytes_held,
    collect,
    collect_successes,
    progress,
    resumed_writer,
)
from bidex_meta.data.writer import DatasetWriter
from bidex_meta.errors import BidexError, known_name
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.policies import load_policy
from bidex_meta.experiments.run_data import dataset_metadata
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import absolute
from bidex_meta.utils.memory import usable_cores
from bidex_meta.utils.validation import Environments, Seed, Threads, check_fields, refuse_unused
from bidex_meta.witness.demonstrators import OpenLoopReplay, Scripted, ShiftedStarts
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.store import load_witness
from bidex_meta.world.contract import PooledWorld
from bidex_meta.world.threads import set_up_torch, torch_settings_kept
from bidex_meta.worlds import Worlds, open_worlds

RUNS = {"random": 0, "medium": 1, "expert": 1, "medium-expert": 2, "replay": 1, "demonstrations": 0}
"""Kinds of data sets, and the number of runs that each kind takes."""
_UNUSED = {
    "random": ("checkpoint", "actions", "noise", "starts", "shift"),
    "replay": (
        "checkpoint", "actions", "noise", "starts", "shift", "size", "seed", "num_envs", "device", "engine", "threads",
    ),
    "demonstrations": ("checkpoint", "actions"),
}  # fmt: skip
"""Settings that have no effect in a kind of data set; in kinds with policies of runs these are those of demonstrations.
"""
SIZE = {"medium-expert": 2_000_000, "demonstrations": 20_000}
_USUAL_SIZE = 1_000_000
_DEMONSTRATORS = {"witness": 32, "tasks": 200}  # default number of environments for demonstrations, by ``starts``
_MOST_HELD = 1_200_000_000  # maximum number of bytes of running episodes, without the world
_PATIENCE = 3  # maximum number of rounds without a successful demonstration
_OF_RUN = dict.fromkeys(("suite", "task", "object", "seed", "tasks_per_class"))
_OF_RUN |= {"base": "own", "points": 0, "touch": False}
"""Entries of a run's config that decide which tasks are played."""


@checked_arguments
@dataclass(frozen=True)
class RecordConfig:
    """A data set to record, for example ``RecordConfig("random", task="CatchUnderarm", size=10_000)``."""

    kind: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join(RUNS))]
    """random: uniform actions; medium, expert: the policy of one run; medium-expert: the policies of two runs, half of
    the data each; replay: the transitions that `bidex-meta run --record N` stored; demonstrations: successful replays
    of the class's witness, a stored reference solution (see --starts)."""
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = ()
    """Run folders. The kind decides how many."""
    suite: str | None = None  # With random: suite to act in, a name or a TOML file. Runs keep their own suite.
    task: str | None = None  # With random: class to act in, not a suite. With demonstrations: class of the witness.
    base: Literal["own", "moving", "fixed"] = "own"  # With --task: whether bases move; own: as the class defines it.
    size: Steps = 0
    """Number of transitions; 0: 1e6 (medium-expert: 2e6, demonstrations: 2e4). A few more are stored, because episodes
    are whole."""
    checkpoint: str = "last"  # Which policy of a run: last, best or a file.
    actions: Literal["sampled", "mean"] = "sampled"
    """sampled: drawn from the policy's distribution, if the policy has one; mean: the policy's mean action."""
    noise: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    """Standard deviation of the Gaussian noise added to the actions of a policy, witness or script. Sampled actions
    already vary and get this noise too."""
    starts: Literal["witness", "tasks"] = "witness"
    """With demonstrations: the starts of the replays. witness: replay the witness in its own task, from its own start
    with shifted objects. tasks: replay it in all tasks of the class, from their starts; it succeeds less often, but the
    data are more varied."""
    script: Switch = False
    """With demonstrations and --starts tasks: use a scripted policy instead of the witness. The script computes actions
    from each start (about a second for 500 steps) and succeeds more often. Eight classes have one, in version 2
    nineteen."""
    shift: Annotated[float, Meta(ge=0.0, le=0.1)] = 1e-4
    """With demonstrations and --starts witness: distance by which the objects' start is shifted, metres."""
    num_envs: Environments | None = None  # Environments stepped together; None: one per task, but at least 200.
    seed: Seed = 0  # Seed of starts and actions; with random also of tasks (a run keeps its own tasks).
    out: Path | None = None  # Folder of the data set; None: NAME/KIND-v0 in the folder of BIDEX_DATA, else in data/.
    device: str = "auto"  # auto, cpu or cuda:N.
    engine: Literal["auto", "c", "warp"] = "auto"  # Physics; auto: the one that is fast on the device.
    threads: Threads | None = None  # Threads of torch and of the physics; None: one per core.

    def __post_init__(self) -> None:
        check_fields(self, "record", as_flags=True)


@dataclass(frozen=True)
class _Collection:
    """Description of a data set to record: its source, its policies, and functions that make the world and act."""

    source: Worlds
    name: str  # kind in the data set's name
    plan: Json  # settings that decide the content, such as ``kind``, ``size`` and ``num_envs``
    policies: list[Json]  # policies that act, for the metadata
    world: Callable[[], PooledWorld]
    episode_share: float  # lower bound of the mean episode length, as a share of the time limit
    collect: Callable[[PooledWorld, DatasetWriter], None]  # acts in the world until the writer has all transitions


@checked_arguments
@torch_settings_kept()
def record(config: RecordConfig) -> Dataset:
    """Record a data set, or resume its recording, and return it.

    An interrupted recording goes on where it stopped, and ends with the same data. Raises BidexError for settings that
    do not go together, and if the disk or the memory is too small.
    """
    kind = _checked(config)
    if kind == "replay":
        folder, name = _publish_replay(config)
    else:
        folder, name = _record(config, _collection(config, kind))
    dataset = open_dataset(folder)
    counts = dataset.metadata["left_out"].items()
    left = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in counts)
    steps = f"{dataset.num_steps:,} transitions in {dataset.num_episodes:,} episodes"
    say(f"{name}: {steps}. Left out: {left or 'nothing'}.")
    say(f"Look: bidex-meta data info {folder}   Check: bidex-meta data check {folder}")
    return dataset


@checked_arguments
def say_estimate(config: RecordConfig) -> None:
    """Log the maximum disk space and memory that a recording takes, without recording anything."""
    kind = _checked(config)
    if kind == "replay":
        raise BidexError(
            "The transitions of a replay are already stored, so there is nothing to estimate. Leave --estimate out."
        )
    collection = _collection(config, kind)
    world = collection.world()
    _announce(collection, world, writer.dataset_path(config.out, collection.source.name, collection.name)[1])
    world.close()


def _checked(config: RecordConfig) -> str:
    kind = known_name("kind of data set", config.kind, RUNS)
    _check(config, kind)
    if kind != "replay":
        part_files.hdf5()  # raises BidexError if h5py is not installed
    return kind


def _collection(config: RecordConfig, kind: str) -> _Collection:
    return _demonstrations(config) if kind == "demonstrations" else _episodes(config, kind)


def _check(settings: RecordConfig, kind: str) -> None:
    if len(settings.runs) != RUNS[kind]:
        takes = f"{RUNS[kind] or 'no'} run folder{'s' * (RUNS[kind] != 1)}"
        raise BidexError(f"record {kind} takes {takes}, got {len(settings.runs)}.")
    if kind == "random" and (settings.suite is None) == (settings.task is None):
        raise BidexError("Name what to play: either --suite SUITE or --task TASK, for example --task CatchUnderarm.")
    if kind == "demonstrations" and (settings.task is None or settings.suite is not None):
        raise BidexError("Name the class whose witness is replayed: --task TASK, for example --task Switch.")
    if settings.script and (kind != "demonstrations" or settings.starts != "tasks"):
        raise BidexError("--script computes actions from each start: it goes with demonstrations and --starts tasks.")
    if RUNS[kind] and (settings.suite is not None or settings.task is not None):
        raise BidexError(f"record {kind} plays what its run was trained on. Leave --suite and --task out.")
    if settings.base != "own" and settings.task is None:
        raise BidexError(f"--base {settings.base} goes with --task; a suite's file says whether bases move.")
    refuse_unused(settings, _UNUSED.get(kind, ("starts", "shift")), f"in record {kind}")
    if settings.starts == "tasks":
        refuse_unused(settings, ("shift",), "with --starts tasks")


def _record(config: RecordConfig, collection: _Collection) -> tuple[Path, str]:
    """Collect a data set, or resume its collection; return its folder and its name."""
    plan = collection.plan
    folder, name = writer.dataset_path(config.out, collection.source.name, collection.name)
    with contextlib.ExitStack() as stack:
        stack.enter_context(writer.claimed(folder, plan))
        world = collection.world()
        stack.callback(world.close)
        needed = _announce(collection, world, name)
        there = sum(path.stat().st_size for path in part_files.parts_of(folder / "data"))
        writer.check_room(folder, max(0, needed - there), f"{plan['size']:,} transitions")
        writer.begin(folder, plan)
        out = resumed_writer(folder)
        stack.callback(out.close)
        collection.collect(world, out)
        about = dataset_metadata(collection.source, world, plan["kind"], collection.policies, starts=config.seed)
        writer.finish(folder, name, world.single_observation_space, world.single_action_space, about)
    return folder, name


def _announce(collection: _Collection, world: PooledWorld, name: str) -> int:
    """Log a recording's size; return its bytes on the disk. Raises BidexError if it needs too much memory."""
    size = collection.plan["size"]
    observations = world.single_observation_space.shape[0]
    actions = world.single_action_space.shape[0]
    length = collection.episode_share * float(world.max_episode_steps.float().mean())
    needed = writer.estimated_bytes(size, observations, actions, length)
    memory = bytes_held(world)
    if memory > _MOST_HELD:
        raise BidexError(
            f"The episodes of {collection.plan['num_envs']:,} rows would take {memory / 1e9:.1f} GB while they run, "
            f"and {_MOST_HELD / 1e9:.1f} are allowed. Lower --num-envs."
        )
    say(
        f"{name}: {size:,} transitions of {len(world.task_names)} task class(es), observations {observations}, actions "
        f"{actions}: at most about {needed / 1e9:.2f} GB on the disk, and up to {memory / 1e9:.2f} GB of memory "
        "beside the world."
    )
    return needed


def _episodes(settings: RecordConfig, kind: str) -> _Collection:
    """Return the description of a data set to record, of episodes with random actions or with policies of runs.

    ``kind`` is ``random`` for uniform actions, and otherwise a kind whose policies are those of ``settings.runs``.
    """
    config = _source_config(settings)
    source = open_worlds(config)
    # Sums depend on how torch splits them over threads, so a resumed collection keeps its number of threads.
    before = writer.stored_plan(writer.dataset_path(settings.out, source.name, kind)[0])
    config["threads"] = settings.threads or before.get("threads") or usable_cores()
    set_up_torch(config["threads"])
    actors = [Actor(None)]
    policies = [{"algo": None, "actions": "uniform"}]
    if kind != "random":
        actors, policies = map(
            list, zip(*(_actor(settings, path, config["device"]) for path in settings.runs), strict=True)
        )
    pools = source.tasks("train")
    tasks = max(map(len, pools.values())) * len(pools)
    # One environment per task, or several if there are few tasks.
    rows = settings.num_envs or tasks * math.ceil(200 / tasks)
    size = settings.size or SIZE.get(kind, _USUAL_SIZE)
    plan = {"kind": kind, "size": size, "num_envs": rows, "noise": settings.noise, "policies": policies}
    plan |= config | {"starts": settings.seed}

    def play(world: PooledWorld, out: DatasetWriter) -> None:
        before = sum(progress(out, len(actors)).steps)
        if out.parts:
            say(f"Going on after {before:,} transitions in {out.parts} parts.")
        collect(world, actors, out, size, settings.seed, partial(_report, size, before))

    # Episodes that may end early are shorter: we measured falls at about one third of the time limit.
    return _Collection(source, kind, plan, policies, lambda: source.world("train", rows), 1.0 / 3.0, play)


def _report(size: int, before: int, now: Progress, seconds: float) -> None:
    """Log the progress of a recording, after each round of episodes.

    ``size`` is the requested number of transitions. ``before`` is the number of transitions when this process began,
    and ``seconds`` is the time since this moment.
    """
    done = sum(now.steps)
    speed = (done - before) / max(seconds, 1e-9)
    left = max(0, size - done) / max(speed, 1e-9)
    say(
        f"{done:,} of {size:,} transitions | {sum(now.episodes):,} episodes | return {now.returns:.3g} | "
        f"success {100 * now.success:.1f} % | {speed:,.0f} steps/s | "
        f"{f'{left / 60:.0f} min' if left >= 90 else f'{left:.0f} s'} left"
    )


def _source_config(settings: RecordConfig) -> Json:
    """Return the config of the suite or class to record in.

    This config is part of the config of the runs whose policies act. Without runs, it is built from ``settings``.
    """
    if settings.runs:
        configs = []
        for run in settings.runs:
            stored = RunFolder.open(run).config()
            configs.append({name: value for name, value in stored.to_json().items() if name in _OF_RUN})
            if stored.task_seed is not None:  # an offline learner plays the tasks of its data set
                configs[-1]["seed"] = stored.task_seed
        config = configs[0]
        last = configs[-1]
        if differ := [name for name in config if config[name] != last[name]]:
            raise BidexError(
                f"The two runs differ in {differ[0]}: {config[differ[0]]} and {last[differ[0]]}. Name runs on the same "
                "tasks."
            )
    else:
        config = _OF_RUN | {
            "suite": settings.suite,
            "task": settings.task,
            "base": settings.base,
            "seed": settings.seed,
        }
        if settings.suite is not None and settings.suite.endswith(".toml"):
            config["suite"] = str(absolute(settings.suite))
    return config | {"device": resolve_device(settings.device, open_worlds(config).on_gpu), "engine": settings.engine}


def _actor(settings: RecordConfig, path: Path, device: str) -> tuple[Actor, Json]:
    """Load a run's policy; return its actor and its metadata."""
    folder = RunFolder.open(path)
    algo = folder.config().algo
    if Capability.ADAPTS in learner_kind(algo).capabilities:
        raise BidexError(f"{algo} adapts to tasks: it has no single policy to record. Name a run of another learner.")
    policy, steps = load_policy(folder, device, settings.checkpoint)
    # DAgger acts with its mean. Its std is only a start for learners that go on from its policy.
    has_own_std = isinstance(policy, SamplingAgent) and Capability.TAUGHT not in learner_kind(algo).capabilities
    sampled = settings.actions == "sampled" and has_own_std
    about = {"algo": algo, "run": folder.path.resolve().name, "steps": steps, "checkpoint": settings.checkpoint}
    about |= {"actions": "sampled" if sampled else "mean", "noise": settings.noise}
    return Actor(policy, sampled, settings.noise), about


def _demonstrations(settings: RecordConfig) -> _Collection:
    """Return the description of a data set to record, of successful demonstrations on one class with moving bases.

    A demonstration replays the class's witness (a stored action sequence that solves a task), or runs its scripted
    policy.
    """
    if settings.base == "fixed" or settings.engine == "warp" or settings.device not in ("auto", "cpu"):
        raise BidexError(
            "Witnesses are for moving bases and C MuJoCo on the CPU. Leave --base, --engine, --device out."
        )
    source = open_worlds({"task": settings.task, "base": "moving", "seed": 0, "threads": settings.threads})
    name = source.name
    size = settings.size or SIZE["demonstrations"]
    rows = settings.num_envs or _DEMONSTRATORS[settings.starts]
    if name not in source.task_classes() or ":" in name:
        raise BidexError(f"{name} is not a class with a witness (bidex-meta witness --all).")
    if settings.script:
        witness = {}
    else:
        witness = {name: load_witness(name)}
    if settings.script:
        script_of(source.task_classes()[name])  # raises BidexError for a class without a script
    on_tasks = settings.starts == "tasks"
    drawn: Json = {"noise": settings.noise, **({"starts": "tasks"} if on_tasks else {"shift": settings.shift})}
    plan = {"kind": "demonstrations", "task": name, "size": size, "num_envs": rows, "seed": settings.seed, **drawn}
    plan |= {"script": True} if settings.script else {}

    def world() -> PooledWorld:
        if on_tasks:
            return source.world("train", rows)
        return ShiftedStarts(name, rows, settings.shift, settings.threads)  # pyright: ignore[reportAbstractUsage]

    def agent(world: Any, seed: int) -> Agent:
        if settings.script:
            return Scripted(world, settings.noise, seed)
        return OpenLoopReplay(witness, [name], world.task_id, world.single_action_space.shape[0], settings.noise, seed)

    if settings.script:
        replays = f"episodes of {name}'s scripted policy"
        mend = ""
    else:
        replays = f"replays of {name}'s witness"
        mend = " or play --starts witness" if on_tasks else " or --shift"

    def play(world: PooledWorld, out: DatasetWriter) -> None:
        while (now := progress(out)).steps[0] < size:
            if not now.steps[0] and out.parts >= _PATIENCE:
                raise BidexError(f"None of {_PATIENCE * rows} {replays} succeeds. Lower --noise{mend}.")
            collect_successes(world, lambda seed: agent(world, seed), out, settings.seed)
            after = progress(out)
            stored = after.episodes[0] - now.episodes[0]
            say(f"{after.steps[0]:,} of {size:,} transitions | {stored} of {rows} replays succeed")

    policy = {"algo": None, "actions": "script" if settings.script else "witness", **drawn}
    if on_tasks:
        kind = "demonstrations-tasks"
    else:
        kind = "demonstrations"
    return _Collection(source, kind, plan, [policy], world, 1.0, play)


def _publish_replay(settings: RecordConfig) -> tuple[Path, str]:
    """Link or copy the recording of a run's training into the data folder; return its folder and its name."""
    (run,) = settings.runs
    folder = RunFolder.open(run)
    config = folder.config()
    if not config.record:
        raise BidexError(
            f"{run} has no recording of its training. Record during training: bidex-meta run --record 1e6 ..."
        )
    dataset = open_dataset(folder.path / "replay")
    out, name = writer.dataset_path(settings.out, open_worlds(config.to_json()).name, "replay")
    writer.adopt(dataset.folder, out, name)
    return out, name
