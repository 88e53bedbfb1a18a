"""Metrics of a run: a line of JSON for each report, and a logger's point for each value, over environment steps."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bidex_meta.record.atomic import write_atomic
from bidex_meta.record.writers import Writer, make_writer


class MetricsWriter:
    """Appends to ``metrics.jsonl`` in the run folder, and tells a logger.

    Args:
        folder: The run folder.
        resume_step: Of the checkpoint a resumed run starts from. Whatever was logged after it is dropped from
            both, since the resumed run logs it again. None for a new run.
        logger: Name in ``bidex_meta.record.writers``.
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
    """The lines of a ``metrics.jsonl``, without a last one torn by a crash.

    Args:
        path: The file.
    """
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break  # lines are only ever appended: what follows a torn one was never completed
    return rows


def training_seconds(rows: Sequence[Mapping[str, Any]]) -> float:
    """Wall time of the training, in seconds and over all resumes, that the lines of a ``metrics.jsonl`` tell of.

    Of runs that did not yet log it: the time of the iterations alone, without that of checkpoints.
    """
    logged = [row["Perf/training_time"] for row in rows if "Perf/training_time" in row]
    parts = ("Perf/collection_time", "Perf/learning_time")
    unlogged = [row.get(part, 0.0) for row in rows if "Perf/training_time" not in row for part in parts]
    return max(logged, default=sum(unlogged))


def drop_after(path: Path, step: int) -> None:
    """Keep only the lines of ``path`` with a step up to ``step``; a missing file becomes an empty one."""
    rows = [row for row in read_metrics(path) if row["step"] <= step] if path.exists() else []
    text = "".join(json.dumps(row) + "\n" for row in rows)
    write_atomic(path, lambda file: file.write(text.encode()))
