"""What a world is given, checked before anything changes."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.health import checked_state, dense
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.maths import check_precision
from bidex_meta.points.depth_sensor import PointsRule
from bidex_meta.validation import whole_number
from bidex_meta.world.groups import Slot, with_pool
from bidex_meta.world.observations import Rule

_MOST_ROWS = 10_000_000
"""Beyond any memory; less than what an engine's library could not count."""
_LARGEST_SEED = 2**128
_LEAST = {"episodes/number": -1}
"""Of whole numbers in a state; the number of a row's episode before its first is -1."""
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


def choices(task_sampling: object, observation: object, points: object) -> None:
    """Refuses what is none of the names, and points that are no rule of them.

    Raises:
        BidexError: An unknown name, or something else than a ``PointsRule`` or None.
    """
    if not isinstance(task_sampling, str) or task_sampling not in ("uniform", "fixed"):
        raise BidexError(f"Expected task_sampling 'uniform' or 'fixed', got {shortened(task_sampling)}.")
    if not isinstance(observation, str) or observation not in get_args(Rule):
        raise unknown_name("observation", str(observation), get_args(Rule))
    if points is not None and not isinstance(points, PointsRule):
        raise BidexError(f"points: expected a PointsRule or None, got {shortened(points)}. Write PointsRule(768).")


def action(given: Tensor | np.ndarray, shape: tuple[int, int], device: torch.device) -> Tensor:
    """Actions as a tensor on the device, float32, without a gradient; not finite ones are the world's to tell.

    Raises:
        BidexError: No real numbers, or another shape; or torch's default precision is not single.
    """
    check_precision()
    wanted = f"Expected actions of shape {shape}"
    made = dense(given, device, torch.float32)
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
    _names("it", given, own)
    _alike(own, given)
    fits(given, own)
    for name in ("tasks", "engines"):
        if len(given[name]) != len(own[name]):
            raise BidexError(f"Expected {len(own[name])} {name} in a world's state, got others; {_AGAIN}")
    for mine, engine in zip(own["engines"], given["engines"], strict=True):
        checked_state(engine, mine)
    filled = [with_pool(slot, tasks) for slot, tasks in zip(slots, given["tasks"], strict=True)]
    sizes = torch.tensor([len(slot.tasks) for slot in filled])[task_id.cpu()]
    index = given["task_index"].cpu()
    if not bool(((index >= 0) & (index < sizes)).all()):
        raise BidexError(f"Expected each row's task_index within its pool of tasks, got one outside; {_AGAIN}")
    return filled


def fits(given: Any, own: Mapping[str, Any], inside: str = "") -> None:
    """Refuses a saved state with other names, types or shapes than a world's own, or numbers that are not finite.

    Args:
        given: The saved state.
        own: That of the world that takes it: tensors, plain values, and mappings of such.
        inside: Where in a larger state both stand.

    Raises:
        BidexError: The first difference.
    """
    _names(inside or "it", given, own)
    for name, value in own.items():
        if isinstance(value, Mapping):
            fits(given[name], value, f"{inside}{name}/")
        elif isinstance(value, Tensor):
            _tensor(f"{inside}{name}", given[name], value)
        elif not isinstance(given[name], type(value)):
            got = f"{type(value).__name__}, got {shortened(given[name])}"
            raise BidexError(f"Expected {inside}{name} of a world's state as {got}; {_AGAIN}")
    if "seed" in own:
        seed(given["seed"])


def _names(inside: str, given: object, own: Mapping[str, Any]) -> None:
    if not isinstance(given, Mapping) or not own.keys() <= given.keys():
        got = sorted(map(str, given)) if isinstance(given, Mapping) else type(given).__name__
        raise BidexError(
            f"Expected the state of a world with {sorted(own)} in {inside}, got {shortened(got)}; {_AGAIN}"
        )


def _alike(own: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    if not isinstance(given["slots"], list) or not all(isinstance(name, str) for name in given["slots"]):
        raise BidexError(
            f"Expected the names of a world's slots in its state, got {shortened(given['slots'])}; {_AGAIN}"
        )
    there = given["slots"], tuple(getattr(given["observation"], "shape", ()))
    here = own["slots"], tuple(own["observation"].shape)
    if here != there:
        raise BidexError(
            f"Expected the state of a world of {here[0]} with observations {here[1]}, got one of {there[0]} with "
            f"{there[1]}; {_AGAIN}"
        )


def _tensor(name: str, given: object, own: Tensor) -> None:
    usable = isinstance(given, Tensor) and given.layout == torch.strided and not given.is_meta
    if not isinstance(given, Tensor) or not usable or given.shape != own.shape or given.dtype != own.dtype:
        got = f"{given.dtype} {tuple(given.shape)}" if isinstance(given, Tensor) else type(given).__name__
        raise BidexError(f"Expected {name} of a world's state as {own.dtype} {tuple(own.shape)}, got {got}; {_AGAIN}")
    if given.requires_grad:
        raise BidexError(f"Expected {name} of a world's state without gradients; detach it.")
    if not bool(given.isfinite().all()):
        raise BidexError(f"Expected finite numbers in {name} of a world's state, got others; take an older state.")
    if given.dtype == torch.int64 and bool((given < _LEAST.get(name, 0)).any()):
        raise BidexError(f"Expected counts in {name} of a world's state, got some below zero; take an older state.")
