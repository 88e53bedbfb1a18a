"""Checks of all arguments, actions, states and formulas that a world is given; they run before anything changes."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from gymnasium.spaces import Space
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.engine.health import checked_state, dense
from bidex_meta.engine.switches import Switches
from bidex_meta.errors import BidexError, one_line, shortened, unknown_name
from bidex_meta.utils.maths import check_precision
from bidex_meta.utils.validation import whole_number
from bidex_meta.world.contract import State
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.groups import Slot, with_pool
from bidex_meta.world.observations import Rule

_MOST_ENVIRONMENTS = 10_000_000
"""More environments than any memory holds, but few enough for the engines' libraries to count."""
_LARGEST_SEED = 2**128
_LEAST = {"episodes/number": -1}
"""Smallest valid integer of each entry of a state, if it is not 0. Before an environment's first episode, the number of
its episode is -1."""
_AGAIN = "build the world with the same suite, split and num_envs."
MOST_EPISODES = 1000
"""Maximum number of episodes that play one task before another is drawn, and maximum number of episodes in a trial."""
_TOLD, _LONGEST = 5, 100
"""Maximum number of differences that a message names, and maximum number of letters for each."""


def num_envs(given: object, slots: Sequence[str]) -> int:
    """Return the number of environments; raise BidexError unless it is an integer and at least one per slot."""
    number = whole_number("num_envs", given, 1, _MOST_ENVIRONMENTS)
    if number < len(slots):
        raise BidexError(f"num_envs: expected at least {len(slots)}, one each for {', '.join(slots)}; got {number}.")
    return number


def seed(given: object) -> int:
    """Return the seed of a world; raise BidexError unless it is a non-negative integer."""
    return whole_number("seed", given, 0, _LARGEST_SEED)


def switches(given: str, slots: Sequence[Slot]) -> None:
    """Raise BidexError for options of the physics (switches) that are unknown or not allowed.

    Options that change contacts are allowed only if all slots have classes of version 2.
    """
    narrow = [slot.name for slot in slots if not slot.task_class.rules.wide]
    if Switches.of(given).changes_contacts and narrow:
        raise BidexError(
            f"switches: expected classes of version 2 for {shortened(given)}, got {narrow[0]}. Write {narrow[0]}-v2, "
            "or a suite such as MT20-v2."
        )


def choices(task_sampling: object, observation: object, points: object) -> None:
    """Raise BidexError if one of three options of a world has an invalid value.

    ``task_sampling`` and ``observation`` must be known names. ``points`` must be a ``PointsRule`` or None.
    """
    for name, given, known in (
        ("task_sampling", task_sampling, ("uniform", "fixed", "fresh")),
        ("observation", observation, get_args(Rule)),
    ):
        if not isinstance(given, str) or given not in known:
            raise unknown_name(name, str(given), known)
    if points is not None and not isinstance(points, PointsRule):
        raise BidexError(f"points: expected a PointsRule or None, got {shortened(points)}. Write PointsRule(768).")


def episodes_per_task(given: object, task_sampling: str, mode: AutoresetMode) -> None:
    """Raise BidexError unless the number of consecutive episodes that play one task is valid.

    It must be an integer from 1 to ``MOST_EPISODES``. It must be 1 if each environment keeps its task, that is, if
    ``task_sampling`` is ``fixed`` or the autoreset mode is DISABLED.
    """
    number = whole_number("episodes_per_task", given, 1, MOST_EPISODES)
    keeps = task_sampling == "fixed" or mode == AutoresetMode.DISABLED
    if number > 1 and keeps:
        raise BidexError(
            f"episodes_per_task: expected 1, because environments of this world keep their tasks, got {number}. Leave "
            "it out, or make a training world."
        )


