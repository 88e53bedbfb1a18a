"""``bidex-meta control``: is it the task's own data that adaptation learns from?"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.worlds import Worlds

if TYPE_CHECKING:
    from bidex_meta.evaluation.control_arms import Control
    from bidex_meta.runs import RunFolder


@dataclass(frozen=True)
class ControlFlags:
    """Adapt held-out tasks to their own data and to data of each train task, with common random numbers.

    Example: bidex-meta control runs/ML1-wide/promp/*

    For suites whose classes stand in both splits (ML1, ML1-wide). Several runs are seeds of one experiment.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders that differ in the seed alone."""
    trials: Few = 25
    """Adaptations of each task, each from the start and to other episodes."""
    episodes: Few = 80
    """Evaluation episodes after each adaptation."""
    shots: Shots = 1
    """Adapt so often, one after the other."""
    rollouts: Few | None = None
    """Episodes of each task in a shot; None: as the run was trained, but 40 at most."""
    num_envs: Environments = 1024
    """Rows stepped together at most; bounds memory."""
    seed: Seed | None = None
    """Seed of the episodes' starts; None: one that training does not use."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics; auto: the one that is fast on the device."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Play all arms of all runs and print a table of each class, or JSON.

    Raises:
        BidexError: No run is named, one cannot be used, or they are not seeds of one experiment.
    """
    flags = parse(ControlFlags, arguments, "control")
    if not flags.runs:
        raise BidexError("Name the run folders: bidex-meta control RUN...")
    from bidex_meta.cli import metatest
    from bidex_meta.evaluation.control_arms import arms
    from bidex_meta.runs import RunFolder

    metatest.check_numbers(flags, "trials", "episodes", "shots", "rollouts", "num_envs")
    folders = [RunFolder.open(path) for path in flags.runs]
    config = folders[0].config()
    source = Worlds.open(config.to_json())
    _check(folders)
    played = [_play(folder, flags) for folder in folders]
    classes = played[0].own.classes
    tasks = source.tasks("train")
    found = {name: arms(played, name, tasks[name]) for name in classes}
    per_arm = {name: result.episodes * len(played) for name, result in classes.items()}
    if flags.json:
        print(json.dumps(_report(folders, flags, played[0].rollouts, per_arm, found), indent=2))
        return
    from bidex_meta.cli.tables import control_table, print_table

    for name, by_arm in found.items():
        title = f"{config.algo} on {source.name}, held-out tasks of {name}, "
        title += f"{len(played)} run{'s' * (len(played) > 1)}, {per_arm[name]:,} episodes an arm"
        print_table(control_table(title, by_arm))


def _check(folders: "Sequence[RunFolder]") -> None:
    """All runs adapt, on a suite with the same classes in both splits, and differ in the seed alone."""
    from bidex_meta.cli import metatest
    from bidex_meta.cli.learners import learner_kind
    from bidex_meta.evaluation.comparison import run_kind

    kinds: list[dict[str, Any]] = []
    seeds: dict[int, Path] = {}
    for folder in folders:
        config = folder.config()
        if not learner_kind(config.algo).make.adapts:
            raise BidexError(f"{folder.path}: {config.algo} does not adapt to tasks. Name runs of maml, promp or rl2.")
        metatest.check_source(Worlds.open(config.to_json()), config.algo)
        kinds.append(run_kind(config))
        if (seed := config.seed) in seeds:
            raise BidexError(f"{folder.path} and {seeds[seed]} both have seed {seed}. Name one run for each seed.")
        seeds[seed] = folder.path
    for folder, kind in zip(folders, kinds, strict=True):
        differing = [name for name in kind if kind[name] != kinds[0].get(name)]
        if differing:
            raise BidexError(
                f"Expected runs that differ in the seed alone, but {folders[0].path} and {folder.path} differ in "
                f"{', '.join(differing)}. Name them in separate calls."
            )


def _play(folder: "RunFolder", flags: ControlFlags) -> "Control":
    """The arms of one run."""
    from bidex_meta.cli import metatest
    from bidex_meta.cli.learners import resolve_device
    from bidex_meta.cli.policies import policy_loader
    from bidex_meta.evaluation.control_arms import control
    from bidex_meta.evaluation.meta_test import MAX_ADAPT_STEPS
    from bidex_meta.evaluation.play import EVALUATION_SEED
    from bidex_meta.world.threads import set_up_torch

    config = folder.config()
    device = resolve_device(flags.device, Worlds.open(config.to_json()).on_gpu)
    source = Worlds.open({**config.to_json(), "device": device, "engine": flags.engine})
    set_up_torch(config.threads)
    counts = [len(pool) for pool in source.tasks("test").values()]
    rollouts = metatest.rollouts_of(source, config, flags.rollouts, max(1, flags.num_envs // len(counts)))
    rows = metatest.rows_for(len(counts), max(counts) * flags.trials, rollouts, flags.num_envs)
    _say(f"{folder.path}: {flags.trials} adaptations of each held-out task, {rows} rows.")
    test, train = (source.world(split, rows) for split in ("test", "train"))
    found = control(
        policy_loader(folder, device)[0],
        test,
        train,
        flags.shots,
        say=_say,
        rollouts=rollouts,
        episodes_per_task=flags.episodes,
        trials=flags.trials,
        max_adapt_steps=config.learner_values.get("max_adapt_steps", MAX_ADAPT_STEPS),
        seed=EVALUATION_SEED if flags.seed is None else flags.seed,
        references=source.references(),
    )
    test.close()
    train.close()
    return found


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _report(
    folders: "Sequence[RunFolder]", flags: ControlFlags, rollouts: int, episodes: dict[str, int], found: dict[str, Any]
) -> dict[str, Any]:
    def plain(arm: dict[str, Any]) -> dict[str, Any]:
        gains = arm.get("own_minus", {})
        return arm | {"own_minus": {name: None if gain is None else asdict(gain) for name, gain in gains.items()}}

    return {
        "runs": [str(folder.path) for folder in folders],
        "shots": flags.shots,
        "rollouts": rollouts,
        "trials": flags.trials,
        "episodes": episodes,
        "classes": {name: {arm: plain(values) for arm, values in arms.items()} for name, arms in found.items()},
    }
