"""Tools for maintainers, run from a checkout: ``python -m tools.NAME``. The wheel does not contain these tools."""

from collections.abc import Callable

import tyro

from bidex_meta.errors import BidexError


def run(command: Callable[..., object]) -> None:
    """Call a function with the flags of the command line; an error is printed as one line and ends the process."""
    try:
        tyro.cli(command)
    except BidexError as error:
        raise SystemExit(str(error)) from None
