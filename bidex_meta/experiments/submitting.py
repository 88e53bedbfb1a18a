"""Entries of the leaderboard, verified by playing the runs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.leaderboard import FORMAT, Track, check_trials, class_rows, entry_name, read_entry
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.experiments.conditions import check_worlds_of, conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.policies import checkpoint, fitting, policy_of
from bidex_meta.runs import RunFolder, training_seconds
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.checkpoints import weights_digest
from bidex_meta.runs.evaluations import Conditions, MetaTestEvaluation, evaluation_json, read_evaluation
from bidex_meta.runs.provenance import check_alike
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.files import exists
from bidex_meta.utils.plugins import short_name
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import open_worlds


def submit(folders: Sequence[RunFolder], out: Path, *, name: str | None, episodes: int, device: str) -> Path:
    """Play runs on their own and on unseen tasks, write the leaderboard's entry, and return its path.

    Args:
        folders: Runs that differ in the seed alone.
        out: Folder of the entries.
        name: The runs' name on the leaderboard; None: the algorithm.
        episodes: Episodes of each task.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises BidexError for runs that cannot form one entry, and if there is an entry of this name or of equal weights.
    """
    configs = [folder.config() for folder in folders]
    _check(folders, configs)
    first = configs[0]
    worlds = open_worlds(first.to_json())
    check_alike(folders)
    for folder in folders:
        check_worlds_of(folder, worlds, "An entry is of the present ones: submit with the versions in versions.json.")
    weights = _weights(folders)
    name = name or short_name(first.algo)
    suite = worlds.short_name
    path = _new(out / entry_name(suite, name))
    for known in sorted(out.glob("*.json")):
        if twice := {*weights} & {*read_entry(known).weights}:
            run = folders[weights.index(twice.pop())].path
            raise BidexError(f"{run} stands in {known}: their weights are equal. Leave it out, or delete that entry.")
    facts = [_facts(folder) for folder in folders]
    played = [_play(folder, config, episodes, device) for folder, config in zip(folders, configs, strict=True)]
    verified = played[0][3]
    stated = {
        "seeds": [config.seed for config in configs], "hours": [row[0] for row in facts], "device": facts[0][1],
        "commit": [row[2] for row in facts],
    }  # fmt: skip
    entry = {
        "format": FORMAT, "name": name, "suite": suite, "version": verified.suite_version, "algorithm": first.algo,
        "weights": weights, "steps": [row[2] for row in played], "episodes": episodes,
        "own": class_rows([row[0] for row in played]), "others": class_rows([row[1] for row in played]),
        "verified": asdict(verified), "stated": stated,
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, entry)
    return path


def submit_trials(file: Path, out: Path, *, name: str | None, track: Track | None) -> Path:
    """Write the leaderboard's entry of a meta-test of somebody's agent, and return its path.

    The agent is not here, so nothing is verified.

    Args:
        file: The meta-test, as ``meta_test(agent, suite).save(file)`` writes it.
        out: Folder of the entries.
        name: The agent's name on the leaderboard; None: its class.
        track: The kind of its training.

    Raises BidexError for another evaluation, without a track, and if there is an entry of this name.
    """
    found = read_evaluation(file, "meta_test(agent, suite).save(file)")
    if not isinstance(found, MetaTestEvaluation):
        raise BidexError(f"{file}: expected a meta-test, got an evaluation of a policy. Submit its run instead.")
    check_trials(found, str(file))
    if track is None:
        raise BidexError(
            "--track: expected reward-only (trained by rewards of its own episodes) or privileged (by teachers, hidden "
            "parts of tasks or rewards of other goals too), got none."
        )
    name = name or found.agent or ""
    path = _new(out / "trials" / entry_name(found.suite or "", name))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": FORMAT, "name": name, "track": track, "evaluation": evaluation_json(found)})
    return path


def _new(path: Path) -> Path:
    """Return the path of an entry; raise BidexError if there is one, or if it cannot be written."""
    if exists(path):
        raise BidexError(f"There is {path} already. Give another --name, or delete it.")
    check_writable(path)
    return path


def _check(folders: Sequence[RunFolder], configs: Sequence[RunConfig]) -> None:
    """Raise BidexError if the runs cannot form one entry."""
    for folder, config in zip(folders, configs, strict=True):
        if config.suite is None:
            raise BidexError(f"{folder.path} trained on the task {config.task} alone. The leaderboard is of suites.")
        if Capability.ADAPTS in learner_kind(config.algo).make.capabilities:
            raise BidexError(f"{config.algo} adapts to tasks, and runs that adapt are not taken (yet).")
        if run_kind(config) != run_kind(configs[0]):
            raise BidexError(f"{folder.path} differs from {folders[0].path} in more than its seed. Submit it apart.")
    if len({config.seed for config in configs}) < len(configs):
        raise BidexError("Two of the runs have one seed. Name each seed once.")


def _weights(folders: Sequence[RunFolder]) -> list[str]:
    """Return the digests of the runs' policies; raise BidexError if two are equal, whatever their configs say."""
    digests: dict[str, Path] = {}
    for folder in folders:
        state, _ = checkpoint(folder, noted=True)
        with fitting(folder.path):
            digest = weights_digest(state["learner"]["policy"])
        if digest in digests:
            raise BidexError(f"{folder.path} and {digests[digest]} have equal weights: they are one run. Name it once.")
        digests[digest] = folder.path
    return list(digests)


def _facts(folder: RunFolder) -> tuple[float, str, str | None]:
    """Return the hours of training, the device, and the commit that trained."""
    versions = folder.versions()
    config = folder.config()
    git = versions.get("git") or {}
    commit = git.get("commit") and git["commit"][:10] + "+" * bool(git.get("dirty"))
    if config.device.startswith("cuda"):
        gpus = set(versions.get("gpus") or [])
    else:
        gpus = set()
    device = ", ".join(gpus) or f"{config.device}, {config.threads} thread{'s' * (config.threads != 1)}"
    return round(training_seconds(folder.metrics()) / 3600.0, 3), device, commit


def _play(
    folder: RunFolder, stored: RunConfig, episodes: int, device: str
) -> tuple[Evaluation, Evaluation, int, Conditions]:
    """Return the evaluations on own and on other tasks, the policy's steps, and the conditions."""
    config = stored.to_json()
    config |= {"device": resolve_device(device, open_worlds(config).on_gpu), "engine": "auto"}
    worlds = open_worlds(config)
    others = worlds.others
    set_up_torch(stored.threads)
    state, steps = checkpoint(folder, noted=True)
    policy = policy_of(folder, state, config["device"])
    found = []
    for where, what in ((worlds, "its own tasks"), (others, "others")):
        say(f"{folder.path}: playing {what}.")
        world = where.world("train")
        found.append(where.judge(policy, world, where.protocol("train", episodes)))
        world.close()
    return found[0], found[1], steps, conditions(worlds)
