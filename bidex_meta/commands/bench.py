"""``bidex-meta bench``: flags in, numbers out.

What is measured, and how, stands in ``bidex_meta.bench``, for a learner in ``bidex_algos.bench``.
"""

import inspect
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidex_meta.commands.parsing import StepCount, Switch, parse
from bidex_meta.errors import BidexError, known_name

_KINDS = (
    "world",
    "scaling",
    "mixing",
    "field",
    "stability",
    "soak",
    "capacity",
    "gpu",
    "kernels",
    "learner",
    "libraries",
    "adapt",
    "multiagent",
    "clients",
    "points",
)


@dataclass(frozen=True)
class BenchFlags:
    """Measure speed (against bare physics, another commit, the classes alone, others), stability, or an accelerator.

    Example: bidex-meta bench world --suite MT4 --num-envs 1024 --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join(_KINDS))]
    """world, scaling, mixing, stability, capacity, gpu, kernels; soak: memory, speed and broken rows of a world that
    is stepped for long; field: beside Meta-World and gymnasium-robotics; learner: MT-PPO's update against
    rsl-rl-lib's; libraries: the same with and without oneDNN's products; adapt: all tasks' adaptation at once against
    a loop over them; multiagent: training of learners of several agents beside MT-PPO's, in turns; clients: another
    library's PPO through its adapter against the world's own loop; points: a world that shows point clouds beside the
    same that shows states."""
    suite: str | None = None
    """Suite to measure: by default world and scaling take MT4, mixing, soak, gpu and kernels MT20, the others every
    class."""
    task: str | None = None
    """For stability, capacity, clients, multiagent and points: this task class alone."""
    client: str | None = None
    """For clients: sb3 or rsl-rl."""
    tasks: tuple[str, ...] | None = None
    """For gpu: the classes to step alone, beside the suite."""
    sizes: tuple[int, ...] | None = None
    """For gpu: numbers of rows."""
    learning: Switch = False
    """For gpu: measure training with MT-PPO too."""
    algo: str | None = None
    """For soak: a learner that trains on the world; None: random actions."""
    minutes: float | None = None
    """For soak: ends after so long; None: 60, or where --steps are given, never."""
    preset: str | None = None
    """For learner, libraries and multiagent: the preset, by default laptop."""
    against: str | None = None
    """For world: measure beside other code in turns: a commit, a folder with a checkout, or what --out took of it."""
    classes: Switch = False
    """For world --against: each class of the suite alone too, with a quarter of the rows."""
    out: Path | None = None
    """For gpu, soak and world --against: file that takes each row of the table as it is measured; what is in it
    already, gpu does not measure again."""
    count: int | None = None
    """For points: points of a cloud."""
    num_envs: int | None = None
    """Rows stepped together; for this and the flags below None leaves the measurement its default."""
    steps: StepCount | None = None
    """Environment steps, per class or repeat."""
    repeats: int | None = None
    """Interleaved repeats; medians are reported."""
    threads: int | None = None
    """Threads of the physics, for learner and libraries those of torch, for multiagent of both."""
    device: str | None = None
    """auto, cpu or cuda:N."""
    engine: str | None = None
    """auto, c or warp."""
    seed: int | None = None
    """Seed of the random numbers."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Measure and print."""
    flags = parse(BenchFlags, arguments, "bench")
    flags = replace(flags, what=known_name("bench", flags.what, _KINDS))
    if 0 in (flags.steps, flags.num_envs) or (flags.repeats is not None and flags.repeats < 1):
        raise BidexError(f"bench {flags.what}: expected --steps, --num-envs and --repeats of 1 or more.")
    if flags.out is not None:
        from bidex_meta.record.atomic import check_writable

        check_writable(flags.out)
    measure = _measurement("world_against" if flags.what == "world" and flags.against is not None else flags.what)
    asked = {
        name: value
        for name, value in asdict(flags).items()
        if name not in ("what", "json", "learning", "algo") and value is not None and value is not False
    }
    if flags.algo is not None:
        if flags.what != "soak":
            raise BidexError(f"bench {flags.what} takes no --algo.")
        asked |= _learner(flags.algo, flags.device or "cpu")
    if flags.learning:
        asked |= {"make_learner": _learner("mtppo", flags.device or "cuda:0")["make_learner"]}
    understood = inspect.signature(measure).parameters
    for name in asked:
        if name not in understood:
            flag = "learning" if name == "make_learner" else name.replace("_", "-")
            raise BidexError(f"bench {flags.what} takes no --{flag}.")
    result = measure(**asked)
    if flags.json:
        print(json.dumps(result, indent=2))
        return
    from bidex_meta.commands.tables import plain_table, print_table

    table = result.pop("table", None)
    print_table(plain_table(["measure", "value"], list(_flat(result))))
    if table:
        print_table(plain_table(list(table[0]), [list(row.values()) for row in table]))


def _measurement(what: str) -> Any:
    if what in ("learner", "libraries", "adapt", "multiagent"):
        from bidex_meta.commands.learners import shared

        return getattr(shared(f"bench.{what}"), what)
    from bidex_meta import bench

    return getattr(bench, what)


def _learner(algo: str, device: str) -> dict[str, Any]:
    """What makes a learner on a world, by the preset that ``auto`` takes on the device; and the world's mode."""
    from bidex_meta.commands.learners import choose_preset, learner_kind

    kind = learner_kind(algo)
    config = kind.presets[choose_preset(kind, "auto", device)[0]]
    return {"make_learner": lambda world: kind.make(world, config, 0), "mode": kind.autoreset(asdict(config))}


def _flat(result: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in result.items():
        rows += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, value)]
    return rows
