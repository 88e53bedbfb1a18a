"""Where curves can be watched beside ``metrics.jsonl``: TensorBoard, Weights & Biases, or nowhere."""

import json
import uuid
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError, unknown_name


class Writer:
    """A logger; this one keeps nothing, so that ``metrics.jsonl`` stands alone.

    Args:
        folder: The run folder.
        resume_step: Of the checkpoint a resumed run starts from: what came after is written anew.
    """

    def __init__(self, folder: Path, resume_step: int | None = None) -> None: ...

    def config(self, values: Mapping[str, Any]) -> None:
        """Takes the run's config, once at the beginning."""

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Takes numbers by tag at an environment step."""

    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        """Takes a film, as a file and as frames, each ``(height, width, 3)`` uint8."""

    def flush(self) -> None:
        """Hands over what is buffered."""

    def close(self) -> None:
        """Ends it."""


def make_writer(logger: str, folder: Path, resume_step: int | None = None) -> Writer:
    """The writer of a logger's name.

    Args:
        logger: A name in ``LOGGERS``.
        folder: The run folder.
        resume_step: Of the checkpoint a resumed run starts from: it writes anew what came after.

    Raises:
        BidexError: Unknown name, or the logger is not installed.
    """
    if logger not in LOGGERS:
        raise unknown_name("logger", logger, LOGGERS)
    return LOGGERS[logger](folder, resume_step)


def check_logger(logger: str) -> None:
    """Refuse a logger that is not installed, before anything is made.

    Raises:
        BidexError: It is not there.
    """
    if logger == "wandb":
        _wandb()


class TensorBoardWriter(Writer):
    """An event file in the run folder; ``tensorboard --logdir runs`` shows it. Films are animated pictures."""

    def __init__(self, folder: Path, resume_step: int | None = None) -> None:
        # Loaded here since it takes a second.
        from torch.utils.tensorboard.writer import SummaryWriter

        self._board = SummaryWriter(str(folder), purge_step=None if resume_step is None else resume_step + 1)

    def config(self, values: Mapping[str, Any]) -> None:
        """The config under the tab Text."""
        text = json.dumps(dict(values), indent=2)
        self._board.add_text("config", "".join(f"    {line}\n" for line in text.splitlines()))

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """A point per value."""
        for tag, value in values.items():
            self._board.add_scalar(tag, value, step)

    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        """An animated GIF under the tab Images, which is how TensorBoard shows films."""
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]

        height, width, _ = frames[0].shape
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=_gif(frames, fps))
        assert self._board.file_writer is not None
        self._board.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    def flush(self) -> None:
        """Also hand buffered points to the system."""
        self._board.flush()

    def close(self) -> None:
        """Close the file."""
        self._board.close()


class WandbWriter(Writer):
    """A run of Weights & Biases; the project is ``WANDB_PROJECT``, or ``bidex-meta``.

    Its id is kept in the run folder, so that a resumed run goes on there. Environment steps are the metric
    ``env_steps``, since its own steps may only rise, and a resumed run begins before the last one.
    """

    def __init__(self, folder: Path, resume_step: int | None = None) -> None:
        import os

        self._wandb, file = _wandb(), folder / "wandb-id"
        if not file.exists():
            file.write_text(uuid.uuid4().hex)
        project = os.environ.get("WANDB_PROJECT", "bidex-meta")
        name = "/".join(folder.resolve().parts[-3:])
        self._run = self._wandb.init(
            project=project, id=file.read_text().strip(), name=name, dir=str(folder), resume="allow"
        )
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    def config(self, values: Mapping[str, Any]) -> None:
        """The config of the run."""
        self._run.config.update(dict(values), allow_val_change=True)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """A row."""
        self._run.log({**values, "env_steps": step})

    def film(self, tag: str, path: Path, frames: Sequence[np.ndarray], fps: float, step: int) -> None:
        """The file."""
        self._run.log({tag: self._wandb.Video(str(path), format="mp4"), "env_steps": step})

    def close(self) -> None:
        """End the run."""
        self._run.finish()


LOGGERS = {"tensorboard": TensorBoardWriter, "wandb": WandbWriter, "none": Writer}


def _wandb() -> Any:
    try:
        return import_module("wandb")
    except ImportError:
        raise BidexError("--logger wandb needs wandb: pip install 'bidex-meta[wandb]'. Or use tensorboard.") from None


def _gif(frames: Sequence[np.ndarray], fps: float) -> bytes:
    import io

    from PIL import Image

    out = io.BytesIO()
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(out, "GIF", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)
    return out.getvalue()
