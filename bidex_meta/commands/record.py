"""``bidex-meta record``: data sets of whole episodes, for learners that train offline."""

import contextlib
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from bidex_meta.commands.parsing import RunPath, Switch, parse
from bidex_meta.config import Steps
from bidex_meta.errors import BidexError, known_name
from bidex_meta.reading import absolute
from bidex_meta.validation import Environments, NonNegative, Seed, Threads
from bidex_meta.worlds import Worlds

RUNS = {"random": 0, "medium": 1, "expert": 1, "medium-expert": 2, "replay": 1, "demonstrations": 0}
"""Kinds of data sets, and how many runs each is made of."""
_SIZE, _SIZE_OF_TWO = 1_000_000, 2_000_000
_MOST_HELD = 1_200_000_000
"""Bytes of running episodes beside the world."""


@dataclass(frozen=True)
class RecordFlags:
    """Record a data set: whole episodes of a policy, as Minari and HDF5.

    Example: bidex-meta record random --task CatchUnderarm

    Killed or interrupted, the same command goes on where it stopped and ends with the same data.
    """

    kind: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join(RUNS))]
    """random: uniform actions; medium, expert: the policy of one run; medium-expert: of two runs, half each; replay:
    what `bidex-meta run --record N` kept of a run's training; demonstrations: replays of the class's witness (see
    --starts), those that succeed."""
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = ()
    """Run folders, as many as the kind takes."""
    suite: str | None = None
    """random: suite to play, a name or the path of a TOML file; otherwise the run's own is played."""
    task: str | None = None
    """random: class to play on its own, in place of a suite; demonstrations: class of the witness."""
    base: Literal["own", "moving", "fixed"] = "own"
    """With --task: whether the hands' bases move; own: as the class has it alone."""
    size: Steps = 0
    """Transitions; 0: 1e6, of medium-expert 2e6, of demonstrations 2e4. The last episodes are whole: there may be a few
    more."""
    checkpoint: str = "last"
    """Which policy of a run: last, best or a file."""
    actions: Literal["sampled", "mean"] = "sampled"
    """sampled: drawn from the policy's distribution, where it has one; mean: its mean action."""
    noise: NonNegative = 0.0
    """Standard deviation of Gaussian noise on a policy's actions, for those that have no distribution, or on a
    witness's."""
    starts: Literal["witness", "tasks"] = "witness"
    """demonstrations: replay the witness from its own start in its own task, objects shifted; or on all tasks of the
    class, from their starts, where it succeeds less often but shows more."""
    script: Switch = False
    """demonstrations, --starts tasks: play in the place of the witness the class's script, led anew from each start
    (about a second for 500 steps): seven classes have one, and it succeeds more often."""
    shift: NonNegative = 1e-4
    """demonstrations, --starts witness: how far the objects' start is shifted, metres."""
    num_envs: Environments | None = None
    """Rows stepped together; None: one per task, 200 at least."""
    seed: Seed = 0
    """Seed of starts and actions, and of random's tasks (a run keeps its own tasks)."""
    out: Path | None = None
    """Folder of the data set; None: NAME/KIND-v0 in the folder that BIDEX_DATA names, else in data/."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics; auto: the one that is fast on the device."""
    threads: Threads | None = None
    """Threads of torch and of the physics; None: one per core."""
    estimate: Switch = False
    """Print what it would take, and stop."""


def main(arguments: Sequence[str]) -> None:
    """Record, or go on with a recording."""
    flags = parse(RecordFlags, arguments, "record")
    kind = known_name("kind of data set", flags.kind, RUNS)
    _check(flags, kind)
    if kind == "replay":
        _replay(flags, flags.runs[0])
        return
    with contextlib.ExitStack() as held:
        if kind == "demonstrations":
            from bidex_meta.commands.record_demonstrations import record_demonstrations

            made = record_demonstrations(flags, _say, held)
        else:
            made = _record(flags, kind, held)
    if made is not None:
        _say_complete(*made)


