"""Checks of a task class's formulas, for classes that users write."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.rules import HELD_STEPS
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene
from bidex_meta.tasks.state import TaskState

_ROWS = 11
"""Number of rows on which formulas are tried. No sensor and no block has this size, so that a tensor's axis of rows can
be recognised by its size."""


def check_formulas(scene: Scene, tasks: np.ndarray, sensors: Tensor) -> None:
    """Check a class's formulas: call the class's methods, and check the returned values.

    The methods get a few rows that all have the first of ``tasks``, and sensors that all read 0. Precision and device
    are those of ``sensors``. A user's own class is also tried on sensors that differ between rows. Raises BidexError if
    a method returns anything but what is expected; the message names class, method, what was expected and what was
    returned.
    """
    task = scene.task
    name = type(task).__name__
    for block, _ in task.layout:
        size = sum(scene.sensor(sensor).stop - scene.sensor(sensor).start for sensor in block.sensors)
        if block.sensors and size != block.size:
            raise BidexError(f"{name}.layout: block {block.name!r} has size {block.size}, its sensors give {size}.")
    variations = torch.as_tensor(tasks[:1]).to(sensors).repeat(_ROWS, 1)
    frozen = _named(f"{name}.freeze", task.frozen(variations))
    for key, value in frozen.items():
        _check_shape(f"{name}.freeze: {key!r}", value, None)
    state = TaskState(sensors.new_zeros(_ROWS, scene.model.nsensordata), scene.sensors, frozen)
    for key, value in _named(f"{name}.reward_terms", task.rewards(state)).items():
        _check_shape(f"{name}.reward_terms: {key!r}", value)
    _check_shape(f"{name}.success", task.success(state), kind=torch.bool)
    _check_shape(f"{name}.failed", task.failed(state), kind=torch.bool)
    sizes = {block.name: block.size for block, _ in task.layout}
    for key, value in task.observe(state).items():
        if key not in sizes:
            raise BidexError(f"{name}.observe: expected blocks of the layout ({', '.join(sizes)}), got {key!r}.")
        _check_shape(f"{name}.observe: {key!r}", value, sizes[key])
    if task.rules.success == "at-end" and task.episode_steps < HELD_STEPS:
        raise BidexError(
            f"{name}.episode_steps: expected at least {HELD_STEPS}, for which a goal must be held, got "
            f"{task.episode_steps}."
        )
    if not task.is_shipped:
        _check_rows(scene, variations, sensors)


def _check_rows(scene: Scene, variations: Tensor, sensors: Tensor) -> None:
    """Raise BidexError if a class's formulas mix rows, change the state, or return other values when called again."""
    task = scene.task
    noise = np.random.default_rng(0).normal(0.0, 0.1, (_ROWS, scene.model.nsensordata))
    seen = torch.as_tensor(noise).to(sensors)

    def values(rows: slice) -> dict[str, Tensor]:
        frozen = task.frozen(variations[rows])
        given = seen[rows].clone()
        found = {}
        for method in ("reward_terms", "success", "failed", "observe"):
            state = TaskState(given, scene.sensors, frozen)
            called = {
                "reward_terms": task.rewards, "success": task.success, "failed": task.failed, "observe": task.observe
            }[method](state)  # fmt: skip
            if not torch.equal(given, seen[rows]):
                raise BidexError(
                    f"{type(task).__name__}.{method}: expected an unchanged state, got one that the method writes "
                    "into. Write p = p - goal instead of p -= goal."
                )
            named = called if isinstance(called, dict) else {"": called}
            found |= {f"{method} {key}".strip(): value for key, value in named.items()}
        return found

    everything = values(slice(None))
    again = values(slice(None))
    alone = [values(slice(row, row + 1)) for row in range(_ROWS)]
    for key, value in everything.items():
        where = f"{type(task).__name__}.{key}"
        if not _alike(value, again[key]):
            raise BidexError(
                f"{where}: expected the same values for the same state, got others in a second call. Keep no counters "
                "and draw no random numbers in a class; start() gets draws."
            )
        if not _alike(value, torch.cat([each[key] for each in alone])):
            raise BidexError(
                f"{where}: expected each row's value from this row alone, got values that depend on other rows. Name "
                "the axis, as in x.norm(dim=1) or x.sum(dim=1)."
            )


def _alike(one: Tensor, other: Tensor) -> bool:
    return torch.allclose(one.double(), other.double(), rtol=1e-4, atol=1e-6, equal_nan=True)


def check_numbers(
    task: TaskClass,
    method: str,
    values: Mapping[str, Tensor],
    unstable: Callable[[], Tensor] | None = None,
    rows: Tensor | slice = slice(None),
) -> None:
    """Raise BidexError if a user's own class returned numbers that are not finite in environments with sound physics.

    ``values`` maps names to tensors (n, ...) with one row per environment in ``rows``. ``unstable()`` returns a mask,
    bool (num,), of all environments with broken physics. Shipped classes are not checked, because their formulas are
    tested.
    """
    if task.is_shipped:
        return
    for name, value in values.items():
        bad = ~value.isfinite().reshape(len(value), -1).all(dim=1)
        if bool(bad.any()) and unstable is not None:
            bad = bad & ~unstable()[rows]
        if bool(bad.any()):
            row = int(bad.nonzero()[0])
            where = f"{type(task).__name__}.{method}: {name!r}"
            raise BidexError(
                f"{where}: expected finite numbers, got {shortened(value[row].tolist())} in a state whose physics is "
                f"sound ({int(bad.sum())} of {len(bad)} environments). Look for a division by 0, a root or logarithm "
                "of a negative number, or exp of a large one."
            )


def _named(where: str, given: object) -> dict[str, Tensor]:
    if not isinstance(given, dict) or not given:
        raise BidexError(f"{where}: expected a dict from names to tensors, got {shortened(given)}.")
    return given


def _check_shape(where: str, value: object, *sizes: int | None, kind: torch.dtype | None = None) -> None:
    expected = (_ROWS, *sizes)
    if isinstance(value, Tensor):
        pairs = zip(expected, value.shape, strict=False)
        fitting = value.dim() == len(expected) and all(size in (None, own) for size, own in pairs)
        if fitting and kind in (None, value.dtype):
            return
        got = f"{_shown(tuple(value.shape))} of {str(value.dtype).removeprefix('torch.')}"
    else:
        got = shortened(value)
    if kind is None:
        kinds = ""
    else:
        kinds = f" of {str(kind).removeprefix('torch.')}"
    raise BidexError(f"{where}: expected a tensor of shape {_shown(expected)}{kinds}, where n counts rows, got {got}.")


def _shown(shape: tuple[int | None, ...]) -> str:
    letters = {_ROWS: "n", None: "k"}
    words = [letters.get(size, str(size)) for size in shape]
    return f"({', '.join(words)}{',' * (len(words) == 1)})"
