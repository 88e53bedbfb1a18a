"""Progress of training or filming, on stderr: a live table in a terminal, a plain line every few seconds elsewhere."""

import contextlib
import math
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import TextIO, TypeVar

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.progress import track
from rich.table import Table
from rich.text import Text
from typing_extensions import override

from bidex_meta.utils.streams import silence
from bidex_meta.utils.waiting import note, told

Item = TypeVar("Item")

_PLAIN_SECONDS = 5.0
_COUNTED_SECONDS = 15.0
_SUCCESS = "Train/success/"
_RETURN = "Train/return/"


class PlainConsole(Console):
    """A console that raises BrokenPipeError if the reader is gone; rich would end the process."""

    @override
    def on_broken_pipe(self) -> None:
        raise  # raises the error that is being handled


class Progress:
    """Displays the progress of training on stderr or ``stream``.

    It shows steps per second, the time left, and return and success, as means and per task. ``total_steps`` and
    ``total_seconds`` are limits of the whole run, including parts before a resume; the time so far is the metric
    ``Perf/training_time``. If there is a time limit, progress is shown relative to it. Speed is measured from
    ``start_step``, the first step of this process.
    """

    def __init__(
        self, total_steps: int, total_seconds: float = math.inf, start_step: int = 0, stream: TextIO | None = None
    ):
        self._console = PlainConsole(file=stream or sys.stderr)
        self._total = total_steps
        self._total_seconds = total_seconds
        self._start_step = start_step
        self._start_time = time.monotonic()
        self._last_line = -math.inf
        self._step = start_step
        self._shown: dict[str, float] = {}
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
        else:
            self._live = None

    def start(self) -> None:
        """Begin the display; speed is measured from this moment."""
        self._start_time = time.monotonic()
        if self._live is not None:
            self._live.start()

    def update(self, metrics: Mapping[str, float], step: int) -> None:
        """Show an iteration's metrics; earlier values stay visible, because in some iterations no episode ends.

        Raises BrokenPipeError if the reader has ended or the terminal is gone; later output is discarded.
        """
        self._shown.update({tag: value for tag, value in metrics.items() if value == value})
        self._step = step
        try:
            if self._live is not None:
                told()
                self._live.update(self._table(step), refresh=True)
            elif time.monotonic() - self._last_line >= _PLAIN_SECONDS or self._seconds_left(step) <= 0.0:
                self._last_line = time.monotonic()
                self._print([*self._overall(step), *self._of_tasks()])
        except OSError as error:  # a terminal that is gone gives EIO
            silence(self._console.file)
            raise BrokenPipeError(f"progress cannot be shown: {error.strerror or error}") from error

    def close(self) -> None:
        """Restore the terminal and replace the table by a line; errors of a closed terminal are ignored."""
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.stop()
                self._print(self._overall(self._step))

    def _tasks(self) -> list[str]:
        tags = [tag for tag in self._shown if tag.startswith((_SUCCESS, _RETURN))]
        return list(dict.fromkeys(tag.split("/", 2)[2] for tag in tags))

    def _of_tasks(self) -> list[str]:
        return [f"{name} {_percent(self._shown.get(_SUCCESS + name))}" for name in self._tasks()]

    def _print(self, parts: Iterable[str]) -> None:
        told()
        self._console.print(" | ".join(parts), soft_wrap=True, highlight=False, markup=False)

    def _table(self, step: int) -> Group:
        parts = "  ".join(self._overall(step)).split("  ")
        heading = Text("\n".join(_lines(parts, self._console.width)), style="bold")
        table = Table()
        table.add_column("task")
        for column in ("success", "return"):
            table.add_column(column, justify="right")
        for name in self._tasks():
            success = self._shown.get(_SUCCESS + name)
            mean_return = self._shown.get(_RETURN + name)
            table.add_row(escape(name), _percent(success), _number(mean_return))
        return Group(heading, table)

    def _rate(self, step: int) -> float:
        return (step - self._start_step) / max(time.monotonic() - self._start_time, 1e-9)

    def _seconds_left(self, step: int) -> float:
        """Return the seconds until the steps are done or the time is up, whichever comes first."""
        steps = self._total - step
        rate = self._rate(step)
        if steps <= 0:
            by_steps = 0.0
        elif rate > 0:
            by_steps = steps / rate
        else:
            by_steps = math.inf
        return min(by_steps, self._total_seconds - self._shown.get("Perf/training_time", 0.0))

    def _overall(self, step: int) -> list[str]:
        seconds = self._seconds_left(step)
        if seconds < math.inf:
            left = _duration(seconds)
        else:
            left = "?"
        done = [f"{step:,} / {self._total:,} steps"]
        if self._total_seconds < math.inf:
            spent = self._shown.get("Perf/training_time", 0.0)
            done = [f"{_duration(spent)} of {_duration(self._total_seconds)}", f"{step:,} steps"]
        speed = [*done, f"{self._rate(step):,.0f} steps/s", f"{left} left"]
        mean_return = self._shown.get("Train/mean_return")
        success = self._shown.get("Train/success_rate")
        teacher = self._shown.get("Policy/teacher_share", 0.0)
        if teacher:
            plays = [f"teacher plays {_percent(teacher)}"]
        else:
            plays = []
        return ["  ".join(speed), f"return {_number(mean_return)}", f"success {_percent(success)}", *plays]


def counted(items: Iterable[Item], total: int, subject: str) -> Iterator[Item]:
    """Yield the items and show their count out of ``total`` on stderr: a bar in a terminal, plain lines elsewhere."""
    console = PlainConsole(file=sys.stderr)
    if console.is_terminal:
        note("")  # the bar moves by itself
        yield from track(items, description=subject, total=total, console=console, transient=True)
        return
    reported = time.monotonic()
    for number, item in enumerate(items, start=1):
        yield item
        if time.monotonic() - reported >= _COUNTED_SECONDS:
            reported = time.monotonic()
            told()
            console.print(f"{number} of {total} {subject}", highlight=False, markup=False)


def _lines(parts: Iterable[str], width: int) -> list[str]:
    """Join parts into lines of at most ``width``; no part is broken."""
    lines: list[str] = []
    for part in parts:
        joined = f"{lines[-1]}  {part}" if lines else part
        if lines and len(joined) <= width:
            lines[-1] = joined
        else:
            lines.append(part)
    return lines


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(max(seconds, 0)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{seconds:02d}"
    return f"{minutes}:{seconds:02d}"
