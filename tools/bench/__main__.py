"""``python -m tools.bench KIND [--json]``: measure, and print a table or JSON.

A kind is a function; the function's arguments are the flags.
"""

import json
import sys
from collections.abc import Callable, Sequence

import tyro

from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.config import flat
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json
from tools.bench.against import against
from tools.bench.capacity import capacity
from tools.bench.cones import cones
from tools.bench.field import field
from tools.bench.gpu import gpu
from tools.bench.launches import launches
from tools.bench.pictures import pictures
from tools.bench.quarter import quarter
from tools.bench.scripted import scripted
from tools.bench.stability import stability
from tools.bench.switches import kernels, switches

_MEASURES = (against, field, stability, capacity, cones, launches, scripted, gpu, switches, pictures, kernels, quarter)
KINDS: dict[str, Callable[..., Json]] = {kind.__name__: kind for kind in _MEASURES}


def main(arguments: Sequence[str]) -> None:
    """Run the measurement that the arguments select, and print its result as a table or, with ``--json``, as JSON.

    ``--json`` may appear anywhere among the arguments. An error is printed as one line and ends the process.
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
    print_table(plain_table(["measure", "value"], list(flat(result).items())))
    if table:
        print_table(plain_table(list(table[0]), [list(row.values()) for row in table]))


if __name__ == "__main__":
    main(sys.argv[1:])
