"""Ways to keep an accelerator busy during a step: parallel streams for engines, CUDA graphs for torch's work.

If torch's kernels were launched one by one, they would take longer than the physics. A CUDA graph therefore records a
part of a step, called a stretch here, and replays it at once. The state that a stretch reads and writes is in tensors
at fixed addresses. The result is at a fixed address too, and the next replay overwrites it.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Protocol, TypeVar, cast

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

Result = TypeVar("Result")
"""Nested containers of tensors that a stretch of work returns. The work may also read and rebind the world's state."""

Together = Callable[[Sequence[Callable[[], None]]], None]
"""A function that runs jobs that do not depend on each other, such as ``SideBySide.run``."""

_BEFORE = 3
"""Number of runs of a stretch before it is recorded. Libraries allocate and compile in the first runs. A world that is
stepped only a few times, or only a few times between changes of its tasks, never spends time on a recording."""


class Record(Protocol):
    """Records work as the result of ``cuda_graphs`` does."""

    def __call__(self, work: Callable[[], Result], /) -> tuple[Callable[[], None], Result]:
        """Return a function that repeats the work in the same memory, and the tensors that will hold its results."""
        ...


def cuda_graphs(device: torch.device) -> Record:
    """Return a function that records work on a GPU as one CUDA graph."""
    # Without this stream, torch would record on its current device, and the recording of work on another GPU would be
    # empty.
    stream = torch.cuda.Stream(device)

    def record(work: Callable[[], Result]) -> tuple[Callable[[], None], Result]:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(device), torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            result = work()
        return graph.replay, result

    return record


class GraphCache:
    """A cache of recorded stretches of work (parts of a step), by key; all of them use the same state.

    A recording always uses the tensors that the work's closures held when it was recorded. Call ``forget`` after
    replacing any of these tensors other than the state and the inputs.
    """

    def __init__(
        self, get: Callable[[], dict[str, Tensor]], put: Callable[[dict[str, Tensor]], None], record: Record
    ) -> None:
        """Take the function ``get``, which returns the state's tensors by name, and ``put``, which replaces them.

        ``record`` is e.g. a result of ``cuda_graphs``.
        """
        self._get = get
        self._put = put
        self._record = record
        self.forget()

    def forget(self) -> None:
        """Drop all recordings; each stretch of work is recorded again only after a few direct runs."""
        self._state: dict[str, Tensor] = {}
        self._runs: dict[Hashable, int] = {}
        self._recorded: dict[Hashable, tuple[list[Tensor], Callable[[], None], object]] = {}

    def run(self, key: Hashable, work: Callable[..., Result], *inputs: Tensor) -> Result:
        """Run the work and return its result: directly in the first runs, then by replaying a recording.

        The next replay with the same key overwrites the result. A key must always come with the same work, and with
        inputs of the same shapes.
        """
        self._runs[key] = self._runs.get(key, 0) + 1
        if self._runs[key] <= _BEFORE:
            return work(*inputs)
        self._settle()
        if key not in self._recorded:
            own = [value.clone() for value in inputs]

            def settled() -> Result:
                result = work(*own)
                self._settle()
                return result

            self._recorded[key] = (own, *self._record(settled))
        own, replay, result = self._recorded[key]
        for fixed, value in zip(own, inputs, strict=True):
            fixed.copy_(value)
        replay()
        return cast(Result, result)

    def _settle(self) -> None:
        """Copy the state into the tensors at fixed addresses."""
        now = self._get()
        if not self._state:
            self._state = {name: value.clone() for name, value in now.items()}
        for name, value in now.items():
            if value is not self._state[name]:
                self._state[name].copy_(value)
        self._put(self._state)


def fresh(result: Result) -> Result:
    """Copy a nest of tensors into new memory; a tensor that occurs twice is copied once."""
    tensors = {id(value): value for value in tree_leaves(result) if isinstance(value, Tensor)}
    copies = {key: torch.empty_like(value) for key, value in tensors.items()}
    for kind in {value.dtype for value in tensors.values()}:  # one call per dtype needs few kernels
        keys = [key for key, value in tensors.items() if value.dtype == kind]
        torch._foreach_copy_([copies[k] for k in keys], [tensors[k] for k in keys])  # pyright: ignore
    return tree_map_only(Tensor, lambda value: copies[id(value)], result)


class Stepper(Protocol):
    """Runs parts of a world's step that read no tensor's value on the host."""

    def run(self, work: Callable[..., Result], *inputs: Tensor) -> Result:
        """Run a method of the world on tensors and return its result.

        The next run of the same method on tensors of the same shapes may overwrite the result.
        """
        ...

    def keep(self, result: Result) -> Result:
        """Return the result of ``run`` in memory that later calls of ``run`` do not overwrite."""
        ...

    def forget(self) -> None:
        """Drop the records of earlier runs. Call this after replacing something that the methods read."""
        ...


class EagerStepper:
    """Runs each part of a step directly, without recording it."""

    def run(self, work: Callable[..., Result], *inputs: Tensor) -> Result:
        """See ``Stepper``."""
        return work(*inputs)

    def keep(self, result: Result) -> Result:
        """See ``Stepper``."""
        return result

    def forget(self) -> None:
        """See ``Stepper``."""


class CapturedStepper:
    """Runs each part of a step directly a few times, then records it as a graph and replays the graph."""

    def __init__(
        self, get: Callable[[], dict[str, Tensor]], put: Callable[[dict[str, Tensor]], None], record: Record
    ) -> None:
        """Take the same arguments as ``GraphCache``."""
        self._graphs = GraphCache(get, put, record)

    def run(self, work: Callable[..., Result], *inputs: Tensor) -> Result:
        """See ``Stepper``."""
        key = (work, *(value.shape for value in inputs))
        return self._graphs.run(key, work, *inputs)

    def keep(self, result: Result) -> Result:
        """See ``Stepper``."""
        return fresh(result)

    def forget(self) -> None:
        """See ``Stepper``."""
        self._graphs.forget()


class SideBySide:
    """Runs jobs in parallel on a GPU, and one after the other on a CPU."""

    def __init__(self, jobs: int, device: torch.device) -> None:
        """Prepare streams; ``jobs`` is the maximum number of jobs that run at the same time."""
        self._device = device
        several = device.type == "cuda" and jobs > 1
        if several:
            self._streams = [torch.cuda.Stream(device) for _ in range(jobs)]
        else:
            self._streams = []

    def run(self, jobs: Sequence[Callable[[], None]]) -> None:
        """Run the jobs.

        On CUDA the jobs wait for earlier work in the caller's stream, and later work in that stream waits for all jobs.
        In a recording the jobs become branches of the graph. Tensors that the jobs read must exist until this call
        ends.
        """
        if not self._streams:
            for job in jobs:
                job()
            return
        caller = torch.cuda.current_stream(self._device)
        # One event is recorded before all jobs. A later event in the legacy stream might have to wait for running jobs.
        before = caller.record_event()
        for stream, job in zip(self._streams, jobs, strict=True):
            stream.wait_event(before)
            with torch.cuda.stream(stream):
                job()
        for stream in self._streams:
            caller.wait_event(stream.record_event())
