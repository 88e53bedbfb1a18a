"""``bidex-meta record demonstrations``: a class's witness or script played, of which what succeeds is kept."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from bidex_meta.errors import BidexError
from bidex_meta.worlds import Worlds

if TYPE_CHECKING:
    from bidex_meta.witness.open_loop import Played

SIZE, ROWS, ROWS_OF_TASKS = 20_000, 32, 200
"""Transitions, and replays played together from shifted starts or on all tasks, where nobody says otherwise."""
FAILED = "unsuccessful_episodes"
_PATIENCE = 3
"""Rounds in which nothing has to succeed."""
_Player = Callable[[Any, float, int], "Played"]
"""Makes an agent for a world, with so much noise from a seed."""


def record_demonstrations(flags: Any, say: Callable[[str], None], held: ExitStack) -> tuple[Path, str] | None:
    """Records, or goes on with a recording; folder and name of the complete data set, None after an estimate.

    The class is the one with moving bases, as suites have it. A round is a part; all that it draws follows from the
    seed and its number.

    Args:
        flags: ``RecordFlags`` with ``task``; read are also ``size``, ``noise``, ``shift``, ``starts``, ``script``,
            ``num_envs``, ``seed``, ``out``, ``threads``, ``estimate``.
        say: Takes lines of progress.
        held: Keeps the data set's folder from other processes until it is closed.

    Raises:
        BidexError: Flags that do not go together, no witness or script, no room, or nothing that succeeds.
    """
    from bidex_meta.commands.described import described
    from bidex_meta.data import part_files
    from bidex_meta.data.place import check_room, place_of
    from bidex_meta.data.rounds import standing, whole_parts
    from bidex_meta.data.writer import DatasetWriter, begin, claimed, estimated_bytes, finish
    from bidex_meta.witness.shifted import ShiftedStarts

    part_files.hdf5()
    if flags.base == "fixed" or flags.engine == "warp" or flags.device not in ("auto", "cpu"):
        raise BidexError(
            "Witnesses are of moving bases and of C MuJoCo on the CPU. Leave --base, --engine, --device out."
        )
    source = Worlds.open({"task": flags.task, "base": "moving", "seed": 0, "threads": flags.threads})
    if source.name not in source.task_classes() or ":" in source.name:
        raise BidexError(f"{source.name} is none of the classes that have witnesses (bidex-meta witness --all).")
    of_tasks, player = flags.starts == "tasks", _script if flags.script else _witness
    agent_of, size = player(source.name), flags.size or SIZE
    rows = flags.num_envs or (ROWS_OF_TASKS if of_tasks else ROWS)
    folder, name = place_of(flags.out, source.name, "demonstrations-tasks" if of_tasks else "demonstrations")
    plan = {"kind": "demonstrations", "task": source.name, "size": size, "num_envs": rows, "seed": flags.seed}
    plan |= {"noise": flags.noise} | ({"starts": "tasks"} if of_tasks else {"shift": flags.shift})
    plan |= {"script": True} if flags.script else {}
    if not flags.estimate:
        held.enter_context(claimed(folder, plan))
    world: Any
    if of_tasks:
        world = source.world("train", rows)
    else:
        made = source.name, rows, flags.shift, flags.threads
        world = ShiftedStarts(*made)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all
    try:
        sizes = world.single_observation_space.shape[0], world.single_action_space.shape[0]
        needed = estimated_bytes(size, *sizes, float(world.max_episode_steps[0]))
        say(f"{name}: {size:,} transitions, at most about {needed / 1e9:.2f} GB on the disk.")
        if flags.estimate:
            return None
        there = sum(path.stat().st_size for path in part_files.parts_of(folder / "data"))
        check_room(folder, max(0, needed - there), f"{size:,} transitions")
        begin(folder, plan)
        keep = whole_parts([path.name for path in part_files.parts_of(folder / "data", 0)])
        writer = DatasetWriter(folder, keep=keep)
        try:
            while (now := standing(writer, 1)).steps[0] < size:
                if not now.steps[0] and writer.parts >= _PATIENCE:
                    raise _nothing_succeeds(_PATIENCE * rows, source.name, flags)
                _round(world, agent_of, writer, flags)
                after = standing(writer, 1)
                kept = after.episodes[0] - now.episodes[0]
                say(f"{after.steps[0]:,} of {size:,} transitions | {kept} of {rows} replays succeed")
        finally:
            writer.close()
        drawn = {key: plan[key] for key in ("noise", "shift", "starts") if key in plan}
        told = {"algo": None, "actions": "script" if flags.script else "witness", **drawn}
        about = described(source, world, "demonstrations", [told], starts=flags.seed)
        finish(folder, name, world.single_observation_space, world.single_action_space, about)
    finally:
        world.close()
    return folder, name


def _witness(name: str) -> _Player:
    """Plays the class's witness, noise on its actions."""
    from bidex_meta.witness.open_loop import OpenLoop
    from bidex_meta.witness.store import load_witness

    known = {name: load_witness(name)}

    def agent(world: Any, noise: float, seed: int) -> "Played":
        return OpenLoop(known, [name], world.task_id, world.single_action_space.shape[0], noise, seed)

    return agent


def _script(name: str) -> _Player:
    """Plays the class's script, which makes up for the noise on its actions."""
    from bidex_meta.witness.scripted import Scripted
    from bidex_meta.witness.scripts import script_of

    script_of(name)
    return Scripted


def _nothing_succeeds(played: int, name: str, flags: Any) -> BidexError:
    if flags.script:
        return BidexError(f"None of {played} episodes that {name}'s script leads succeeds. Lower --noise.")
    other = "play --starts witness" if flags.starts == "tasks" else "--shift"
    return BidexError(f"None of {played} replays of {name}'s witness succeeds. Lower --noise or {other}.")


def _round(world: Any, player: _Player, writer: Any, flags: Any) -> None:
    """Plays an episode in every row, each with noise of its own."""
    from bidex_meta.data.episode import Episode
    from bidex_meta.data.episode_recorder import EpisodeRecorder

    def sink(episode: Episode) -> None:
        if episode.success and not episode.broken:
            writer.add(episode)
        else:
            writer.left_out[FAILED] += 1

    seeds = np.random.SeedSequence((flags.seed, writer.parts)).generate_state(2, np.uint32).tolist()
    recorder = EpisodeRecorder(world, sink)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all
    obs, _ = recorder.reset(seed=seeds[0])
    agent, over = player(world, flags.noise, seeds[1]), torch.zeros(world.num_envs, dtype=torch.bool)
    agent.reset(~over)
    while not bool(over.all()):
        obs, *_, info = recorder.step(agent.eval_action(obs))
        over |= info["_final_obs"]
    writer.commit()
