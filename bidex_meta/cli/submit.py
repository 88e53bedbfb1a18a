"""``bidex-meta submit``: write a leaderboard entry for runs, or for the meta-test of an agent that is not a run."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import Device, RunPaths, parse
from bidex_meta.cli.tables import Sheet, percent, print_table
from bidex_meta.errors import EXIT_FAILED, BidexError, shortened
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL
from bidex_meta.evaluation.entries import AdaptationTrack
from bidex_meta.evaluation.leaderboard import read_entry, success_iqm
from bidex_meta.experiments.submitting import check, submit, submit_agent
from bidex_meta.experiments.submitting_transfer import check_transfer, submit_transfer
from bidex_meta.runs import RunFolder
from bidex_meta.utils.validation import Few


@dataclass(frozen=True)
class SubmitFlags:
    """Write a leaderboard entry for runs, or for the stored meta-test of an agent that is not a run.

    Example: bidex-meta submit runs/MT20/mtppo/* --tuning 12x1

    The command evaluates runs on their own tasks and on the same number of new tasks. The runs may differ only in the
    seed. The results of a stored meta-test are entered without verification.
    """

    runs: RunPaths  # Run folders, one for each seed.
    tuning: str | None = None  # Number of settings that you tried, x seeds of each; 1x1: only the submitted settings.
    check: Path | None = None  # Play the runs of this entry again and compare; writes nothing.
    transfer: Path | None = None
    """Folder of `bidex-meta transfer` for the run, to rank how much its policy helps on held-out classes."""
    evaluation: Path | None = None  # Instead of runs: the file of a meta-test, from meta_test(agent, suite).save(FILE).
    track: AdaptationTrack | None = None
    """With --evaluation: data that the agent was trained on. reward-only: rewards of its own episodes; privileged: also
    teachers, hidden parts of tasks or rewards of other goals."""
    name: str | None = None  # Name on the leaderboard; None: the algorithm, or the class of the agent.
    out: Path = Path("results/leaderboard")  # Folder of leaderboard entries to write to.
    episodes: Few | None = None  # Episodes of each task; None: 1, and for learners that adapt 10 after each shot.
    device: Device = "auto"


def main(arguments: Sequence[str]) -> None:
    """Check the flags, then write a leaderboard entry or check an existing one, and print the result."""
    flags = parse(SubmitFlags, arguments, "submit")
    if flags.runs and flags.evaluation is not None:
        raise BidexError("Expected run folders or --evaluation, got both. Submit them separately.")
    if not flags.runs and flags.evaluation is None:
        raise BidexError("Expected run folders to submit, got none. Name them: bidex-meta submit runs/MT20/mtppo/*")
    if flags.track is not None and flags.evaluation is None:
        raise BidexError("--track is for --evaluation: a run's track comes from its learner. Leave it out.")
    if flags.transfer is not None and len(flags.runs) != 1:
        raise BidexError(f"--transfer: expected one run, whose policy was transferred, got {len(flags.runs)}.")
    if flags.check is not None:
        _check(flags, flags.check)
        return
    tuning = _tuning(flags.tuning)
    if flags.evaluation is not None:
        path = submit_agent(flags.evaluation, flags.out, name=flags.name, track=flags.track, tuning=tuning)
    elif flags.transfer is not None:
        path = submit_transfer(
            _folders(flags)[0], flags.transfer, flags.out, name=flags.name, tuning=tuning,
            episodes=flags.episodes or 1, device=flags.device,
        )  # fmt: skip
    else:
        path = submit(
            _folders(flags), flags.out, name=flags.name, tuning=tuning, episodes=flags.episodes,
            device=flags.device,
        )  # fmt: skip
    entry = read_entry(path)
    success = success_iqm(entry.result).text(100.0, " %")
    print(f"{path}: {entry.track}, success on new tasks, IQM {success}{'' if entry.verified else ', not verified'}")


def _tuning(text: str | None) -> tuple[int, int]:
    """Return how many settings the submitter has tried, and with how many seeds each, from a text such as ``12x1``."""
    numbers = re.fullmatch(r"([1-9]\d{0,8})x([1-9]\d{0,8})", text or "")
    if numbers is None:
        raise BidexError(
            "--tuning: expected the number of settings that you tried before you chose these, times the seeds of each, "
            f"got {shortened(text) if text else 'none'}. For example: --tuning 12x1, or 1x1 if you tried no others."
        )
    return int(numbers[1]), int(numbers[2])


def _folders(flags: SubmitFlags) -> list[RunFolder]:
    return [RunFolder.open(path) for path in flags.runs]


def _check(flags: SubmitFlags, path: Path) -> None:
    """Evaluate the runs of an existing entry again, and print the differences and the verdict.

    Raises SystemExit with code 1 if something differs.
    """
    if not flags.runs or (flags.tuning, flags.name, flags.episodes) != (None, None, None):
        raise BidexError("--check takes an entry, its runs and --device, and all else from the entry. Leave it out.")
    if flags.transfer is not None:
        found = check_transfer(path, _folders(flags)[0], flags.transfer, flags.device)
    else:
        found = check(path, _folders(flags), flags.device)
    table = Sheet(["task", "outcome", "success", "again"], "Results that are not equal")
    for each in found.classes:
        if each.outcome != EQUAL:
            table.add(each.name, each.outcome, percent(each.recorded.success), percent(each.again.success))
    if table.rows:
        print_table(table)
    verdict = {EQUAL: "equal", DIFFERS: "different"}.get(found.outcome, "within the interval")
    print(f"{path}: {verdict}{''.join(f', {name} differs' for name in found.different)}")
    if found.outcome == DIFFERS:
        raise SystemExit(EXIT_FAILED)
