"""Where a run stands, told from within it, and its death at a chosen moment.

A run passes phases; in each it makes events: a step of a world, an operation on a file of its folder, a piece of a file
that is written. The process ends itself by SIGKILL at the event it is aimed at, a piece then being written by half.
What it has counted stands in a file that outlives it.
"""

import functools
import mmap
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

PHASES = ("starting", "training", "saving", "watching", "recording", "evaluating")
_OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "os.truncate", "os.link")
COUNTED = (*PHASES, "operations")
"""What an aim may name: a phase, or the operations on files alone, of all phases."""


class Marks:
    """The counts of one process.

    Args:
        path: The file of the counts.
        aim: Phase and number of the event, from 1, before which the process dies; None: it lives.
        end: What it gets then; SIGSTOP where somebody else shall kill it, with others.
    """

    def __init__(self, path: Path, aim: tuple[str, int] | None = None, end: int = signal.SIGKILL):
        path.write_bytes(bytes(8 * (1 + len(COUNTED))))
        with path.open("r+b") as file:
            self._memory = memoryview(mmap.mmap(file.fileno(), 0)).cast("q")
        self._end = end
        self._aim = (COUNTED.index(aim[0]), aim[1]) if aim else None

    def event(self, before: Callable[[], object] = lambda: None) -> None:
        """Something happens next; ``before`` is called only where the process dies of it."""
        self._count(self._memory[0], before)

    def _count(self, what: int, before: Callable[[], object] = lambda: None) -> None:
        self._memory[1 + what] += 1
        if self._aim == (what, self._memory[1 + what]):
            before()
            os.kill(os.getpid(), self._end)

    def phase(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, during which the run is in a phase."""

        @functools.wraps(function)
        def within(*arguments: Any, **keywords: Any) -> Any:
            outer, self._memory[0] = self._memory[0], PHASES.index(name)
            try:
                return function(*arguments, **keywords)
            finally:
                self._memory[0] = outer

        return within

    def watch_files(self, folder: Path) -> None:
        """Counts operations in ``folder`` from now on, for as long as the process lives."""
        inside = str(folder)

        def hear(event: str, arguments: tuple[Any, ...]) -> None:
            named = event in _OPERATIONS and isinstance(arguments[0], str | os.PathLike)
            if named and str(arguments[0]).startswith(inside):
                self._count(COUNTED.index("operations"))
                self.event()

        sys.addaudithook(hear)


class Torn:
    """A file whose every piece is an event; that which kills is written by half."""

    def __init__(self, file: Any, marks: Marks):
        self._file, self._marks = file, marks

    def write(self, data: Any) -> int:
        def half() -> None:
            self._file.write(data[: len(data) // 2])
            self._file.flush()

        self._marks.event(half)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def instrument(marks: Marks) -> None:
    """Puts the marks into the commands of this process, for good; what else a run learns to do gets a line here."""
    from bidex_algos.offline.base import Offline
    from bidex_meta.cli import run
    from bidex_meta.data.writer import DatasetWriter
    from bidex_meta.experiments import run_recording, watching
    from bidex_meta.runs import atomic, checkpoints, metrics
    from bidex_meta.training import runner

    for module, name, phase in (
        (runner, "train", "training"),
        (checkpoints.Checkpoints, "save", "saving"),
        (watching.Watch, "__call__", "watching"),
        (DatasetWriter, "commit", "recording"),
        (run_recording, "complete", "recording"),
        (run, "_evaluate", "evaluating"),
    ):
        setattr(module, name, marks.phase(phase, getattr(module, name)))
    plainly = atomic.write_atomic

    def write_atomic(path: Path, write: Callable[[Any], object]) -> None:
        plainly(path, lambda file: write(Torn(file, marks)))

    for module in (atomic, checkpoints, metrics):
        module.write_atomic = write_atomic  # type: ignore[attr-defined]
    update = Offline._bootstrapped

    def counted(self: Any, *arguments: Any) -> Any:
        marks.event()  # the step of those that play nothing
        return update(self, *arguments)

    Offline._bootstrapped = counted  # type: ignore[method-assign]
    make = metrics.MetricsWriter.__init__

    def begin(self: Any, *arguments: Any, **keywords: Any) -> None:
        make(self, *arguments, **keywords)
        self._file = Torn(self._file, marks)

    metrics.MetricsWriter.__init__ = begin  # type: ignore[method-assign]


def read(path: Path) -> tuple[str, dict[str, int]]:
    """The phase in which a process ended, and how often what is counted happened."""
    numbers = memoryview(path.read_bytes()).cast("q").tolist()
    return PHASES[numbers[0]], dict(zip(COUNTED, numbers[1:], strict=True))