def _check(flags: RecordFlags, kind: str) -> None:
    if len(flags.runs) != RUNS[kind]:
        made = "run folders" if RUNS[kind] != 1 else "run folder"
        raise BidexError(f"record {kind} takes {RUNS[kind] or 'no'} {made}, got {len(flags.runs)}.")
    if kind == "random" and (flags.suite is None) == (flags.task is None):
        raise BidexError("Name what to play: either --suite SUITE or --task TASK, for example --task CatchUnderarm.")
    if kind == "demonstrations" and (flags.task is None or flags.suite is not None):
        raise BidexError("Name the class whose witness is replayed: --task TASK, for example --task Switch.")
    if flags.script and (kind != "demonstrations" or flags.starts != "tasks"):
        raise BidexError(
            "--script leads the hands anew from each start: give it to record demonstrations, with --starts tasks."
        )
    if kind not in ("random", "demonstrations") and (flags.suite is not None or flags.task is not None):
        raise BidexError(f"record {kind} plays what its run was trained on. Leave --suite and --task out.")
    if flags.base != "own" and flags.task is None:
        raise BidexError(f"--base {flags.base} goes with --task; a suite's file says whether bases move.")
    if not 0.0 <= flags.shift <= 0.1:
        raise BidexError(f"--shift must lie in [0, 0.1] metres, not {flags.shift:g}.")
    if not 0.0 <= flags.noise <= 10.0:
        raise BidexError(f"--noise must lie in [0, 10], not {flags.noise:g}.")


def _record(flags: RecordFlags, kind: str, held: contextlib.ExitStack) -> tuple[Path, str] | None:
    """Records, or goes on with a recording; arguments and result as of ``record_demonstrations``."""
    from bidex_meta.commands.described import described
    from bidex_meta.data import part_files
    from bidex_meta.data.place import check_room, place_of
    from bidex_meta.data.rounds import bytes_held, collect, standing, whole_parts
    from bidex_meta.data.writer import DatasetWriter, begin, begun, claimed, estimated_bytes, finish
    from bidex_meta.world.threads import set_up_torch

    part_files.hdf5()
    config = _config(flags)
    size = flags.size or (_SIZE_OF_TWO if RUNS[kind] == 2 else _SIZE)
    source = Worlds.open(config)
    folder, name = place_of(flags.out, source.name, kind)
    # Sums depend on how torch splits them over threads: a recording keeps those that it began with.
    config["threads"] = flags.threads or begun(folder).get("threads") or _cores()
    set_up_torch(config["threads"])
    actors, policies = _actors(flags, kind, config["device"])
    rows = flags.num_envs or _rows(source)
    plan = {"kind": kind, "size": size, "num_envs": rows, "noise": flags.noise, "policies": policies}
    plan |= {
        key: config[key] for key in ("suite", "task", "base", "object", "points", "seed", "device", "engine", "threads")
    }
    plan |= {"starts": flags.seed}
    if not flags.estimate:
        held.enter_context(claimed(folder, plan))
    world = source.world("train", rows)
    try:
        memory = bytes_held(world)
        if memory > _MOST_HELD:
            raise BidexError(
                f"The episodes of {rows:,} rows would take {memory / 1e9:.1f} GB while they run, and "
                f"{_MOST_HELD / 1e9:.1f} are allowed. Lower --num-envs."
            )
        sizes = world.single_observation_space.shape[0], world.single_action_space.shape[0]
        # Where episodes may end early there are more of them: a third of the time limit is what falls show.
        needed = estimated_bytes(size, *sizes, float(world.max_episode_steps.float().mean()) / 3)
        _say(
            f"{name}: {size:,} transitions of {len(world.task_names)} task class(es), observations {sizes[0]}, actions "
            f"{sizes[1]}: at most about {needed / 1e9:.2f} GB on the disk, and up to {memory / 1e9:.2f} GB of memory "
            "beside the world."
        )
        if flags.estimate:
            return None
        there = sum(path.stat().st_size for path in part_files.parts_of(folder / "data"))
        check_room(folder, max(0, needed - there), f"{size:,} transitions")
        begin(folder, plan)
        keep = whole_parts([path.name for path in part_files.parts_of(folder / "data", 0)])
        writer = DatasetWriter(folder, keep=keep)
        if keep:
            _say(f"Going on after {sum(standing(writer, len(actors)).steps):,} transitions in {keep} parts.")
        try:
            collect(world, actors, writer, size, flags.seed, _Told(size, sum(standing(writer, len(actors)).steps)))
        finally:
            writer.close()
        about = described(source, world, kind, policies, starts=flags.seed)
        finish(folder, name, world.single_observation_space, world.single_action_space, about)
    finally:
        world.close()
    return folder, name


