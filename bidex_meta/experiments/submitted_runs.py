"""The runs of a leaderboard entry: their policies, their track, and what the entry states about them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.entries import MULTI_TASK, Track
from bidex_meta.evaluation.leaderboard import content_digest
from bidex_meta.experiments.conditions import check_worlds_of
from bidex_meta.experiments.learners import learner_class
from bidex_meta.experiments.metatest import check_worlds
from bidex_meta.experiments.policies import fitting, load_checkpoint
from bidex_meta.runs import RunFolder, training_seconds
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.checkpoints import weights_digest
from bidex_meta.runs.provenance import check_alike
from bidex_meta.runs.versions import git_state
from bidex_meta.training.learner import Capability
from bidex_meta.utils.files import portable, read_json
from bidex_meta.worlds import open_worlds


@dataclass(frozen=True)
class SubmittedRun:
    """A run that is submitted."""

    folder: RunFolder
    config: RunConfig[Json]
    state: Json  # the policy's part of the run's checkpoint
    steps: int
    weights: str  # digest of the policy's weights


def track_of(runs: Sequence[SubmittedRun]) -> Track | None:
    """Return the leaderboard's track to which runs belong; None if it cannot be known.

    Runs whose learner does not adapt are in the multi-task track. The others are ``reward-only`` or ``privileged``,
    depending on what they learned from.
    """
    if Capability.ADAPTS not in learner_class(runs[0].config.algo).capabilities:
        return MULTI_TASK
    privileged = [_was_privileged(run.config) for run in runs]
    if True in privileged:
        return "privileged"
    if None in privileged:
        return None
    return "reward-only"


def _was_privileged(config: RunConfig) -> bool | None:
    """Return whether a run was trained with more information than the rewards of its own episodes.

    Further information comes from teachers, demonstrations, data sets, a suite that shows its goals, or the
    ``privileges`` of the learner's class. If the run started from the policy of another run, that run counts too. The
    result is None if that run cannot be found.
    """
    seen = set[str]()
    while True:
        if learner_class(config.algo).privileges or config.teacher or config.demonstrations or config.dataset:
            return True
        if not open_worlds(config.to_json()).hides_goals:
            return True
        if config.start_from is None:
            return False
        try:
            if config.start_from in seen:
                return None
            seen.add(config.start_from)
            config = RunFolder.open(config.start_from).config()
        except BidexError:
            return None


def read_runs(folders: Sequence[RunFolder], *, shipped: bool = True) -> list[SubmittedRun]:
    """Return runs with their policies; raise BidexError if the runs cannot form one entry.

    With ``shipped``, the runs must have been trained on a shipped suite, not on a suite file.
    """
    configs = [folder.config() for folder in folders]
    for folder, config in zip(folders, configs, strict=True):
        if config.suite is None:
            raise BidexError(f"{folder.path} trained on the task {config.task} alone. The leaderboard is of suites.")
        if shipped and config.suite.endswith(".toml"):
            raise BidexError(
                f"{folder.path} trained on {portable(config.suite)}. The leaderboard is for shipped suites."
            )
        if config.points:
            raise BidexError(f"{folder.path} saw clouds of points, which {config.suite} does not show. Leave it out.")
        if run_kind(config) != run_kind(configs[0]):
            raise BidexError(
                f"{folder.path} differs from {folders[0].path} in more than its seed. Submit it separately."
            )
    if len({config.seed for config in configs}) < len(configs):
        raise BidexError("Two of the runs have the same seed. Name one run for each seed.")
    worlds = open_worlds(configs[0].to_json())
    if Capability.ADAPTS in learner_class(configs[0].algo).capabilities:
        check_worlds(worlds, configs[0].algo)
    check_alike(folders)
    for folder in folders:
        check_worlds_of(folder, worlds, "An entry is of the present ones: submit with the versions in versions.json.")
    runs: dict[str, SubmittedRun] = {}
    for folder, config in zip(folders, configs, strict=True):
        state, steps = load_checkpoint(folder, noted=True)
        with fitting(folder.path):
            policy = state["learner"]["policy"]
            digest = weights_digest(policy)
        if digest in runs:
            raise BidexError(
                f"{folder.path} and {runs[digest].folder.path} have equal weights: they are one run. Name it once."
            )
        runs[digest] = SubmittedRun(folder, config, {"learner": {"policy": policy}}, steps, digest)
    return list(runs.values())


def stated(runs: Sequence[SubmittedRun]) -> Json:
    """Return facts that the runs' folders state, but nobody can verify."""
    rows = [_facts(run) for run in runs]
    return {
        "seeds": [run.config.seed for run in runs], "hours": [row[0] for row in rows],
        "device": rows[0][1], "commit": [row[2] for row in rows],
    }  # fmt: skip


def receipt(runs: Sequence[SubmittedRun]) -> Json:
    """Return the digests of the evaluated runs, and the commit of the code that evaluates them."""
    return {
        "weights": [run.weights for run in runs],
        "config": [_config_digest(run.folder) for run in runs],
        "code": commit_of(git_state(Path(__file__).parent)),
    }


def _config_digest(folder: RunFolder) -> str:
    """Return the digest of a run's config, computed from the file ``config.json`` without local paths.

    The file is used because it has no options that were added to this package later; these would change the digest.
    """
    return content_digest(portable(read_json(folder.config_path, "a run's config")))


def _facts(run: SubmittedRun) -> tuple[float, str, str | None]:
    """Return a run's hours of training, its device, and the commit of the code that trained it."""
    versions = run.folder.versions()
    config = run.config
    if config.device.startswith("cuda"):
        gpus = set(versions.get("gpus") or [])
    else:
        gpus = set()
    device = ", ".join(gpus) or f"{config.device}, {config.threads} thread{'s' * (config.threads != 1)}"
    return round(training_seconds(run.folder.metrics()) / 3600.0, 3), device, commit_of(versions.get("git"))


def commit_of(git: Json | None) -> str | None:
    """Return a commit's first ten digits, with + if files differed from the commit; None without a commit."""
    if not git or not git.get("commit"):
        return None
    return git["commit"][:10] + "+" * bool(git.get("dirty"))
