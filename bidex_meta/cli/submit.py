"""``bidex-meta submit``: an entry of the leaderboard, verified by playing the runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.evaluate import conditions
from bidex_meta.cli.learners import learner_kind, resolve_device
from bidex_meta.cli.metatest import others_of
from bidex_meta.cli.parsing import Device, RunPaths, parse
from bidex_meta.cli.policies import load_policy
from bidex_meta.cli.tables import Json, say
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.leaderboard import class_rows, estimate, iqm, read_entry
from bidex_meta.evaluation.play import EVALUATION_SEED
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.runs import RunFolder, training_seconds
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.utils.files import exists
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Few
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds


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
    configs = [folder.config() for folder in folders]
    _check(folders, configs)
    first = configs[0]
    name = flags.name or short_name(first.algo)
    suite = Worlds.open(first.to_json()).name
    path = flags.out / f"{Path(suite).stem}-{name.replace(' ', '-').replace('/', '-')}.json"
    if exists(path):
        raise BidexError(f"There is {path} already. Give another --name, or delete it.")
    check_writable(path)
    facts = [_facts(folder) for folder in folders]
    played = [_play(folder, config, flags) for folder, config in zip(folders, configs, strict=True)]
    entry = {
        "format": 1, "name": name, "suite": suite, "version": played[0][3]["suite_version"], "algorithm": first.algo,
        "seeds": [config.seed for config in configs], "steps": [row[2] for row in played],
        "hours": [row[0] for row in facts], "device": facts[0][1], "commit": [row[2] for row in facts],
        "episodes": flags.episodes, "own": class_rows([row[0] for row in played]),
        "others": class_rows([row[1] for row in played]), "verified": played[0][3],
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, entry)
    read = read_entry(path)
    own, others = (estimate(iqm, read.success(part)).text(100.0, " %") for part in (read.own, read.others))
    print(f"{path}: success, IQM {own}, on other tasks {others}")


def _check(folders: Sequence[RunFolder], configs: Sequence[RunConfig]) -> None:
    """Raises BidexError for runs that make no entry together."""
    for folder, config in zip(folders, configs, strict=True):
        if config.suite is None:
            raise BidexError(f"{folder.path} trained on the task {config.task} alone. The leaderboard is of suites.")
        if learner_kind(config.algo).make.adapts:
            raise BidexError(f"{config.algo} adapts to tasks, and the leaderboard is of policies that do not (yet).")
        if run_kind(config) != run_kind(configs[0]):
            raise BidexError(f"{folder.path} differs from {folders[0].path} in more than its seed. Submit it apart.")
    if len({config.seed for config in configs}) < len(configs):
        raise BidexError("Two of the runs have one seed. Name each seed once.")


def _facts(folder: RunFolder) -> tuple[float, str, str | None]:
    """Hours of training, the device and the commit that trained."""
    versions, config = folder.versions(), folder.config()
    git = versions.get("git") or {}
    commit = git.get("commit") and git["commit"][:10] + "+" * bool(git.get("dirty"))
    gpus = set(versions.get("gpus") or []) if config.device.startswith("cuda") else set()
    device = ", ".join(gpus) or f"{config.device}, {config.threads} thread{'s' * (config.threads != 1)}"
    return round(training_seconds(folder.metrics()) / 3600.0, 3), device, commit


def _play(folder: RunFolder, stored: RunConfig, flags: SubmitFlags) -> tuple[Evaluation, Evaluation, int, Json]:
    """Evaluations on own and on other tasks, the policy's steps, and the conditions."""
    config = stored.to_json()
    config |= {"device": resolve_device(flags.device, Worlds.open(config).on_gpu), "engine": "auto"}
    worlds = Worlds.open(config)
    others = others_of(worlds)
    set_up_torch(stored.threads)
    policy, steps = load_policy(folder, config["device"])
    found = []
    for where, what in ((worlds, "its own tasks"), (others, "others")):
        say(f"{folder.path}: playing {what}.")
        world = where.world("train")
        found.append(where.judge(policy, world, flags.episodes, EVALUATION_SEED))
        world.close()
    return found[0], found[1], steps, conditions(worlds)
