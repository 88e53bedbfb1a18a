"""Whether what a task class computes has the shapes that a world takes: asked once, before its first step."""

import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.tasks.scene import Scene
from bidex_meta.tasks.state import TaskState

_ROWS = 11
"""As many as no sensor and no block has numbers, so that a shape shows which axis counts rows."""


def check_formulas(scene: Scene, tasks: np.ndarray, sensors: Tensor, observed: bool) -> None:
    """Asks a class's methods once, for a few rows of its first task and sensors that all read 0.

    Args:
        scene: Its scene.
        tasks: Its pool of variations, shape (n, variation_space.size).
        sensors: Any tensor of the engine's precision and device.
        observed: Whether ``observe`` is asked too.

    Raises:
        BidexError: A method gives something else than it shall; it names class, method, the expected and the received.
    """
    task = scene.task
    name = type(task).__name__
    for block, _ in task.layout:
        found = sum(scene.sensor(sensor).stop - scene.sensor(sensor).start for sensor in block.sensors)
        if block.sensors and found != block.size:
            raise BidexError(f"{name}.layout: block {block.name!r} has size {block.size}, its sensors give {found}.")
    variations = torch.as_tensor(tasks[:1]).to(sensors).repeat(_ROWS, 1)
    frozen = _named(f"{name}.freeze", task.freeze(variations))
    for key, value in frozen.items():
        _check(f"{name}.freeze: {key!r}", value, None)
    state = TaskState(sensors.new_zeros(_ROWS, scene.model.nsensordata), scene.sensors, frozen)
    for key, value in _named(f"{name}.reward_terms", task.reward_terms(state)).items():
        _check(f"{name}.reward_terms: {key!r}", value)
    _check(f"{name}.success", task.success(state), kind=torch.bool)
    _check(f"{name}.failed", task.failed(state), kind=torch.bool)
    sizes = {block.name: block.size for block, _ in task.layout}
    for key, value in task.observe(state).items() if observed else ():
        if key not in sizes:
            raise BidexError(f"{name}.observe: expected blocks of the layout ({', '.join(sizes)}), got {key!r}.")
        _check(f"{name}.observe: {key!r}", value, sizes[key])


def _named(where: str, found: object) -> dict[str, Tensor]:
    if not isinstance(found, dict) or not found:
        raise BidexError(f"{where}: expected a dict from names to tensors, got {shortened(found)}.")
    return found


def _check(where: str, value: object, *sizes: int | None, kind: torch.dtype | None = None) -> None:
    """Refuses what is no tensor of rows and ``sizes`` (None: any); ``kind`` None: of any numbers."""
    shape = tuple(value.shape) if isinstance(value, Tensor) else None
    fits = shape is not None and len(shape) == 1 + len(sizes) and shape[0] == _ROWS
    fits = fits and all(size is None or size == found for size, found in zip(sizes, shape[1:], strict=True))  # type: ignore[index]
    if fits and kind in (None, value.dtype):  # type: ignore[union-attr]
        return
    got = shortened(value) if shape is None else f"{_told(shape)} of {str(value.dtype).removeprefix('torch.')}"  # type: ignore[union-attr]
    wanted = _told((_ROWS, *("k" if size is None else size for size in sizes)))
    kinds = "" if kind is None else f" of {str(kind).removeprefix('torch.')}"
    raise BidexError(f"{where}: expected a tensor of shape {wanted}{kinds}, where n counts rows, got {got}.")


def _told(shape: tuple[object, ...]) -> str:
    words = ["n" if size == _ROWS else str(size) for size in shape]
    return f"({', '.join(words)}{',' * (len(words) == 1)})"
