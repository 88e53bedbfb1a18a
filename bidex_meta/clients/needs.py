"""What adapters ask for in one line: the package that they adapt to, a world that trains, whole numbers."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.episodes import set_stagger


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


def check_training(world: VectorWorld, stagger: bool) -> None:
    """Refuses a world whose rows do not start anew by themselves; says whether its first episodes are shortened.

    Raises:
        BidexError: Its autoreset mode is not SAME_STEP.
    """
    mode = world.metadata["autoreset_mode"]
    if mode != AutoresetMode.SAME_STEP:
        raise BidexError(
            f"Expected a world in autoreset mode SAME_STEP, got {mode.name}; make it without autoreset_mode."
        )
    set_stagger(world, stagger)


def whole_steps(name: str, value: Tensor, world: VectorWorld) -> Tensor:
    """Steps of each row of a world, int64 (num_envs,), of any numeric dtype.

    Raises:
        BidexError: Another shape, or what are no whole numbers from 0 on.
    """
    given = torch.as_tensor(value, device=world.device)
    steps = given.to(torch.int64)
    if steps.shape != (world.num_envs,) or not bool(((given >= 0) & (given == steps)).all()):
        raise BidexError(
            f"{name}: expected whole numbers from 0 on, shape ({world.num_envs},), got {shortened(given.tolist())}. "
            "Give steps, one number for each environment."
        )
    return steps
