"""``bidex-meta submit``: write an entry of the leaderboard, verified by playing the runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import Device, RunPaths, parse
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.leaderboard import read_entry, success_iqm
from bidex_meta.experiments.submitting import submit
from bidex_meta.runs import RunFolder
from bidex_meta.utils.validation import Few


@dataclass(frozen=True)
class SubmitFlags:
    """Play runs of a suite, on its own tasks and on as many others, and write the leaderboard's entry.

    Example: bidex-meta submit runs/MT20/mtppo/*

    The runs differ in nothing but the seed.
    """

    runs: RunPaths  # Run folders, a seed each.
    name: str | None = None  # What the leaderboard calls them; None: the algorithm.
    out: Path = Path("results/leaderboard")  # Folder of entries.
    episodes: Few = 1  # Of each task.
    device: Device = "auto"


def main(arguments: Sequence[str]) -> None:
    """Check, play, write, print."""
    flags = parse(SubmitFlags, arguments, "submit")
    if not flags.runs:
        raise BidexError("Expected run folders to submit, got none. Name them: bidex-meta submit runs/MT20/mtppo/*")
    folders = [RunFolder.open(path) for path in flags.runs]
    path = submit(folders, flags.out, name=flags.name, episodes=flags.episodes, device=flags.device)
    entry = read_entry(path)
    own, others = (success_iqm(entry.success(part)).text(100.0, " %") for part in (entry.own, entry.others))
    print(f"{path}: success, IQM {own}, on other tasks {others}")