def _config(flags: RecordFlags) -> dict[str, Any]:
    """What a source is opened with: the run's config, or what the flags name."""
    from bidex_meta.commands.learners import resolve_device
    from bidex_meta.record import RunFolder

    if flags.runs:
        stored = [RunFolder.open(run).config() for run in flags.runs]
        names = ("suite", "task", "base", "object", "points", "seed")
        found = [{name: getattr(each, name) for name in names} for each in stored]
        for one, given in zip(found, stored, strict=True):
            if given.task_seed is not None:  # what learned from data plays the tasks of its data
                one["seed"] = given.task_seed
        if differ := [name for name in names if found[0][name] != found[-1][name]]:
            raise BidexError(
                f"The two runs differ in {differ[0]}: {found[0][differ[0]]} and {found[-1][differ[0]]}. Name runs on "
                "the same tasks."
            )
        config: dict[str, Any] = found[0]
    else:
        config = {"suite": flags.suite, "task": flags.task, "base": flags.base, "seed": flags.seed}
        config |= {"object": None, "points": 0}
        if flags.suite is not None and flags.suite.endswith(".toml"):
            config["suite"] = str(absolute(flags.suite))
    on_gpu = Worlds.open(config).on_gpu
    return config | {"device": resolve_device(flags.device, on_gpu), "engine": flags.engine}


def _actors(flags: RecordFlags, kind: str, device: str) -> tuple[list[Any], list[dict[str, Any]]]:
    """Who acts, and what is told of each."""
    from bidex_meta.commands.learners import learner_kind
    from bidex_meta.commands.policies import load_policy
    from bidex_meta.data.rounds import Actor, can_sample
    from bidex_meta.record import RunFolder

    if kind == "random":
        return [Actor(None)], [{"algo": None, "actions": "uniform"}]
    actors, told = [], []
    for path in flags.runs:
        folder = RunFolder.open(path)
        algo = folder.config().algo
        if learner_kind(algo).adapts:
            raise BidexError(f"{algo} adapts to tasks: it has no one policy to record. Name a run of another learner.")
        policy, steps = load_policy(folder, device, flags.checkpoint)
        sampled = flags.actions == "sampled" and can_sample(policy)
        actors.append(Actor(policy, sampled, flags.noise))
        about = {"algo": algo, "run": folder.path.resolve().name, "steps": steps, "checkpoint": flags.checkpoint}
        told.append(about | {"actions": "sampled" if sampled else "mean", "noise": flags.noise})
    return actors, told


def _rows(source: Worlds) -> int:
    """One row per task; where those are few, several."""
    pools = source.tasks("train")
    tasks = max(map(len, pools.values())) * len(pools)
    return tasks * math.ceil(200 / tasks)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


class _Told:
    """A line for each round.

    Args:
        size: Transitions in all.
        before: Those that an earlier command recorded.
    """

    def __init__(self, size: int, before: int) -> None:
        self._size, self._before = size, before

    def __call__(self, now: Any, seconds: float) -> None:
        """Takes how far it is, and since when."""
        done = sum(now.steps)
        speed = (done - self._before) / max(seconds, 1e-9)
        left = max(0, self._size - done) / max(speed, 1e-9)
        _say(
            f"{done:,} of {self._size:,} transitions | {sum(now.episodes):,} episodes | return {now.returns:.3g} | "
            f"success {100 * now.success:.1f} % | {speed:,.0f} steps/s | {_duration(left)} left"
        )


def _duration(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _replay(flags: RecordFlags, run: RunPath) -> None:
    """Puts what a run kept of its training where data sets lie: the same files, linked, or copied to another disk."""
    from bidex_meta.data import open_dataset
    from bidex_meta.data.place import place_of
    from bidex_meta.data.writer import adopt
    from bidex_meta.record import RunFolder

    folder = RunFolder.open(run)
    config = folder.config()
    if not config.record:
        raise BidexError(f"{run} kept nothing of its training. Train one that does: bidex-meta run --record 1e6 ...")
    kept = open_dataset(folder.path / "replay")
    out, name = place_of(flags.out, Worlds.open(config.to_json()).name, "replay")
    adopt(kept.folder, out, name)
    _say_complete(out, name)


def _say_complete(folder: Path, name: str) -> None:
    from bidex_meta.data import open_dataset

    found = open_dataset(folder)
    left = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in found.metadata["left_out"].items())
    _say(f"{name}: {found.num_steps:,} transitions in {found.num_episodes:,} episodes. Left out: {left or 'nothing'}.")
    _say(f"Look: bidex-meta data info {folder}   Check: bidex-meta data check {folder}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
