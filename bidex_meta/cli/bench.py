"""``bidex-meta bench world``: measure the speed of a suite's world on this machine."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import Device, JsonSwitch, parse
from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.config import Steps
from bidex_meta.errors import BidexError, known_name
from bidex_meta.experiments.world_speed import world_speed
from bidex_meta.utils.validation import Environments, Few, Seed, Threads


@dataclass(frozen=True)
class BenchFlags:
    """Measure the speed of a suite's world on this machine, and the speed of its bare physics engine.

    Example: bidex-meta bench world --suite MT4 --num-envs 1024 --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="world")]
    """world: measure environment steps per second of the world and of its bare physics engine, and their ratio."""
    suite: str = "MT4"  # Suite to measure.
    num_envs: Environments = 1024  # Environments stepped together.
    steps: Steps = 40  # Environment steps of each repeat.
    repeats: Few = 7  # Number of interleaved repeats; medians are reported.
    threads: Threads | None = None  # CPU threads for the physics; None: all cores.
    device: Device = "cpu"
    engine: str = "auto"  # Physics engine: auto, c or warp.
    deterministic: bool = False  # On a GPU, measure physics that repeats bit for bit.
    switches: str = ""  # Experimental changes of the physics, such as incremental.
    seed: Seed = 0  # Seed of the world and of the actions.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure the speed of the world and print it."""
    flags = parse(BenchFlags, arguments, "bench")
    known_name("bench", flags.what, ["world"])
    if flags.steps == 0:
        raise BidexError("bench world: expected --steps of 1 or more, got 0.")
    result = world_speed(
        flags.suite,
        num_envs=flags.num_envs,
        steps=flags.steps,
        repeats=flags.repeats,
        threads=flags.threads,
        device=flags.device,
        engine=flags.engine,
        deterministic=flags.deterministic,
        switches=flags.switches,
        seed=flags.seed,
    )
    if flags.json:
        print(json.dumps(result, indent=2))
        return
    print_table(plain_table(["measure", "value"], list(result.items())))
