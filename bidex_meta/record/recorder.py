"""The one object a training loop writes to: metrics, checkpoints and progress behind ``log`` and ``save``."""

import math
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from bidex_meta.record.folder import RunFolder
from bidex_meta.record.metrics import MetricsWriter
from bidex_meta.record.progress import Progress


class Recorder:
    """Records a training run. Use as a context manager, so that files are closed and the terminal is restored.

    Args:
        folder: The run folder.
        total_steps: Environment steps of the whole run, for the progress display.
        total_seconds: Training time of the whole run, for the same.
        resume_step: Step of the checkpoint the run continues from; None for a new run.
    """

    def __init__(
        self, folder: RunFolder, total_steps: int, total_seconds: float = math.inf, resume_step: int | None = None
    ):
        self._checkpoints = folder.checkpoints
        self._metrics = MetricsWriter(folder.path, resume_step)
        self._progress = Progress(total_steps, total_seconds, start_step=resume_step or 0)

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Write metrics and renew the progress display.

        Args:
            metrics: Tag to number, e.g. ``{"Train/mean_return": 3.2, "Train/success/HandOver": 0.1}``.
            step: Environment steps so far.
        """
        self._metrics.log(metrics, step)
        self._progress.update(metrics, step)

    def save(self, state: dict[str, Any], step: int) -> None:
        """Write a checkpoint, atomically.

        Args:
            state: Everything that is needed to continue; see ``Checkpoints.save``.
            step: Environment steps so far.
        """
        self._metrics.flush()
        self._checkpoints.save(state, step)

    def close(self) -> None:
        """Close files and the progress display."""
        self._progress.close()
        self._metrics.close()

    def __enter__(self) -> "Recorder":
        """Start the progress display."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
