"""What adapters ask for in one line: the package that they adapt to, and a world that trains."""

from collections.abc import Iterator
from contextlib import contextmanager

from gymnasium.vector import AutoresetMode

from bidex_meta.errors import BidexError
from bidex_meta.world.contract import VectorWorld


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Around imports of an optional extra of pyproject's.

    Raises:
        BidexError: One of its packages is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise BidexError(
            f"Expected the extra {name!r}, but {error.name} is not installed. Add it: pip install 'bidex-meta[{name}]'."
        ) from error


def check_training(world: VectorWorld) -> None:
    """Refuses a world whose rows do not start anew by themselves.

    Raises:
        BidexError: Its autoreset mode is not SAME_STEP.
    """
    mode = world.metadata["autoreset_mode"]
    if mode != AutoresetMode.SAME_STEP:
        raise BidexError(
            f"Expected a world in autoreset mode SAME_STEP, got {mode.name}; make it without autoreset_mode."
        )
