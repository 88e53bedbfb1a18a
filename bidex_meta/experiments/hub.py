"""Helpers of ``bidex-meta push`` and ``pull``, which publish and fetch folders on the Hugging Face Hub.

They choose and check the files of a folder, remove local paths from them, and call ``huggingface_hub``.
"""

import contextlib
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bidex_meta.data import Dataset, open_dataset, part_files, seals
from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import TEMPORARY_SUFFIX, refuse_links
from bidex_meta.utils.files import absolute, exists, is_file, portable, read_json

FOLDER = "folder:"
"""Prefix of a name that is a folder of this machine, not a repository of the Hugging Face Hub."""
DATASETS = "datasets/"
"""Prefix of the name of a data set's repository, as in the hub's addresses."""
ONNX = "policy.onnx"
OF_A_RUN = ("config.json", "versions.json", "evaluation.json", "metrics.jsonl", ONNX, "checkpoints/*.pt")
OF_DATA = ("data/metadata.json", "data/*.hdf5")
SUITES = "*.toml"
"""Pattern of users' own suite files; such a file is published with the run that was trained on the suite."""
CARD = "README.md"
_METADATA = f"data/{part_files.METADATA}"
Files = Mapping[str, Path | bytes]
"""Published files by their path within the folder; a value is a file's path, or the file's content."""


def files_of(folder: Path, patterns: tuple[str, ...], root: Path | None = None) -> dict[str, Path]:
    """Return the files of a folder that match ``patterns``, by their path relative to the folder.

    These files are published or fetched. Raises BidexError if one is a link to a file outside ``root`` (by default the
    folder itself), because such a file does not belong to the folder that the user named.
    """
    root = absolute(root or folder)
    files = {}
    for pattern in patterns:
        for path in sorted(folder.glob(pattern)):
            if not absolute(path).is_relative_to(root):
                raise BidexError(f"Expected a file in {folder}, got {path}, which leads out of it. Put the file there.")
            if path.is_file():
                files[path.relative_to(folder).as_posix()] = path
    return files


def checked(folder: Path) -> RunFolder | Dataset:
    """Check a folder before it is published, and return the run or data set that it holds.

    All files that would be published are read. Raises BidexError if one cannot be read by ``bidex-meta evaluate`` (for
    a run) or ``bidex-meta data info`` (for a data set).
    """
    if is_file(folder / _METADATA):
        from bidex_meta.data.checking import coverage, summary

        dataset = open_dataset(folder)
        dataset.check_digests()
        summary(dataset)
        coverage(dataset)
        return dataset
    run = RunFolder.open(folder)
    run.config()
    run.versions()
    if exists(run.evaluation_path):
        run.evaluation()
    for path in files_of(folder, ("checkpoints/*.pt",)).values():
        run.checkpoints.load_one(path)
    return run


def published(folder: Path, files: Mapping[str, Path]) -> dict[str, Path | bytes]:
    """Prepare the files of a checked folder for publication; return their paths or new content by name.

    Paths of this machine are removed from JSON files. If the run was trained on a user's suite file, this file is
    added.
    """
    content: dict[str, Path | bytes] = dict(files)
    for name in files.keys() & {"config.json", "versions.json", "evaluation.json"}:
        found = read_json(files[name], "a file of a run")
        if name == "config.json" and is_file(suite := Path(found["suite"] or "")):
            content[suite.name] = suite
        if portable(found) != found:
            content[name] = (json.dumps(portable(found), indent=2) + "\n").encode()
    if _METADATA in files:
        found = read_json(files[_METADATA], "a data set's metadata")
        if "bidex" in found and portable(found) != found:
            content[_METADATA] = seals.sealed_text(portable(found), portable(found["bidex"]))
    return content


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder next to ``path``; if the block succeeds, rename this folder to ``path``.

    If an earlier process was killed in such a block, the temporary folder that it left is deleted. Raises BidexError if
    ``path`` exists and is not empty, or if another process is writing it.
    """
    if exists(path) and not (path.is_dir() and not any(path.iterdir())):
        raise BidexError(f"{path} exists and is not empty. Name another, or delete it.")
    missing = [above for above in path.parents if not exists(above)]
    temporary = path.with_name(f".{path.name}{TEMPORARY_SUFFIX}")
    refuse_links(temporary)
    temporary.mkdir(parents=True, exist_ok=True)
    try:
        with RunFolder(temporary).locked(f"Another process writes {path}. Wait for its end, or name another."):
            shutil.rmtree(temporary)
            temporary.mkdir()
            yield temporary
            if exists(path):
                path.rmdir()
            temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with contextlib.suppress(OSError):  # the folder is not empty
            for above in missing:
                above.rmdir()


def copied(files: Files, folder: Path) -> None:
    """Write files into a folder, and force them to the disk."""
    for name, source in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            if isinstance(source, bytes):
                file.write(source)
            else:
                with source.open("rb") as content:
                    shutil.copyfileobj(content, file)
            file.flush()
            os.fsync(file.fileno())


def library() -> Any:
    """Return the module ``huggingface_hub``; raise BidexError if it is missing."""
    try:
        import huggingface_hub
    except ImportError:
        raise BidexError(
            f"The hub needs huggingface_hub: pip install 'bidex-meta[hub]'. {FOLDER}PATH does not."
        ) from None
    # The library reports each attempt.
    logging.getLogger("huggingface_hub").setLevel(logging.CRITICAL)
    return huggingface_hub


def called(function: str, name: str, **options: Any) -> Any:
    """Call a function of ``huggingface_hub`` on a repository; turn its errors into a BidexError of one line.

    ``name`` is the repository; names of data sets begin with ``datasets/``. ``options`` are further arguments of the
    function.
    """
    if name.startswith(DATASETS):
        kind = "dataset"
    else:
        kind = "model"
    try:
        return getattr(library(), function)(name.removeprefix(DATASETS), repo_type=kind, **options)
    except BidexError:
        raise
    except Exception as error:  # errors of the library and of its transports have no common base class
        raise BidexError(
            f"{name}: {type(error).__name__}, {one_line(error)[:200]} Fix the name or the network, log in by "
            f"`hf auth login`, or use {FOLDER}PATH."
        ) from error
