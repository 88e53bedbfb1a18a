"""``bidex-meta bench``: flags in, numbers out; what is measured, and how, stands in ``bidex_meta.bench``."""

import inspect
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import tyro

from bidex_meta.commands.parsing import StepCount, Switch, parse
from bidex_meta.errors import BidexError, unknown_name

_KINDS = ("world", "scaling", "mixing", "stability", "capacity")


@dataclass(frozen=True)
class BenchFlags:
    """Measure the world: speed against bare physics, over threads, against its classes alone; stability; contacts.

    Example: bidex-meta bench world --suite MT4 --num-envs 1024 --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="world|scaling|mixing|stability|capacity")]
    """world, scaling, mixing, stability or capacity."""
    suite: str | None = None
    """Suite to measure: by default world and scaling take MT4, mixing MT20, the others every task class there is."""
    task: str | None = None
    """For stability and capacity: this task class alone."""
    num_envs: int | None = None
    """Rows stepped together; for this and the flags below None leaves the measurement its default."""
    steps: StepCount | None = None
    """Environment steps, per class or repeat."""
    threads: int | None = None
    """Threads of the physics."""
    device: str | None = None
    """auto, cpu or cuda:N."""
    seed: int | None = None
    """Seed of the random actions."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Measure and print."""
    flags = parse(BenchFlags, arguments, "bench")
    if flags.what not in _KINDS:
        raise unknown_name("bench", flags.what, _KINDS)
    from bidex_meta import bench

    measure = getattr(bench, flags.what)
    asked = {name: value for name, value in asdict(flags).items() if name not in ("what", "json") and value is not None}
    understood = inspect.signature(measure).parameters
    for name in asked:
        if name not in understood:
            raise BidexError(f"bench {flags.what} takes no --{name.replace('_', '-')}.")
    result = measure(**asked)
    if flags.json:
        print(json.dumps(result, indent=2))
        return
    from bidex_meta.commands.tables import plain_table, print_table

    print_table(plain_table(["measure", "value"], list(_flat(result))))


def _flat(result: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in result.items():
        rows += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, value)]
    return rows
