"""``bidex-meta submit``: write an entry of the leaderboard, of runs or of a meta-test that was played elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import Device, RunPaths, parse
from bidex_meta.cli.tables import meta_test_table, print_table
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.leaderboard import Track, read_entry, read_trial_entry, success_iqm
from bidex_meta.experiments.submitting import submit, submit_trials
from bidex_meta.runs import RunFolder
from bidex_meta.utils.validation import Few


@dataclass(frozen=True)
class SubmitFlags:
    """Write the leaderboard's entry of runs, played on their suite's tasks and on as many others, or of a meta-test.

    Example: bidex-meta submit runs/MT20/mtppo/*

    The runs differ in nothing but the seed. A meta-test of an agent that is no run is taken as it is, not verified.
    """

    runs: RunPaths  # Run folders, a seed each.
    evaluation: Path | None = None  # Instead of runs: the file of a meta-test, from meta_test(agent, suite).save(FILE).
    track: Track | None = None
    """Training of the agent of --evaluation: reward-only (rewards of its own episodes) or privileged (also teachers,
    hidden parts of tasks or rewards of other goals)."""
    name: str | None = None  # Name on the leaderboard; None: the algorithm, or the agent's class.
    out: Path = Path("results/leaderboard")  # Folder of entries.
    episodes: Few = 1  # Of each task.
    device: Device = "auto"


def main(arguments: Sequence[str]) -> None:
    """Check, play, write, print."""
    flags = parse(SubmitFlags, arguments, "submit")
    if flags.evaluation is not None:
        _submit_trials(flags, flags.evaluation)
        return
    if not flags.runs:
        raise BidexError("Expected run folders to submit, got none. Name them: bidex-meta submit runs/MT20/mtppo/*")
    if flags.track is not None:
        raise BidexError("--track is for --evaluation. Leave it out.")
    folders = [RunFolder.open(path) for path in flags.runs]
    path = submit(folders, flags.out, name=flags.name, episodes=flags.episodes, device=flags.device)
    entry = read_entry(path)
    own, others = (success_iqm(entry.success(part)).text(100.0, " %") for part in (entry.own, entry.others))
    print(f"{path}: success, IQM {own}, on other tasks {others}")


def _submit_trials(flags: SubmitFlags, evaluation: Path) -> None:
    """Write the entry of a meta-test and print its table."""
    if flags.runs:
        raise BidexError("Expected run folders or --evaluation, got both. Submit them apart.")
    path = submit_trials(evaluation, flags.out, name=flags.name, track=flags.track)
    entry = read_trial_entry(path)
    title = f"{entry.name} on {entry.evaluation.suite}, {entry.track}, not verified"
    print_table(meta_test_table(title, entry.evaluation.splits["test"]))
    print(path)
