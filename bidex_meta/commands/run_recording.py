"""What ``bidex-meta run`` adds for data sets: a recorder around its world, and an early end at a named goal."""

import sys
from pathlib import Path
from typing import Any

from bidex_meta.commands.run_config import RunPlan
from bidex_meta.memory import check_memory
from bidex_meta.record.folder import new_folder_name
from bidex_meta.train.launch import launch


def recorded(plan: RunPlan, world: Any) -> Any:
    """The world with a recorder around it, of as many rows as make the transitions that were asked for.

    Raises:
        BidexError: There is no room for them on the disk, or in memory for the episodes that run.
    """
    from bidex_meta.data import part_files
    from bidex_meta.data.place import check_room
    from bidex_meta.data.rounds import bytes_held
    from bidex_meta.data.run_recorder import RunRecorder, spread_rows
    from bidex_meta.data.writer import estimated_bytes

    rows = spread_rows(world, plan.config.record_share)
    sizes = world.single_observation_space.shape[0], world.single_action_space.shape[0]
    needed = estimated_bytes(plan.config.record, *sizes, 20.0)
    place = plan.folder.path if plan.folder else plan.flags.run_dir or new_folder_name(plan.config)
    there = sum(path.stat().st_size for path in part_files.parts_of(place / "replay" / "data"))  # of a resumed run
    check_room(place, max(0, needed - there), f"{plan.config.record:,} transitions")
    # A checkpoint copies the episodes that run; each process of this machine has its own.
    held = 2 * launch().local_count * bytes_held(world, rows)
    check_memory(held, f"The running episodes of {len(rows):,} recorded rows", "Lower --record or --num-envs.")
    _say(f"Recording {len(rows)} of {world.num_envs} rows, at most about {needed / 1e9:.2f} GB.")
    return RunRecorder(world, rows, launch().rank)  # pyright: ignore[reportAbstractUsage]


def begin(recorder: Any, folder: Path, fresh: bool) -> None:
    """Recording begins in the run's folder; of a resumed run the checkpoint knows which parts stay."""
    recorder.folder = folder / "replay"
    if fresh:
        recorder.open(recorder.folder)


def complete(plan: RunPlan, recorder: Any) -> None:
    """Makes what all processes recorded a data set."""
    from bidex_meta.commands.described import described
    from bidex_meta.data.place import default_name
    from bidex_meta.data.writer import finish

    told = {"algo": plan.config.algo, "run": recorder.folder.parent.name, "actions": "as in training"}
    about = described(plan.source, recorder, "replay", [told])
    name = default_name(plan.source.name, "replay")
    finish(recorder.folder, name, recorder.single_observation_space, recorder.single_action_space, about)
    _say(f"Recorded: {recorder.folder}")


def _say(text: str) -> None:
    if launch().rank == 0:
        print(text, file=sys.stderr, flush=True)
