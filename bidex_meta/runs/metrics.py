"""Write and read the metrics of a run over environment steps.

Each report of metrics becomes one line of ``metrics.jsonl`` in JSON. A logger, such as TensorBoard, receives the same
values.
"""

import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json, write_atomic
from bidex_meta.runs.writers import Writer, make_writer
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import bounded, exists, open_regular, read_bytes
from bidex_meta.utils.validation import Whole

_MOST_BYTES = 4_000_000_000  # maximum size of a ``metrics.jsonl``; one iteration writes a line of a few kilobytes
_TAIL = 65_536


class MetricsWriter:
    """Appends to ``metrics.jsonl`` in the run folder, and to a logger of ``bidex_meta.runs.writers``.

    In a resumed run, the file and TensorBoard drop the points after ``resume_step``, the step of the checkpoint,
    because these points are logged again. Weights & Biases cannot drop points and shows both.
    """

    @checked_arguments
    def __init__(self, folder: Path, resume_step: Whole | None = None, logger: str = "tensorboard"):
        path = folder / "metrics.jsonl"
        if resume_step is not None:
            _keep(path, [line for line, row in _lines(path) if row is not None and row["step"] <= resume_step])
        self._file = path.open("a", encoding="utf-8")
        self.writer: Writer = make_writer(logger, folder, resume_step)

    @checked_arguments
    def log(self, metrics: Mapping[str, Any], step: Whole) -> None:
        """Write one line, with null for values that are not finite, and pass each value to the logger."""
        values = {tag: float(value) for tag, value in metrics.items()}
        finite = {tag: value if math.isfinite(value) else None for tag, value in values.items()}
        self._file.write(json.dumps({"step": step, "time": round(time.time(), 3), **finite}) + "\n")
        self._file.flush()  # hands the line to the operating system, so that a killed process loses no line
        self.writer.scalars(values, step)

    def flush(self) -> None:
        """Write the logger's buffered points."""
        self.writer.flush()

    def close(self) -> None:
        """Write buffered data and close the file and the logger."""
        self._file.close()
        self.writer.close()


@checked_arguments
def read_metrics(path: Path) -> list[Json]:
    """Return the readable lines of a ``metrics.jsonl``; a crash may have torn the last line.

    Raises BidexError if there is no such file.
    """
    return [row for _, row in _lines(path, missing=False) if row is not None]


@checked_arguments
def last_rows(path: Path) -> list[Json]:
    """Return the last readable lines of a ``metrics.jsonl`` without reading it all.

    Errors are those of ``read_metrics``.
    """
    with open_regular(path, "a run's metrics", _MOST_BYTES) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
        rows = [_row(line) for line in file.read().split(b"\n") if line.strip()]
    return [row for row in rows if row is not None]  # the first line may be cut and is then unreadable


@checked_arguments
def training_seconds(rows: Sequence[Json]) -> float:
    """Return the wall time of a run's training, s, over all resumes, from the lines of a ``metrics.jsonl``."""
    logged = [row["Perf/training_time"] for row in rows if row.get("Perf/training_time") is not None]
    return max(logged, default=0.0)


@checked_arguments
def mend(path: Path, step: Whole) -> list[Json]:
    """Return the rows of metrics up to ``step`` for a run that resumes from this step, and repair the file.

    If the metrics are not a file, or if a line before the last cannot be read, the damaged metrics are kept as
    ``metrics.jsonl.damaged`` and a message is printed. The readable lines stay in the file. Damaged metrics thus do not
    prevent a run from resuming.
    """
    try:
        lines = _lines(path)
    except BidexError as error:
        print(f"{error} It is kept as {path.name}.damaged, and new metrics begin.", file=sys.stderr)
        path.rename(path.with_name(f"{path.name}.damaged"))
        return []
    bad = sum(row is None for _, row in lines[:-1])
    if bad:
        # The rows are copied, because the file itself keeps the good lines.
        write_atomic(path.with_name(f"{path.name}.damaged"), lambda file: file.write(path.read_bytes()))
        print(f"{path}: {bad} lines cannot be read; all are kept in {path.name}.damaged.", file=sys.stderr)
        _keep(path, [line for line, row in lines if row is not None])
    return [row for _, row in lines if row is not None and row["step"] <= step]


def _keep(path: Path, lines: Sequence[bytes]) -> None:
    write_atomic(path, lambda file: file.write(b"".join(line + b"\n" for line in lines)))


def _lines(path: Path, missing: bool = True) -> list[tuple[bytes, Json | None]]:
    """Return each non-empty line, with a dict of its numbers (None if unreadable).

    With ``missing``, the file need not exist.
    """
    if missing and not exists(path):
        return []
    lines = read_bytes(path, "a run's metrics", _MOST_BYTES).split(b"\n")
    return [(line, _row(line)) for line in lines if line.strip()]


def _row(line: bytes) -> Json | None:
    """Return a line's numbers by name; None if the line holds anything else."""
    try:
        row = bounded(json.loads(line, parse_constant=lambda _: None))
    except (ValueError, RecursionError):  # ValueError: also bytes that are not text
        return None
    if not isinstance(row, dict) or type(row.get("step")) is not int or row["step"] < 0:
        return None
    numbers = [value for value in row.values() if value is not None]
    if all(type(value) in (int, float) and math.isfinite(value) for value in numbers):
        return row
    return None