def action(given: Tensor | np.ndarray, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Return actions as a float32 tensor on the device, without a gradient; :func:`clean` handles non-finite ones.

    Raises BidexError if they are not real numbers of this shape, or torch's default precision is not single.
    """
    check_precision()
    wanted = f"Expected actions of shape {shape}"
    tensor = dense(given, device, torch.float32)
    if tensor is None:
        raise BidexError(f"{wanted}, got {type(given).__name__} that is no dense array of real numbers.")
    if tensor.shape != shape:
        raise BidexError(f"{wanted}, got {tuple(tensor.shape)}.")
    return tensor


def one_row(given: Tensor | np.ndarray, space: Space) -> Tensor:
    """Return the action (a,) of a single environment as a batch (1, a); raises BidexError as :func:`action` does."""
    assert space.shape is not None
    return action(given, space.shape, torch.device("cpu"))[None]


def clean(action: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions (n, a) clipped to [-1, 1], and which environments had a non-finite number, bool (n,).

    Non-finite numbers become 0.
    """
    # Zero times a number is zero, unless the number is infinite or NaN.
    broken = (0.0 * action).sum(dim=1) != 0.0
    return action.nan_to_num(0.0, 0.0, 0.0).clamp_(-1.0, 1.0), broken


def state(given: State, own: State, slots: Sequence[Slot], task_id: Tensor) -> list[Slot]:
    """Check a saved state, and return the slots with the task pools that the state contains.

    ``own`` and ``slots`` are the present state and the slots of the world that loads the saved state. ``task_id`` (n,)
    is the slot of each environment. Raises BidexError if the saved state belongs to another world or is damaged.
    """
    fits(given, own)
    if given["slots"] != own["slots"]:
        raise BidexError(f"Expected the state of a world of {own['slots']}, got {shortened(given['slots'])}; {_AGAIN}")
    for name in ("tasks", "engines"):
        if len(given[name]) != len(own[name]):
            raise BidexError(f"Expected {len(own[name])} {name} in a world's state, got others; {_AGAIN}")
    for mine, engine in zip(own["engines"], given["engines"], strict=True):
        checked_state(engine, mine)
    filled = [with_pool(slot, tasks) for slot, tasks in zip(slots, given["tasks"], strict=True)]
    sizes = torch.tensor([len(slot.tasks) for slot in filled])[task_id.cpu()]
    index = given["task_index"].cpu()
    if not bool(((index >= 0) & (index < sizes)).all()):
        raise BidexError(f"Expected each task_index within its pool of tasks, got one outside; {_AGAIN}")
    return filled


def fits(given: object, own: Mapping[str, Any], inside: str = "") -> None:
    """Raise BidexError if a saved state does not fit ``own``, the present state of the world that loads it.

    The saved state must contain all entries of ``own``, with equal types and shapes and with finite numbers. The entry
    ``made`` must be equal in both states. If both states are entries of larger states, ``inside`` is their path there;
    messages show it.
    """
    if not isinstance(given, Mapping) or not own.keys() <= given.keys():
        if isinstance(given, Mapping):
            got = sorted(map(str, given))
        else:
            got = type(given).__name__
        where = inside or "it"
        raise BidexError(f"Expected the state of a world with {sorted(own)} in {where}, got {shortened(got)}; {_AGAIN}")
    if "made" in own:
        _check_made(given["made"], own["made"])
    for name, value in own.items():
        if isinstance(value, Mapping):
            fits(given[name], value, f"{inside}{name}/")
        elif isinstance(value, Tensor):
            _check_tensor(f"{inside}{name}", given[name], value)
        elif not isinstance(given[name], type(value)):
            got = f"{type(value).__name__}, got {shortened(given[name])}"
            raise BidexError(f"Expected {inside}{name} of a world's state as {got}; {_AGAIN}")
    if "seed" in own:
        seed(given["seed"])


def _check_made(given: object, own: Mapping[str, str]) -> None:
    """Raise BidexError, naming the differences, if a state comes from a world with other settings."""
    there = given if isinstance(given, Mapping) else {}
    told: dict[str, str] = {}
    count = 0
    for name in dict.fromkeys((*own, *map(str, there))):
        value = there.get(name, "none")
        if isinstance(value, str) and value == own.get(name, "none"):
            continue
        count += 1
        kind = name.partition(" of ")[0]  # one slot stands for all
        told.setdefault(kind, one_line(f"{name} {value}, here {own.get(name, 'none')}")[:_LONGEST])
    if count:
        differences = "; ".join(list(told.values())[:_TOLD])
        raise BidexError(
            f"Expected the state of a world that was made with the same arguments, got {count} differences: "
            f"{differences}; {_AGAIN}"
        )


def _check_tensor(name: str, given: object, own: Tensor) -> None:
    what = f"{name} of a world's state"
    usable = isinstance(given, Tensor) and given.layout == torch.strided and not given.is_meta
    if not isinstance(given, Tensor) or not usable or given.shape != own.shape or given.dtype != own.dtype:
        if isinstance(given, Tensor):
            got = f"{given.dtype} {tuple(given.shape)}"
        else:
            got = type(given).__name__
        raise BidexError(f"Expected {what} as {own.dtype} {tuple(own.shape)}, got {got}; {_AGAIN}")
    if given.requires_grad:
        raise BidexError(f"Expected {what} without gradients; detach it.")
    if not bool(given.isfinite().all()):
        raise BidexError(f"Expected finite numbers in {what}, got others; take an older state.")
    if given.dtype == torch.int64 and bool((given < _LEAST.get(name, 0)).any()):
        raise BidexError(f"Expected counts in {what}, got some below zero; take an older state.")
