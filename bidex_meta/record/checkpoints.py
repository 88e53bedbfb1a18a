"""Checkpoints: ``step_<N>.pt`` (the last few), ``last.pt`` and ``best.pt``.

Written atomically, read without unpickling code, each with a digest of its content (:mod:`bidex_meta.record.sealing`).
"""

import re
import shutil
import sys
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError, one_line
from bidex_meta.reading import exists, is_file
from bidex_meta.record.atomic import refuse_links, remove_leftovers, write_atomic
from bidex_meta.record.sealing import opened, sealed

_STEP_FILE = re.compile(r"step_(\d{1,18})\.pt", re.ASCII)


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: Where they lie; made by the first ``save``.
        keep: How many ``step_<N>.pt`` are kept. More than one, so that a file damaged after it was written
            (a full disk, a failing one) does not end the run.
    """

    def __init__(self, folder: Path, keep: int = 3):
        self.folder = folder
        self.keep = keep

    @property
    def last(self) -> Path:
        """The newest checkpoint; exists after the first ``save``."""
        return self.folder / "last.pt"

    @property
    def best(self) -> Path:
        """The policy that did best in an evaluation while training; exists if there was one."""
        return self.folder / "best.pt"

    def save(self, state: dict[str, Any], step: int) -> None:
        """Write ``step_<step>.pt`` and ``last.pt``, then forget the oldest.

        Args:
            state: Nested dicts and lists of tensors, numbers and strings; nothing that needs code to be read back.
            step: Environment steps so far; ``load`` returns it.
        """
        import torch

        refuse_links(self.folder)
        self.folder.mkdir(exist_ok=True)
        remove_leftovers(self.folder)
        path, content = self.folder / f"step_{step}.pt", sealed({"step": step, "state": state})
        write_atomic(path, lambda file: torch.save(content, file))
        self._follow(path)

    def finish(self, step: int) -> None:
        """Does what a :meth:`save` that was killed left undone.

        Args:
            step: Of the checkpoint that was loaded. Where a newer one is there, which was then damaged, all stay.
        """
        if not self.folder.is_dir():
            return
        refuse_links(self.folder)
        remove_leftovers(self.folder)
        path = self.folder / f"step_{step}.pt"
        if self.newest_step() != step:
            return
        behind = not exists(self.last) or self.last.stat().st_mtime_ns <= path.stat().st_mtime_ns
        if behind or len(self._step_files()) > self.keep:
            self._follow(path)

    def _follow(self, newest: Path) -> None:
        """Makes ``last.pt`` a copy of the newest, then forgets the oldest."""
        with newest.open("rb") as source:
            write_atomic(self.last, lambda file: shutil.copyfileobj(source, file))
        for old in self._step_files()[self.keep :]:
            old.unlink(missing_ok=True)

    def save_best(self, policy: dict[str, Any], step: int, found: dict[str, float]) -> None:
        """Write ``best.pt``: a policy alone, from which no training continues.

        Args:
            policy: Entry ``learner.policy`` of a checkpoint.
            step: Environment steps so far.
            found: What was found of it; ``found_of_best`` returns it.
        """
        import torch

        refuse_links(self.folder)
        self.folder.mkdir(exist_ok=True)
        remove_leftovers(self.folder)
        content = sealed({"step": step, "state": {"learner": {"policy": policy}}, "found": found})
        write_atomic(self.best, lambda file: torch.save(content, file))

    def found_of_best(self) -> dict[str, float] | None:
        """What was found of the policy in ``best.pt``; None where there is none that can be read."""
        content = _read(self.best, "none is known") if exists(self.best) else None
        return None if content is None else content.get("found")

    def load_one(self, path: Path) -> tuple[dict[str, Any], int]:
        """A certain checkpoint as ``load`` gives it.

        Raises:
            BidexError: There is no such file, or it cannot be read.
        """
        if not is_file(path):
            there = ", ".join(sorted(found.name for found in self.folder.glob("*.pt"))) or "none"
            raise BidexError(f"There is no {path}. Checkpoints in {self.folder}: {there}.")
        try:
            content = opened(path)
        except Exception as error:
            raise BidexError(f"{path} is no checkpoint that can be read ({_reason(error)}). Name another.") from None
        return content["state"], content["step"]

    def newest_step(self) -> int | None:
        """Environment steps of the newest checkpoint, by the names of the files; None where there is none yet."""
        files = self._step_files()
        return int(files[0].stem.removeprefix("step_")) if files else None

    def load(self) -> tuple[dict[str, Any], int] | None:
        """The newest readable checkpoint as ``(state, step)`` with tensors on the CPU; None where there is none yet.

        A damaged file is passed over with a line on stderr, which names the one that is taken in its place.

        Raises:
            BidexError: There are checkpoints, but none of them can be read.
        """
        # last.pt comes last: a process that died between the two renames leaves it older than the newest step_<N>.pt.
        candidates = [path for path in [*self._step_files(), self.last] if exists(path)]
        for path in candidates:
            loaded = _read(path)
            if loaded is not None:
                if path != candidates[0]:
                    print(f"Taking {path}, of {loaded['step']:,} steps.", file=sys.stderr)
                return loaded["state"], loaded["step"]
        if candidates:
            raise BidexError(
                f"None of the {len(candidates)} checkpoints in {self.folder} can be read. Start a new run."
            )
        return None

    def _step_files(self) -> list[Path]:
        """``step_<N>.pt``, newest first."""
        paths = self.folder.iterdir() if self.folder.is_dir() else ()
        found = [(int(match[1]), path) for path in paths if (match := _STEP_FILE.fullmatch(path.name))]
        return [path for _, path in sorted(found, reverse=True)]


def _read(path: Path, then: str = "trying an older one") -> dict[str, Any] | None:
    try:
        return opened(path)
    except Exception as error:  # torch raises a dozen kinds for a damaged file; each means "try the one before"
        print(f"Checkpoint {path} cannot be read ({_reason(error)}); {then}.", file=sys.stderr)
        return None


def _reason(error: Exception) -> str:
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + one_line(error)[:100].rstrip(".")
