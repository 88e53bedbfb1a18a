"""Metrics of a run: a line of JSON for each report, and a logger's point for each value, over environment steps."""

import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.runs.writers import Writer, make_writer
from bidex_meta.utils.files import bounded, exists, open_regular, read_bytes

_MOST_BYTES = 4_000_000_000
"""Of a ``metrics.jsonl``; a line an iteration is some kilobytes."""
_TAIL = 65_536


class MetricsWriter:
    """Appends to ``metrics.jsonl`` in the run folder, and tells a logger.

    Args:
        folder: The run folder.
        resume_step: Of the checkpoint a resumed run starts from. Whatever was logged after it is dropped from
            both, since the resumed run logs it again. None for a new run.
        logger: Name in ``bidex_meta.runs.writers``.
    """

    def __init__(self, folder: Path, resume_step: int | None = None, logger: str = "tensorboard"):
        path = folder / "metrics.jsonl"
        if resume_step is not None:
            drop_after(path, resume_step)
        self._file = path.open("a")
        self.writer: Writer = make_writer(logger, folder, resume_step)

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Write one line, and one point of the logger per value.

        Args:
            metrics: Tag to number; a value that is not finite stands as null in the JSON.
            step: Environment steps so far.
        """
        values = {tag: float(value) for tag, value in metrics.items()}
        finite = {tag: value if math.isfinite(value) else None for tag, value in values.items()}
        self._file.write(json.dumps({"step": step, "time": round(time.time(), 3), **finite}) + "\n")
        self._file.flush()  # into the hands of the system: a killed process loses no line
        self.writer.scalars(values, step)

    def flush(self) -> None:
        """Also hand the logger's buffered points over."""
        self.writer.flush()

    def close(self) -> None:
        """Write what is buffered and close both."""
        self._file.close()
        self.writer.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a ``metrics.jsonl``, without those that cannot be read, such as a last one torn by a crash.

    Args:
        path: The file.

    Raises:
        BidexError: There is no such file, or something else in its place.
    """
    return [row for _, row in _lines(path) if row is not None]


def last_rows(path: Path) -> list[dict[str, Any]]:
    """The last lines of a ``metrics.jsonl`` that can be read, without reading all of a long file; errors as there."""
    with open_regular(path, "a run's metrics", _MOST_BYTES) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
        rows = [_row(line) for line in file.read().split(b"\n") if line.strip()]
    return [row for row in rows if row is not None]  # a first one that was cut in two cannot be read


def training_seconds(rows: Sequence[Mapping[str, Any]]) -> float:
    """Wall time of the training, in seconds and over all resumes, that the lines of a ``metrics.jsonl`` tell of.

    Of runs that did not yet log it: the time of the iterations alone, without that of checkpoints.
    """
    logged = [row["Perf/training_time"] for row in rows if row.get("Perf/training_time") is not None]
    parts = ("Perf/collection_time", "Perf/learning_time")
    unlogged = [row.get(part) or 0.0 for row in rows if "Perf/training_time" not in row for part in parts]
    return max(logged, default=sum(unlogged))


def mend(path: Path, step: int) -> list[dict[str, Any]]:
    """The lines up to ``step`` of the run that goes on from there, whatever has become of its metrics.

    What stands in the file's place without being one, and a file with lines that cannot be read beside a torn last one,
    is kept as ``metrics.jsonl.damaged``, and reported: a good checkpoint shall not wait for its metrics.
    """
    if not exists(path):
        return []
    try:
        lines = _lines(path)
    except BidexError as error:
        _set_aside(path, str(error))
        return []
    bad = sum(row is None for _, row in lines[:-1])
    if bad:
        # A copy: the good lines go on in the file itself.
        write_atomic(path.with_name(f"{path.name}.damaged"), lambda file: file.write(path.read_bytes()))
        print(f"{path}: {bad} lines cannot be read; all are kept in {path.name}.damaged.", file=sys.stderr)
        _keep(path, [line for line, row in lines if row is not None])
    return [row for _, row in lines if row is not None and row["step"] <= step]


def drop_after(path: Path, step: int) -> None:
    """Keep only the lines of ``path`` with a step up to ``step``, as they are; a missing file becomes an empty one."""
    lines = _lines(path) if exists(path) else []
    _keep(path, [line for line, row in lines if row is not None and row["step"] <= step])


def _keep(path: Path, lines: Sequence[bytes]) -> None:
    write_atomic(path, lambda file: file.write(b"".join(line + b"\n" for line in lines)))


def _set_aside(path: Path, reason: str) -> None:
    damaged = path.with_name(f"{path.name}.damaged")
    print(f"{reason} It is kept as {damaged.name}, and metrics begin anew.", file=sys.stderr)
    path.rename(damaged)


def _lines(path: Path) -> list[tuple[bytes, dict[str, Any] | None]]:
    """Every line that is not empty, and what it says; None where it cannot be read."""
    lines = read_bytes(path, "a run's metrics", _MOST_BYTES).split(b"\n")
    return [(line, _row(line)) for line in lines if line.strip()]


def _row(line: bytes) -> dict[str, Any] | None:
    """A line's numbers by name; None where it holds anything else."""
    try:
        row = bounded(json.loads(line, parse_constant=lambda _: None))
    except (ValueError, RecursionError):  # ValueError: also bytes that are no text
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int or row["step"] < 0:
        return None
    numbers = [value for value in row.values() if value is not None]
    return row if all(type(value) in (int, float) and math.isfinite(value) for value in numbers) else None
