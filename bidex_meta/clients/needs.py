"""Checks that adapters share: the adapted package is installed, and the world has the right autoreset mode."""

from collections.abc import Iterator
from contextlib import contextmanager

from gymnasium.vector import AutoresetMode

from bidex_meta.errors import BidexError
from bidex_meta.utils.arguments import check_argument
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.episodes import set_stagger


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Raise BidexError if an import in a ``with`` block fails because the optional extra ``name`` is not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        fault = f"Expected the extra {name!r}, but {error.name} is not installed"
        raise BidexError(f"{fault}. Install it: pip install 'bidex-meta[{name}]'.") from error


def check_training(world: VectorWorld, stagger: bool, mode: AutoresetMode = AutoresetMode.SAME_STEP) -> None:
    """Prepare a world for an adapter: check its autoreset mode, and switch staggered starts on or off.

    With ``stagger`` the first episodes begin at random elapsed steps. Raises BidexError if the mode is not ``mode``.
    """
    check_argument("world", world, VectorWorld)
    given = world.metadata["autoreset_mode"]
    if given != mode:
        if mode == AutoresetMode.SAME_STEP:
            mend = "without autoreset_mode"
        else:
            mend = f"with autoreset_mode={mode.name!r}"
        raise BidexError(f"Expected a world in autoreset mode {mode.name}, got {given.name}; make it {mend}.")
    set_stagger(world, stagger)
