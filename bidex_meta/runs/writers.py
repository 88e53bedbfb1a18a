"""Loggers of curves in addition to ``metrics.jsonl``: TensorBoard, Weights & Biases, or none."""

import json
import os
import uuid
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from typing_extensions import override

from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.video import encoded


class Writer:
    """The base class of loggers. It writes nothing, so that ``metrics.jsonl`` is the only record.

    A resumed run starts from a checkpoint of ``resume_step`` and writes later points again.
    """

    def __init__(self, folder: Path, resume_step: int | None = None) -> None: ...

    def config(self, values: Json) -> None:
        """Log the run's config, at the beginning and after each resume, because the config or the logger may change."""

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Log numbers by tag at an environment step."""

    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        """Log a film, given as a file and as frames, each ``(height, width, 3)`` uint8."""

    def flush(self) -> None:
        """Write buffered points."""

    def close(self) -> None:
        """Close the logger."""


def make_writer(logger: str, folder: Path, resume_step: int | None = None) -> Writer:
    """Make the writer of a logger in ``LOGGERS``; raises BidexError if the logger is unknown or not installed."""
    if logger not in LOGGERS:
        raise unknown_name("logger", logger, LOGGERS)
    return LOGGERS[logger](folder, resume_step)


def check_logger(logger: str) -> None:
    """Raise BidexError for a logger that is not installed."""
    if logger == "wandb":
        _wandb()


class TensorBoardWriter(Writer):
    """An event file in the run folder; ``tensorboard --logdir runs`` shows it. Films are written as animated GIFs."""

    def __init__(self, folder: Path, resume_step: int | None = None) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        self._board = SummaryWriter(str(folder), purge_step=None if resume_step is None else resume_step + 1)

    @override
    def config(self, values: Json) -> None:
        text = json.dumps(values, indent=2)
        self._board.add_text("config", "".join(f"    {line}\n" for line in text.splitlines()))

    @override
    def scalars(self, values: Mapping[str, float], step: int) -> None:
        for tag, value in values.items():
            self._board.add_scalar(tag, value, step)

    @override
    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        # TensorBoard shows films as animated GIFs in its tab Images.
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]

        height, width, _ = frames[0].shape
        gif = encoded(frames, "GIF", duration=round(1000 / fps))
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
        assert self._board.file_writer is not None
        self._board.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    @override
    def flush(self) -> None:
        self._board.flush()

    @override
    def close(self) -> None:
        self._board.close()


class WandbWriter(Writer):
    """A run of Weights & Biases; the project is ``WANDB_PROJECT``, or ``bidex-meta``.

    The run folder holds the id of the W&B run, so that a resumed run continues the same W&B run. Environment steps are
    the metric ``env_steps``, because W&B steps may only increase, and a resumed run begins before the last logged step.
    """

    def __init__(self, folder: Path, resume_step: int | None = None) -> None:
        self._wandb = _wandb()
        file = folder / "wandb-id"
        if not file.exists():
            file.write_text(uuid.uuid4().hex)
        project = os.environ.get("WANDB_PROJECT", "bidex-meta")
        name = "/".join(folder.resolve().parts[-3:])
        self._run = self._wandb.init(
            project=project, id=file.read_text().strip(), name=name, dir=str(folder), resume="allow"
        )
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    @override
    def config(self, values: Json) -> None:
        self._run.config.update(values, allow_val_change=True)

    @override
    def scalars(self, values: Mapping[str, float], step: int) -> None:
        self._run.log({**values, "env_steps": step})

    @override
    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        self._run.log({tag: self._wandb.Video(str(path), format="mp4"), "env_steps": step})

    @override
    def close(self) -> None:
        self._run.finish()


LOGGERS = {"tensorboard": TensorBoardWriter, "wandb": WandbWriter, "none": Writer}


def _wandb() -> ModuleType:
    try:
        return import_module("wandb")
    except ImportError:
        raise BidexError("--logger wandb needs wandb: pip install 'bidex-meta[wandb]'. Or use tensorboard.") from None
