"""The one object a training loop writes to: metrics, checkpoints, films and progress."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.metrics import MetricsWriter
from bidex_meta.runs.progress import Progress
from bidex_meta.runs.video import write_video


class Recorder:
    """Records a training run. Use as a context manager, so that files are closed and the terminal is restored.

    Args:
        folder: The run folder.
        total_steps: Environment steps of the whole run, for the progress display.
        total_seconds: Training time of the whole run, for the same.
        resume_step: Step of the checkpoint the run continues from; None for a new run.
        logger: ``tensorboard``, ``wandb`` or ``none``.
    """

    def __init__(
        self,
        folder: RunFolder,
        total_steps: int,
        total_seconds: float = math.inf,
        resume_step: int | None = None,
        logger: str = "tensorboard",
    ):
        self._checkpoints, self._videos = folder.checkpoints, folder.videos_path
        self._metrics = MetricsWriter(folder.path, resume_step, logger)
        if resume_step is None:
            self._metrics.writer.config(folder.config().to_json())
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

    def film(self, name: str, frames: Iterable[np.ndarray], fps: float, step: int) -> Path:
        """Write ``videos/<name>_<step>.mp4``, and tell the logger.

        Args:
            name: What is seen.
            frames: ``(height, width, 3)`` uint8 each, height and width even.
            fps: Frames per second.
            step: Environment steps so far.
        """
        path, kept = self._videos / f"{name}_{step}.mp4", list(frames)
        write_video(path, kept, fps)
        self._metrics.writer.film(f"Film/{name}", path, kept, fps, step)
        return path

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
