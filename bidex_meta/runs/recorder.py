"""The object that a training loop writes to: metrics, checkpoints, films and progress."""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Annotated

import numpy as np
from msgspec import Meta

from bidex_meta.runs.checkpoints import State
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.metrics import MetricsWriter
from bidex_meta.runs.progress import Progress
from bidex_meta.runs.video import write_video
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Seconds, Whole


class Recorder:
    """The record of a training run. Use it as a context manager, so that files are closed and the terminal is restored.

    ``total_steps`` and ``total_seconds`` are for the progress display, which ``show_progress`` turns on.
    ``resume_step`` is the step of the checkpoint that the run continues from.
    """

    on_log: Callable[[Mapping[str, float], int], None] | None = None
    """Called with metrics and environment steps after they were written."""

    @checked_arguments
    def __init__(
        self, folder: RunFolder, total_steps: Annotated[int, Meta(ge=0, le=10**15)], total_seconds: Seconds = math.inf,
        resume_step: Whole | None = None, logger: str = "tensorboard", show_progress: bool = True
    ):  # fmt: skip
        self._checkpoints = folder.checkpoints
        self._videos = folder.videos_path
        self._metrics = MetricsWriter(folder.path, resume_step, logger)
        self._metrics.writer.config(portable(folder.config().to_json()))
        if show_progress:
            self._progress = Progress(total_steps, total_seconds, start_step=resume_step or 0)
        else:
            self._progress = None

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Write metrics by tag after ``step`` environment steps, and update the progress display."""
        self._metrics.log(metrics, step)
        if self._progress is not None:
            self._progress.update(metrics, step)
        if self.on_log is not None:
            self.on_log(metrics, step)

    def save(self, state: State, step: int) -> None:
        """Write a checkpoint, atomically; see ``Checkpoints.save``."""
        self._metrics.flush()
        self._checkpoints.save(state, step)

    def film(self, name: str, frames: Iterable[np.ndarray], fps: float, step: int) -> Path:
        """Write ``videos/<name>_<step>.mp4`` and log it; frames are ``(height, width, 3)``, uint8, of even sizes."""
        path = self._videos / f"{name}_{step}.mp4"
        pictures = list(frames)
        write_video(path, pictures, fps)
        self._metrics.writer.film(f"Film/{name}", path, pictures, fps, step)
        return path

    def __enter__(self) -> "Recorder":
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.close()
        self._metrics.close()
