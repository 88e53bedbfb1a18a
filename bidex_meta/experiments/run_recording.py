"""Recording of a run's transitions (``RunConfig.record``): a collector wraps the run's world and stores them."""

import math
from pathlib import Path

from bidex_meta.data import part_files, writer
from bidex_meta.data.collect import bytes_held
from bidex_meta.data.collector import RunCollector, spread_environments
from bidex_meta.experiments.run_data import dataset_metadata
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.training.launch import launch, say
from bidex_meta.utils.memory import check_memory
from bidex_meta.world.contract import PooledWorld
from bidex_meta.worlds import Worlds


def recorded(config: AnyConfig, folder: Path, world: PooledWorld) -> RunCollector:
    """Wrap the world of a run in a collector, which stores the transitions of some environments.

    The collector stores the share ``config.record_share`` of the environments, at least one of each class, so that it
    collects ``config.record`` transitions or more in the whole run. ``folder`` is the run's folder. Raises BidexError
    if the disk is too small for the transitions, or the memory for the running episodes.
    """
    rows = spread_environments(world, config.record_share)
    size = math.ceil(config.steps * len(rows) / world.num_envs)
    sizes = world.single_observation_space.shape[0], world.single_action_space.shape[0]
    needed = writer.estimated_bytes(size, *sizes, 20.0)
    # Bytes that a resumed run has already stored.
    there = sum(path.stat().st_size for path in part_files.parts_of(folder / "replay" / "data"))
    writer.check_room(folder, max(0, needed - there), f"{size:,} transitions")
    # A checkpoint copies the running episodes, and each process of this machine has its own episodes.
    held = 2 * launch().local_count * bytes_held(world, rows)
    check_memory(held, f"The running episodes of {len(rows):,} recorded rows", "Lower --record or --num-envs.")
    say(
        f"Recording {len(rows)} of {world.num_envs} environments: about {size:,} transitions, at most about "
        f"{needed / 1e9:.2f} GB."
    )
    return RunCollector(world, rows, launch().rank)  # pyright: ignore[reportAbstractUsage]


def begin(collector: RunCollector, folder: Path, fresh: bool) -> None:
    """Tell the collector to write its data set into the folder ``replay`` of the run.

    If the run is ``fresh``, writing begins at once. In a resumed run it begins when the checkpoint is loaded.
    """
    collector.folder = folder / "replay"
    if fresh:
        collector.open(collector.folder)


def complete(config: AnyConfig, worlds: Worlds, collector: RunCollector) -> None:
    """Turn the transitions that all processes have stored into a data set, which can then be opened."""
    policy = {"algo": config.algo, "run": collector.folder.parent.name, "actions": "as in training"}
    about = dataset_metadata(worlds, collector, "replay", [policy])
    name = writer.default_name(worlds.name, "replay")
    writer.finish(collector.folder, name, collector.single_observation_space, collector.single_action_space, about)
    say(f"Recorded: {collector.folder}")
