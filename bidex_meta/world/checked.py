"""What a world is given, checked before anything changes."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.health import checked_state
from bidex_meta.errors import BidexError, shortened, unknown_name, whole_number
from bidex_meta.maths import check_precision
from bidex_meta.world.groups import Slot, with_pool
from bidex_meta.world.observations import Rule

_MOST_ROWS = 10_000_000
"""Beyond any memory; less than what an engine's library could not count."""
_LARGEST_SEED = 2**128
_AGAIN = "build the world with the same suite, split and num_envs."


def num_rows(num_envs: object, slots: Sequence[Slot]) -> int:
    """The number of rows.

    Raises:
        BidexError: No whole number, or fewer rows than slots.
    """
    rows = whole_number("num_envs", num_envs, 1, _MOST_ROWS)
    if rows < len(slots):
        raise BidexError(f"Expected at least {len(slots)} rows, one for each of the suite's classes, got {rows}.")
    return rows


def seed(given: object) -> int:
    """The seed of a world.

    Raises:
        BidexError: No whole number from 0 on.
    """
    return whole_number("seed", given, 0, _LARGEST_SEED)


def choices(task_sampling: object, observation: object) -> None:
    """Refuses what is none of the names.

    Raises:
        BidexError: An unknown name.
    """
    if task_sampling not in ("uniform", "fixed"):
        raise BidexError(f"Expected task_sampling 'uniform' or 'fixed', got {task_sampling!r}.")
    if observation not in get_args(Rule):
        raise unknown_name("observation", str(observation), get_args(Rule))


def action(given: Tensor | np.ndarray, shape: tuple[int, int], device: torch.device) -> Tensor:
    """Actions as a tensor on the device, float32, without a gradient; not finite ones are the world's to tell.

    Raises:
        BidexError: No real numbers, or another shape; or torch's default precision is not single.
    """
    check_precision()
    wanted = f"Expected actions of shape {shape}"
    try:
        made = given.detach() if isinstance(given, Tensor) else torch.as_tensor(given)
        usable = made.layout == torch.strided and not made.is_complex()
        made = made.to(device, torch.float32) if usable else None
    except (TypeError, ValueError, RuntimeError, OverflowError, NotImplementedError):
        made = None
    if made is None:
        raise BidexError(f"{wanted}, got {type(given).__name__} that is no dense array of real numbers.")
    if made.shape != shape:
        raise BidexError(f"{wanted}, got {tuple(made.shape)}.")
    return made


def state(given: Any, own: Mapping[str, Any], slots: Sequence[Slot], task_id: Tensor) -> list[Slot]:
    """The slots with a saved state's pools of tasks.

    Args:
        given: The saved state of a world made alike.
        own: The state of the world that takes it.
        slots: Its slots.
        task_id: Slot of each of its rows, shape (n,).

    Raises:
        BidexError: Another world's state, or a damaged one.
    """
    if not isinstance(given, Mapping) or not own.keys() <= given.keys():
        got = sorted(map(str, given)) if isinstance(given, Mapping) else type(given).__name__
        raise BidexError(f"Expected the state of a world with {sorted(own)}, got {got}.")
    _alike(own, given)
    seed(given["seed"])
    for name in ("task_index", "action", "observation"):
        _tensor(name, given[name], own[name])
    for name, value in own["episodes"].items():
        _tensor(f"episodes/{name}", dict(given["episodes"]).get(name), value)
    for name in ("tasks", "engines"):
        if not isinstance(given[name], Sequence) or len(given[name]) != len(own[name]):
            raise BidexError(f"Expected {len(own[name])} {name} in a world's state, got others; {_AGAIN}")
    for mine, engine in zip(own["engines"], given["engines"], strict=True):
        checked_state(engine, mine)
    filled = [with_pool(slot, tasks) for slot, tasks in zip(slots, given["tasks"], strict=True)]
    sizes = torch.tensor([len(slot.tasks) for slot in filled])[task_id.cpu()]
    index = given["task_index"].cpu()
    if not bool(((index >= 0) & (index < sizes)).all()):
        raise BidexError(f"Expected each row's task_index within its pool of tasks, got one outside; {_AGAIN}")
    return filled


def _alike(own: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    if not isinstance(given["slots"], list) or not all(isinstance(name, str) for name in given["slots"]):
        raise BidexError(
            f"Expected the names of a world's slots in its state, got {shortened(given['slots'])}; {_AGAIN}"
        )
    there = given["slots"], tuple(getattr(given["observation"], "shape", ()))
    here = own["slots"], tuple(own["observation"].shape)
    if here != there or not isinstance(given["episodes"], Mapping):
        raise BidexError(
            f"Expected the state of a world of {here[0]} with observations {here[1]}, got one of {there[0]} with "
            f"{there[1]}; {_AGAIN}"
        )


def _tensor(name: str, given: object, own: Tensor) -> None:
    if not isinstance(given, Tensor) or given.shape != own.shape or given.dtype != own.dtype:
        got = f"{given.dtype} {tuple(given.shape)}" if isinstance(given, Tensor) else type(given).__name__
        raise BidexError(f"Expected {name} of a world's state as {own.dtype} {tuple(own.shape)}, got {got}; {_AGAIN}")
    if given.requires_grad:
        raise BidexError(f"Expected {name} of a world's state without gradients; detach it.")
    if not bool(given.isfinite().all()):
        raise BidexError(f"Expected finite numbers in {name} of a world's state, got others; take an older state.")
