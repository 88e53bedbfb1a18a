"""Checkpoints ``step_<N>.pt``, ``last.pt`` and ``best.pt``; written atomically, read without executing code.

Each file has a format number and a digest of all its numbers and tensors: ``torch.load`` checks no checksum, so it
would load a flipped bit as another weight.
"""

import contextlib
import hashlib
import re
import shutil
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.runs.atomic import Json, refuse_links, remove_leftovers, room_for, write_atomic
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import exists, is_file, open_regular
from bidex_meta.utils.validation import Whole

State = Json  # nested dicts and lists of tensors, numbers and strings, which can be read without running code
_STEP_FILE = re.compile(r"step_(\d{1,18})\.pt", re.ASCII)
FORMAT = 2  # raised when older code can no longer read a checkpoint
_DEEPEST = 100


@checked_arguments
@dataclass(frozen=True)
class Checkpoints:
    """The checkpoints of one run."""

    folder: Path  # created by the first ``save``
    keep: Whole = 3  # number of ``step_<N>.pt`` that are kept: several, in case one is damaged

    @property
    def last(self) -> Path:
        """Return the path of the newest checkpoint, which exists after the first ``save``."""
        return self.folder / "last.pt"

    @property
    def best(self) -> Path:
        """Return the path of the policy with the best evaluation during training; the file may not exist."""
        return self.folder / "best.pt"

    @checked_arguments
    def save(self, state: State, step: Whole) -> None:
        """Write ``step_<step>.pt`` and ``last.pt`` after ``step`` environment steps, then delete the oldest ones."""
        path = self.folder / f"step_{step}.pt"
        self._write(path, {"step": step, "state": state})
        self._follow(path)

    @contextlib.contextmanager
    def room(self, size: int) -> Iterator[None]:
        """Reserve disk space for the first checkpoint, so that saving it cannot fail for lack of space.

        ``size`` is the checkpoint's size in bytes. The space is reserved until the checkpoint is saved. Raises
        BidexError if there is not enough space.
        """
        refuse_links(self.folder)
        self.folder.mkdir(exist_ok=True)
        with room_for(self.folder, size, count=2):  # ``step_<N>.pt`` and ``last.pt``
            yield

    def finish(self, step: int) -> None:
        """Complete a :meth:`save` during which the process was killed.

        ``step`` is the step of the checkpoint that was loaded. A checkpoint with a later step could not be loaded
        because it is damaged. If there is such a checkpoint, no checkpoint is changed or deleted.
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

    def _write(self, path: Path, content: State) -> None:
        refuse_links(self.folder)
        self.folder.mkdir(exist_ok=True)
        remove_leftovers(self.folder)
        content = {**content, "format": FORMAT, "digest": _digest(content)}
        write_atomic(path, lambda file: _torch().save(content, file))

    def _follow(self, newest: Path) -> None:
        """Copy the newest checkpoint to ``last.pt``, then delete the oldest ones."""
        with newest.open("rb") as source:
            write_atomic(self.last, lambda file: shutil.copyfileobj(source, file))
        for old in self._step_files()[self.keep :]:
            old.unlink(missing_ok=True)

    @checked_arguments
    def save_best(self, policy: State, step: int, results: dict[str, float]) -> None:
        """Write ``best.pt``, which holds only a policy (entry ``learner.policy`` of a checkpoint) and its results."""
        self._write(self.best, {"step": step, "state": {"learner": {"policy": policy}}, "found": results})

    def found_of_best(self) -> dict[str, float] | None:
        """Return the results of the policy in ``best.pt``; None if there is no readable file."""
        content = _read(self.best, "none is known") if exists(self.best) else None
        if content is None:
            return None
        return content.get("found")

    @checked_arguments
    def load_one(self, path: Path) -> tuple[State, int]:
        """Load one given checkpoint, in the form of ``load``; raises BidexError if it is missing or unreadable."""
        if not is_file(path):
            there = ", ".join(sorted(path.name for path in self.folder.glob("*.pt"))) or "none"
            raise BidexError(f"There is no {path}. Checkpoints in {self.folder}: {there}.")
        try:
            content = _opened(path)
        except Exception as error:
            raise BidexError(f"{path} is not a readable checkpoint ({_reason(error)}). Name another.") from None
        return content["state"], content["step"]

    def newest_step(self) -> int | None:
        """Return the environment steps of the newest checkpoint, read from its file name; None if there is none yet."""
        files = self._step_files()
        if files:
            return int(files[0].stem.removeprefix("step_"))
        return None

    def load(self) -> tuple[State, int] | None:
        """Load the newest readable checkpoint as ``(state, step)``, tensors on the CPU; None if there is none yet.

        A damaged file is skipped with a line on stderr that names the file used instead. Raises BidexError if no
        checkpoint can be read.
        """
        # last.pt is renamed last: if the process dies between the two renames, last.pt is older than the newest
        # step_<N>.pt.
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
        """Return the paths ``step_<N>.pt``, newest first."""
        if self.folder.is_dir():
            paths = self.folder.iterdir()
        else:
            paths = ()
        numbered = [(int(match[1]), path) for path in paths if (match := _STEP_FILE.fullmatch(path.name))]
        return [path for _, path in sorted(numbered, reverse=True)]


def _torch():
    import torch  # imported here, so that `bidex-meta list` starts without torch

    return torch


def _read(path: Path, then: str = "trying an older one") -> State | None:
    try:
        return _opened(path)
    # Torch raises a dozen kinds of errors for a damaged file; each means "try the one before".
    except Exception as error:
        print(f"Checkpoint {path} cannot be read ({_reason(error)}); {then}.", file=sys.stderr)
        return None


def _reason(error: Exception) -> str:
    if isinstance(error, ValueError):
        kind = ""
    else:
        kind = f"{type(error).__name__}: "
    return kind + one_line(error)[:100].rstrip(".")


def _opened(path: Path) -> State:
    """Read and check a checkpoint file; return its content, which has at least ``step`` and ``state``.

    Raises BidexError for another format version, ValueError for wrong content, and many kinds of errors of torch for a
    damaged file.
    """
    with open_regular(path, "a checkpoint") as file:
        _check_archive(file)
        # With weights_only, another person's checkpoint cannot run code.
        content = _torch().load(file, map_location="cpu", weights_only=True)
    if not isinstance(content, dict) or not isinstance(content.get("state"), dict):
        raise ValueError("it holds no training's state")
    if type(content.get("step")) is not int or content["step"] < 0:
        raise ValueError(f"its step is {shortened(content.get('step'))}, no whole number")
    version = content.pop("format", None)
    digest = content.pop("digest", None)
    if type(version) is not int or version != FORMAT:
        raise BidexError(f"its format is {shortened(version)}, not {FORMAT}")
    if digest != _digest(content):
        raise ValueError("its content does not have the digest it was saved with")
    return content


def _check_archive(file: IO[bytes]) -> None:
    """Raise an error if a checkpoint's zip archive is damaged or has a compressed part.

    torch stores parts uncompressed. A compressed part could be much larger in memory than the file.
    """
    with zipfile.ZipFile(file) as archive:
        for part in archive.infolist():
            if part.compress_type != zipfile.ZIP_STORED or part.file_size != part.compress_size:
                raise ValueError(f"its part {shortened(part.filename)} is compressed")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"its part {shortened(damaged)} does not have its checksum")
    file.seek(0)


def weights_digest(policy: State) -> str:
    """Return a digest of a policy's tensors, 32 hexadecimal digits, which is equal for copies of one run.

    Numbers are rounded to half precision, in which published policies are stored.
    """
    return _digest({"weights": _halved(policy.get("weights", policy))})[:32]


def _halved(value: object) -> object:
    if isinstance(value, dict):
        return {name: _halved(part) for name, part in sorted(value.items())}
    torch = _torch()
    if isinstance(value, torch.Tensor) and value.is_floating_point():
        return value.to(torch.float16)
    return value


def _digest(content: State) -> str:
    digest = hashlib.blake2b(digest_size=32)
    _feed(content, digest, 0)
    return digest.hexdigest()


def _feed(value: object, digest: "hashlib.blake2b", depth: int) -> None:
    """Feed a hash with a value, its type and its shape, so that different contents give different hashes."""
    torch = _torch()
    if depth > _DEEPEST:
        raise ValueError(f"it is nested more than {_DEEPEST} deep")
    if isinstance(value, torch.Tensor):
        digest.update(f"tensor {value.dtype} {tuple(value.shape)}:".encode())
        flat = value.detach().cpu().contiguous()
        # A single number can have any stride, but a view as bytes requires stride 1.
        flat = flat.as_strided((flat.numel(),), (1,))
        digest.update(flat.view(torch.uint8).numpy().data)
    elif isinstance(value, dict):
        digest.update(f"dict {len(value)}:".encode())
        for name, entry in value.items():
            _feed(name, digest, depth + 1)
            _feed(entry, digest, depth + 1)
    elif isinstance(value, list | tuple):
        digest.update(f"{'list' if isinstance(value, list) else 'tuple'} {len(value)}:".encode())
        for entry in value:
            _feed(entry, digest, depth + 1)
    else:
        # repr writes every bit of a float, except for NaN.
        if isinstance(value, bytes):
            content = value
        else:
            content = repr(value).encode()
        digest.update(f"{type(value).__name__} {len(content)}:".encode())
        digest.update(content)
