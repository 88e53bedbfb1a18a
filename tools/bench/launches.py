"""What a control step on mujoco_warp asks of the device: kernels, fills and copies, allocations; by stage."""

import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from bidex_meta.benchmark import make_task_world

_COLUMNS = ("kernels", "fills_and_copies", "allocations")
# Functions of mujoco_warp that only call others: a stage is what they call.
_AROUND = {
    *("wrapper", "step", "forward", "_forward", "fwd_position", "fwd_kinematics", "fwd_velocity", "implicit"),
    *("solve", "_solve"),
}


def launches(task: str = "BottleCap", num_envs: int = 4) -> dict[str, Any]:
    """Counts what the graph of a class's control step holds, on the Warp CPU device.

    What is launched over nothing is left out, as Warp does. Allocations are in no graph of CUDA, where the engine has
    memory for them. Graphs of CUDA hold the same kernels (of the sparse solver that all classes have), wider or
    narrower.

    Args:
        task: Task class.
        num_envs: Rows.

    Returns:
        ``substeps``; ``table``: by stage, which is a function of mujoco_warp, what all substeps ask for. The row
        ``iteration`` is asked for once an iteration of the contact solver, as often as the slowest row needs.
    """
    made = make_task_world(task, num_envs=num_envs, device="cpu", engine="warp", seed=0)
    made.reset(seed=0)
    found: dict[str, Counter[str]] = {}
    with _counting(found):
        made.step_engines()  # the first records the graph
    substeps = made.parts[0].substeps
    made.close()
    once = found.pop("_solver_iteration")
    assert all(count % substeps == 0 for count in once.values())
    total = sum(found.values(), Counter())
    rows = {**found, "all": total, "iteration": Counter({name: count // substeps for name, count in once.items()})}
    table = [{"stage": stage, **{name: counts[name] for name in _COLUMNS}} for stage, counts in rows.items()]
    return {"task": task, "substeps": substeps, "table": table}


@contextmanager
def _counting(found: dict[str, Counter[str]]) -> Iterator[None]:
    """Adds to ``found``, by stage, what Warp is asked for; loops on the device run once, as a graph holds them."""
    import warp as wp

    def counted(function: Callable[..., Any], column: str, size: Callable[..., int]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            result = function(*args, **kwargs)
            if size(result, *args, **kwargs):
                found.setdefault(_stage(), Counter())[column] += 1
            return result

        return call

    def launched(_result: None, _kernel: object = None, dim: Any = 1, *_args: Any, **_kwargs: Any) -> int:
        return int(np.prod(dim))

    kernels, fills, allocations = _COLUMNS
    asked: list[tuple[Any, str, str, Callable[..., int]]] = [
        *((wp, name, kernels, launched) for name in ("launch", "launch_tiled")),
        *((wp.array, name, fills, lambda _result, array, *_: array.size) for name in ("zero_", "fill_")),
        (wp, "copy", fills, lambda _result, target, *_: target.size),
        *((wp, n, allocations, lambda array, *_, **__: array.size) for n in ("empty", "empty_like", "zeros", "full")),
    ]
    with ExitStack() as stack:
        for owner, name, column, size in asked:
            stack.enter_context(patch.object(owner, name, counted(getattr(owner, name), column, size)))
        stack.enter_context(patch.object(wp, "capture_while", lambda _, while_body, **kwargs: while_body(**kwargs)))
        yield


def _stage() -> str:
    """The outermost function of mujoco_warp at work that does not only call others."""
    frames = (frame.f_code for frame, _ in traceback.walk_stack(None))
    names = [code.co_name for code in frames if "mujoco_warp" in Path(code.co_filename).parts]
    if "_solver_iteration" in names:
        return "_solver_iteration"
    own = [name for name in names if name not in _AROUND]
    return own[-1] if own else names[0] if names else "engine"
