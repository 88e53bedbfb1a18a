"""Engines side by side: on CUDA each has a stream of its own, so that small batches fill the device together."""

from collections.abc import Callable, Iterator, Sequence

import torch


class SideBySide:
    """Runs jobs one after the other on a CPU, at the same time on a GPU."""

    def __init__(self, jobs: int, device: torch.device) -> None:
        """Makes the streams.

        Args:
            jobs: The most jobs at a time.
            device: Where they run.
        """
        several = device.type == "cuda" and jobs > 1
        self._streams = [torch.cuda.Stream(device) for _ in range(jobs)] if several else []

    def run(self, jobs: Sequence[Callable[[], None]]) -> Iterator[int]:
        """Does the jobs; gives their numbers, in order, as each is done. To be used up.

        On CUDA what comes after in the caller's stream waits for them all, and they for what came before. What they
        read must live until this ends.
        """
        if not self._streams:
            for number, job in enumerate(jobs):
                job()
                yield number
            return
        caller = torch.cuda.current_stream()
        for stream, job in zip(self._streams, jobs, strict=True):
            stream.wait_stream(caller)
            with torch.cuda.stream(stream):
                job()
        for stream in self._streams:
            caller.wait_stream(stream)
        yield from range(len(jobs))
