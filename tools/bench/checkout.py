"""Which code ``bench world --against`` names: a folder, a commit, or that of an earlier run's file."""

import contextlib
import io
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.reading import is_file, read_json

HERE = Path(__file__).resolve().parents[2]
"""Where this code runs from: a checkout, or the site-packages that it is installed in."""


def recorded(against: str) -> tuple[str, dict[str, float]]:
    """What to measure against, and where an earlier run's file was given the ratios that it found."""
    if not is_file(Path(against)):
        return against, {}
    try:
        found = read_json(Path(against), "what bench world --against wrote")
        commit, ratios = found["old"], {row["what"]: float(row["ratio"]) for row in found["table"]}
        if commit["dirty"] or not commit["commit"]:
            raise ValueError
    except (ValueError, KeyError, TypeError):
        raise BidexError(
            f"--against {against}: expected the file that bench world --against COMMIT --out FILE wrote, measured "
            "against a commit. Give a commit, a folder with a checkout, or such a file."
        ) from None
    return commit["commit"], ratios


@contextlib.contextmanager
def checkout(against: str) -> Iterator[Path]:
    """The folder of the other code; a commit is unpacked for as long as the block lasts."""
    with tempfile.TemporaryDirectory(prefix="bidex-meta-") as unpacked:
        folder = Path(against).resolve()
        if not folder.is_dir():
            folder = Path(unpacked).resolve()
            with tarfile.open(fileobj=io.BytesIO(_git(against, "archive", commit_name(against) or ""))) as archive:
                archive.extractall(folder, filter="data")
        if not (folder / "bidex_meta" / "__init__.py").is_file():
            raise BidexError(f"--against {against}: expected a checkout of bidex-meta, found no bidex_meta/ in it.")
        yield folder


def commit_name(against: str) -> str | None:
    """The full name of a commit; None for a folder that git does not know."""
    if Path(against).is_dir():
        return None
    return _git(against, "rev-parse", "--verify", "--end-of-options", f"{against}^{{commit}}").decode().strip()


def _git(against: str, *arguments: str) -> bytes:
    try:
        return subprocess.run(["git", *arguments], cwd=HERE, capture_output=True, check=True).stdout
    except subprocess.CalledProcessError as error:
        said = " ".join(error.stderr.decode(errors="replace").split())
    except OSError as error:
        said = str(error)
    raise BidexError(
        f"--against {against}: expected a folder with a checkout of bidex-meta, a file that --out wrote, or a commit "
        f"of the git checkout in {HERE}, got none of these ({said})."
    ) from None
