"""Where a data set goes, how it is called, and whether there is room."""

import re
import shutil
from pathlib import Path

from bidex_meta.data.dataset import data_folder, valid_name
from bidex_meta.errors import BidexError
from bidex_meta.outside import short_name
from bidex_meta.reading import exists, expanded

_MARGIN = 1.05
"""What file systems take beside the files."""


def default_name(subject: str, kind: str) -> str:
    """The name of a new data set: ``CatchUnderarm/random-v0``.

    Args:
        subject: A suite, a suite file's path, or a class.
        kind: ``random``, ``medium``, ...
    """
    words = [re.sub(r"[^\w-]+", "-", word) for word in subject.split("/")]
    if subject.endswith(".toml"):
        words = [re.sub(r"[^\w-]+", "-", Path(subject).stem)]
    if ":" in subject:
        words = [short_name(subject)]
    return f"{'/'.join(words)}/{kind}-v0"


def place_of(out: Path | None, subject: str, kind: str) -> tuple[Path, str]:
    """Folder and name of a new data set.

    Args:
        out: Its folder; None: ``default_name`` in the data folder.
        subject: A suite or a class.
        kind: ``random``, ``medium``, ...
    """
    root, usual = data_folder(), default_name(subject, kind)
    if out is None:
        return root / usual, usual
    folder = expanded(out)
    try:
        name = folder.resolve().relative_to(root.resolve()).as_posix()
    except (ValueError, RuntimeError):  # not below it, or a loop of links
        name = "/".join(folder.parts[-2:])
    return folder, next((n for n in (name, folder.name, usual) if valid_name(n)), usual)


def check_room(folder: Path, needed: int, told: str) -> None:
    """Refuses what does not fit on the disk.

    Args:
        folder: Where it goes; folders above it may be missing.
        needed: Bytes.
        told: What takes them.

    Raises:
        BidexError: There are fewer.
    """
    there = next(above for above in (folder.absolute(), *folder.absolute().parents) if exists(above))
    free = shutil.disk_usage(there).free
    if needed * _MARGIN > free:
        raise BidexError(
            f"{told} would take about {needed / 1e9:,.1f} GB, and {free / 1e9:,.1f} are free at {there}. Lower --size, "
            "or name another place by --out."
        )
