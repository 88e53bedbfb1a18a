"""How a step keeps an accelerator busy: engines side by side on streams, torch's work as CUDA graphs.

Launched one by one, torch's kernels would take longer than the physics. The state that a stretch of work reads and
leaves behind lives in tensors at fixed addresses; so does what it returns, which its next replay overwrites.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

Work = Callable[..., Any]
"""Tensors in, any nest of tensors out; on the way it may read and rebind the state."""

Record = Callable[[Callable[[], Any]], tuple[Callable[[], None], Any]]
"""Takes work without inputs; gives how to do it again in the same memory, and the tensors that it then leaves there."""

Together = Callable[[Sequence[Callable[[], None]]], None]
"""Does jobs that need nothing of each other, as ``SideBySide.run``."""

_BEFORE = 3
"""Plain runs of a stretch before it is recorded: libraries allocate and compile in the first ones, and a world that is
stepped a few times only, or whose tasks change as often, never pays for a recording."""


def cuda_graph(work: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """Records work as one CUDA graph."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        result = work()
    return graph.replay, result


class GraphCache:
    """Stretches of a step by name, over one state.

    A stretch is recorded with the tensors that its closures hold at that time: ``forget`` after changing any but the
    state and the inputs.
    """

    def __init__(
        self, get: Callable[[], dict[str, Tensor]], put: Callable[[dict[str, Tensor]], None], record: Record
    ) -> None:
        """``get`` and ``put`` read and bind the state's tensors by name; ``record`` is e.g. ``cuda_graph``."""
        self._get, self._put, self._record = get, put, record
        self._state: dict[str, Tensor] = {}
        self._runs: dict[str, int] = {}
        self._recorded: dict[str, tuple[list[Tensor], Callable[[], None], Any]] = {}

    def forget(self) -> None:
        """Drops all recordings; stretches run plainly again for a while."""
        self._state, self._runs, self._recorded = {}, {}, {}

    def run(self, name: str, work: Work, *inputs: Tensor) -> Any:
        """What the work returns for the inputs, run or replayed; the next replay of this stretch overwrites it.

        A name must always come with the same work and inputs of the same shapes.
        """
        self._runs[name] = self._runs.get(name, 0) + 1
        if self._runs[name] <= _BEFORE:
            return work(*inputs)
        self._settle()
        if name not in self._recorded:
            own = [value.clone() for value in inputs]

            def settled() -> Any:
                result = work(*own)
                self._settle()
                return result

            self._recorded[name] = (own, *self._record(settled))
        own, replay, result = self._recorded[name]
        for place, value in zip(own, inputs, strict=True):
            place.copy_(value)
        replay()
        return result

    def _settle(self) -> None:
        """Brings the state into its fixed place."""
        now = self._get()
        if not self._state:
            self._state = {name: value.clone() for name, value in now.items()}
        for name, value in now.items():
            if value is not self._state[name]:
                self._state[name].copy_(value)
        self._put(self._state)


def fresh(result: Any) -> Any:
    """A nest of tensors in memory of its own; a tensor that occurs twice is copied once."""
    found = {id(value): value for value in tree_leaves(result) if isinstance(value, Tensor)}
    copies = {key: torch.empty_like(value) for key, value in found.items()}
    for kind in {value.dtype for value in found.values()}:  # of one kind at once: few kernels
        keys = [key for key, value in found.items() if value.dtype == kind]
        torch._foreach_copy_([copies[k] for k in keys], [found[k] for k in keys])  # pyright: ignore
    return tree_map_only(Tensor, lambda value: copies[id(value)], result)


class SideBySide:
    """Runs jobs one after the other on a CPU, at the same time on a GPU."""

    def __init__(self, jobs: int, device: torch.device) -> None:
        """``jobs``: the most at a time."""
        several = device.type == "cuda" and jobs > 1
        self._streams = [torch.cuda.Stream(device) for _ in range(jobs)] if several else []

    def run(self, jobs: Sequence[Callable[[], None]]) -> None:
        """Does the jobs.

        On CUDA what comes after in the caller's stream waits for them all, and they for what came before, in a
        recording too, where they become branches of the graph. What they read must live until this ends.
        """
        if not self._streams:
            for job in jobs:
                job()
            return
        caller = torch.cuda.current_stream()
        # One event before all jobs: of a later one, in the legacy stream, jobs under way might have to be waited for.
        before = caller.record_event()
        for stream, job in zip(self._streams, jobs, strict=True):
            stream.wait_event(before)
            with torch.cuda.stream(stream):
                job()
        for stream in self._streams:
            caller.wait_event(stream.record_event())
