"""What ``bidex-meta push`` and ``pull`` share: names, the files of a folder, and the hub's library."""

import shutil
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError, one_line
from bidex_meta.utils.files import exists

FOLDER = "folder:"
"""Begins a name that is no repository of the Hugging Face Hub but a folder of this machine."""
DATASETS = "datasets/"
"""Begins the name of a data set's repository, as in the hub's addresses."""
OF_A_RUN = ("config.json", "versions.json", "evaluation.json", "metrics.jsonl", "policy.onnx", "checkpoints/*.pt")
OF_DATA = ("data/metadata.json", "data/*.hdf5")
CARD = "README.md"


def files_of(folder: Path, patterns: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder that are published, by their path within it."""
    found = [path for pattern in patterns for path in sorted(folder.glob(pattern)) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path for path in found}


def copied(files: dict[str, Path], folder: Path) -> None:
    """Copies files into a folder; BidexError where it holds something."""
    if exists(folder) and not (folder.is_dir() and not any(folder.iterdir())):
        raise BidexError(f"{folder} exists and is not empty. Name another, or delete it.")
    for name, path in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)


def library() -> Any:
    """The module ``huggingface_hub``; BidexError where it is missing."""
    try:
        import huggingface_hub
    except ImportError:
        raise BidexError(
            f"The hub needs huggingface_hub: pip install 'bidex-meta[hub]'. {FOLDER}PATH does not."
        ) from None
    return huggingface_hub


def called(function: str, name: str, **options: Any) -> Any:
    """Calls the library for a repository, ``datasets/`` before the name of a data set; its errors as one line."""
    kind = "dataset" if name.startswith(DATASETS) else "model"
    try:
        return getattr(library(), function)(name.removeprefix(DATASETS), repo_type=kind, **options)
    except (OSError, ValueError, RuntimeError) as error:  # the library's own are all of these
        raise BidexError(
            f"{name}: {type(error).__name__}, {one_line(error)[:200]} Mend the name or the network, log in by "
            f"`hf auth login`, or use {FOLDER}PATH."
        ) from error
