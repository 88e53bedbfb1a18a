"""What a training run experiences, recorded beside it: killed and resumed, each episode is there once."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bidex_meta.data import part_files
from bidex_meta.data.episode_recorder import EpisodeRecorder
from bidex_meta.data.writer import DatasetWriter
from bidex_meta.errors import BidexError
from bidex_meta.record.atomic import write_json
from bidex_meta.world.contract import VectorWorld

_KEY = "recorder"


class RunRecorder(EpisodeRecorder):
    """Records the world of a learner.

    A checkpoint asks for the world's state: what was recorded until then becomes a part, and the state tells how many
    parts there are and which episodes run. A run that goes on from it deletes the parts that it does not know, and
    plays, and records, them again.

    Args:
        world: In either autoreset mode.
        rows: Which rows to record.
        process: Number of this process.

    Attributes:
        folder: The data set's folder: set by ``open``, or before ``load_state_dict``, which opens it.
    """

    folder: Path
    writer: DatasetWriter

    def __init__(self, world: VectorWorld, rows: Sequence[int], process: int = 0) -> None:
        self.process = process
        super().__init__(world, lambda episode: self.writer.add(episode), rows)

    def open(self, folder: Path, parts: int = 0) -> None:
        """Says where to record, before the first reset; parts of this process from a number on are deleted there."""
        self.folder = folder
        self.writer = DatasetWriter(folder, self.process, keep=parts)
        if self.process == 0:  # no complete data set any longer
            write_json(folder / "data" / part_files.RECORDING, {"run": folder.parent.name})
            (folder / "data" / part_files.METADATA).unlink(missing_ok=True)

    def state_dict(self) -> dict[str, Any]:
        """The world's state, and where the recording stands; what was recorded is on the disk then."""
        self.writer.left_out.update(self.left_out)
        self.left_out.clear()
        self.writer.commit()
        return {**self.world.state_dict(), _KEY: {"parts": self.writer.parts, **self.recorder_state()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from ``state_dict``.

        Raises:
            BidexError: Nothing was recorded then, or the parts that were are gone.
        """
        if _KEY not in state:
            raise BidexError("This checkpoint was saved without a recording. Start a new run to record one.")
        own = dict(state[_KEY])
        self.world.load_state_dict({name: value for name, value in state.items() if name != _KEY})
        parts = int(own.pop("parts"))
        if "writer" in self.__dict__:
            self.writer.close()
        self.open(self.folder, parts)
        self.load_recorder_state(own)

    def close(self) -> None:
        """Forgets what no checkpoint knows, and frees the world."""
        if "writer" in self.__dict__:
            self.writer.close()
        super().close()


def spread_rows(world: VectorWorld, share: float) -> list[int]:
    """A share of a world's rows, evenly over its slots, at least one of each.

    Args:
        world: The world.
        share: Above 0; 1 or more are all rows.
    """
    chosen: list[int] = []
    slots = world.task_id.tolist()
    for slot in range(world.num_tasks):
        rows = [row for row, own in enumerate(slots) if own == slot]
        count = min(len(rows), max(1, round(share * len(rows))))
        chosen += [rows[number * len(rows) // count] for number in range(count)]
    return chosen
