"""``bidex-meta control``: test if adaptation learns from the task's own data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bidex_meta.cli.parsing import Device, Engine, JsonSwitch, RunPaths, parse
from bidex_meta.cli.tables import Json, Sheet, gained, percent, print_table
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.control_arms import Control, arms, control
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.experiments import metatest
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.policies import policy_loader
from bidex_meta.runs import RunFolder
from bidex_meta.runs.provenance import check_alike
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds


@dataclass(frozen=True)
class ControlFlags:
    """Adapt held-out tasks to their own data and to data of each train task, with common random numbers.

    Example: bidex-meta control runs/ML1-wide/promp/*

    For suites whose classes stand in both splits (ML1, ML1-wide). Several runs are seeds of one experiment.
    """

    runs: RunPaths  # Run folders that differ in the seed alone.
    trials: Few = 25  # Adaptations of each task, each from the start and to other episodes.
    episodes: Few = 80  # Evaluation episodes after each adaptation.
    shots: Shots = 1  # Adapt so often, one after the other.
    rollouts: Few | None = None  # Episodes of each task in a shot; None: as the run was trained, but 40 at most.
    num_envs: Environments = 1024  # Environments stepped together at most; bounds memory.
    seed: Seed = EVALUATION_SEED  # Seed of the episodes' starts; training does not use the default.
    device: Device = "auto"
    engine: Engine = "auto"
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Play all arms of all runs and print a table per class, or JSON."""
    flags = parse(ControlFlags, arguments, "control")
    if not flags.runs:
        raise BidexError("Name the run folders: bidex-meta control RUN...")
    folders = [RunFolder.open(path) for path in flags.runs]
    config = folders[0].config()
    worlds = Worlds.open(config.to_json())
    _check(folders)
    played = [_play(folder, flags) for folder in folders]
    tasks = worlds.tasks("train")
    found = {name: arms(played, name, tasks[name]) for name in played[0].own.classes}
    episodes = {name: result.episodes * len(played) for name, result in played[0].own.classes.items()}
    if flags.json:
        report = {"runs": [str(folder.path) for folder in folders], "shots": flags.shots, "trials": flags.trials}
        report |= {"rollouts": played[0].rollouts, "episodes": episodes}
        classes = {name: {arm: _plain(of) for arm, of in by_arm.items()} for name, by_arm in found.items()}
        print(json.dumps(report | {"classes": classes}, indent=2))
        return
    for name, by_arm in found.items():
        title = f"{config.algo} on {worlds.name}, held-out tasks of {name}, "
        title += f"{len(played)} run{'s' * (len(played) > 1)}, {episodes[name]:,} episodes an arm"
        _print_table(title, by_arm)


def _print_table(title: str, by_arm: Mapping[str, Json]) -> None:
    """Print a table with one row per arm."""
    caption = (
        "gains: own data above this arm, same starts; [..] 95 % bootstrap interval over runs, adaptations, episodes"
    )
    headers = ["adapted to", "return", "return of each run", "success"]
    headers += ["success gained [95 %]", "return gained [95 %]", "score gained [95 %]"]
    table = Sheet(headers, title, caption, spare=("return of each run", "score gained", "success"))
    labels = {"before": "nothing", "own": "its own data", "foreign": "train tasks' data, mean"}
    for arm, of in by_arm.items():
        cells = [labels.get(arm) or f"data of {arm}", f"{of['return']:.4g}"]
        cells += [" ".join(f"{value:.4g}" for value in of["runs"]), percent(of["success"])]
        table.add(*cells, *(gained(of["own_minus"]) if "own_minus" in of else []))
    print_table(table)


def _plain(arm: Json) -> Json:
    gains = arm.get("own_minus", {})
    return arm | {"own_minus": {name: None if gain is None else asdict(gain) for name, gain in gains.items()}}


def _check(folders: Sequence[RunFolder]) -> None:
    """Raise BidexError unless all runs adapt, have the same classes in both splits, and differ only in the seed."""
    check_alike(folders)
    first = run_kind(folders[0].config())
    seeds: dict[int, Path] = {}
    for folder in folders:
        config = folder.config()
        if Capability.ADAPTS not in learner_kind(config.algo).make.capabilities:
            raise BidexError(f"{folder.path}: {config.algo} does not adapt to tasks. Name runs of maml, promp or rl2.")
        metatest.check_worlds(Worlds.open(config.to_json()), config.algo)
        if (other := seeds.setdefault(config.seed, folder.path)) is not folder.path:
            raise BidexError(f"{folder.path} and {other} both have seed {config.seed}. Name one run for each seed.")
        if differing := [name for name, value in run_kind(config).items() if value != first.get(name)]:
            raise BidexError(
                f"Expected runs that differ in the seed alone, but {folders[0].path} and {folder.path} differ in "
                f"{', '.join(differing)}. Name them in separate calls."
            )


def _play(folder: RunFolder, flags: ControlFlags) -> Control:
    stored = folder.config()
    device = resolve_device(flags.device, Worlds.open(stored.to_json()).on_gpu)
    config = replace(stored, device=device, engine=flags.engine)
    worlds = Worlds.open(config.to_json())
    set_up_torch(config.threads)
    counts = [len(pool) for pool in worlds.tasks("test").values()]
    rollouts = metatest.rollouts_of(worlds, config, flags.rollouts, max(1, flags.num_envs // len(counts)))
    size = metatest.environments_for(len(counts), max(counts) * flags.trials, rollouts, flags.num_envs)
    say(f"{folder.path}: {flags.trials} adaptations of each held-out task, {size} environments.")
    test, train = (worlds.world(split, size) for split in ("test", "train"))
    protocol = Protocol(
        "test", flags.seed, shots=flags.shots, rollouts=rollouts, episodes_per_task=flags.episodes, trials=flags.trials,
        max_adapt_steps=metatest.adapt_steps_of(config)
    )  # fmt: skip
    found = control(
        policy_loader(folder, device)[0], test, train, say=say, protocol=protocol,
        references=worlds.references(),
    )  # fmt: skip
    test.close()
    train.close()
    return found
