"""``python -m tools.bench KIND [--json]``: measures, and prints a table or JSON.

A kind is a function, its arguments are the flags.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import tyro

from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.errors import BidexError
from tools.bench.adapt import adapt
from tools.bench.against import against
from tools.bench.capacity import capacity
from tools.bench.clients import clients
from tools.bench.field import field
from tools.bench.gpu import gpu, kernels
from tools.bench.launches import launches
from tools.bench.learner import learner
from tools.bench.libraries import libraries
from tools.bench.multiagent import multiagent
from tools.bench.points import points
from tools.bench.soak import soak
from tools.bench.speed import mixing, scaling
from tools.bench.stability import stability

KINDS: dict[str, Callable[..., dict[str, Any]]] = {
    kind.__name__: kind
    for kind in (
        scaling, mixing, against, field, stability, soak, capacity,
        gpu, kernels, launches, learner, libraries, adapt, multiagent, clients, points,
    )
}  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    """Measure and print; ``--json`` may stand anywhere.

    Raises:
        SystemExit: With one line that says what is wrong, or after tyro's help text.
    """
    flags = [word for word in arguments if word != "--json"]
    try:
        result = tyro.extras.subcommand_cli_from_dict(KINDS, args=flags, prog="python -m tools.bench")
    except BidexError as error:
        raise SystemExit(f"tools.bench: {error}") from None
    if "--json" in arguments:
        print(json.dumps(result, indent=2))
        return
    table = result.pop("table", None)
    print_table(plain_table(["measure", "value"], list(_flat(result))))
    if table:
        print_table(plain_table(list(table[0]), [list(row.values()) for row in table]))


def _flat(result: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in result.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


if __name__ == "__main__":
    main(sys.argv[1:])
