"""``bidex-meta control``: test if adaptation learns from the task's own data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bidex_meta.cli.parsing import Device, Engine, JsonSwitch, RunPaths, parse
from bidex_meta.cli.tables import Json, Sheet, gained, percent, print_table
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.experiments.control_runs import control_runs
from bidex_meta.experiments.metatest import ENVIRONMENTS
from bidex_meta.runs import RunFolder
from bidex_meta.utils.validation import Environments, Few, Seed, Shots


@dataclass(frozen=True)
class ControlFlags:
    """Test whether a policy that adapts to a held-out task learns from that task's own data.

    Example: bidex-meta control runs/ML1-wide/promp/*

    The policy is adapted to a held-out task's own data, and separately to the data of each train task of the class.
    Each adapted policy is then evaluated on the held-out task, from the same starts and with the same random numbers.
    The suite must have its classes in both splits (ML1, ML1-wide). If you name several runs, they must be seeds of one
    experiment.
    """

    runs: RunPaths  # Run folders that differ only in the seed.
    trials: Few = 25  # Number of adaptations to each task, each from the unadapted policy and with new episodes.
    episodes: Few = 80  # Evaluation episodes after each adaptation.
    shots: Shots = Protocol.shots  # Adaptation rounds, one after the other.
    rollouts: Few | None = None  # Episodes of each task in one adaptation round; None: as in training, at most 40.
    num_envs: Environments = ENVIRONMENTS  # Maximum number of environments stepped together; it bounds memory.
    seed: Seed = EVALUATION_SEED  # Seed of the start states of the episodes. Training never uses the default seed.
    device: Device = "auto"
    engine: Engine = "auto"
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Play all arms (kinds of data to adapt to) of all runs, and print a table per class, or JSON."""
    flags = parse(ControlFlags, arguments, "control")
    if not flags.runs:
        raise BidexError("Name the run folders: bidex-meta control RUN...")
    found = control_runs(
        [RunFolder.open(path) for path in flags.runs], shots=flags.shots, rollouts=flags.rollouts,
        episodes=flags.episodes, trials=flags.trials, num_envs=flags.num_envs, seed=flags.seed, device=flags.device,
        engine=flags.engine,
    )  # fmt: skip
    if flags.json:
        print(json.dumps(found.to_json(), indent=2))
        return
    count = len(found.runs)
    for name, by_arm in found.classes.items():
        title = f"{found.title}, held-out tasks of {name}, {count} run{'s' * (count > 1)}, "
        _print_table(f"{title}{found.episodes[name]:,} episodes an arm", by_arm)


def _print_table(title: str, by_arm: Mapping[str, Json]) -> None:
    """Print a table with one row for each kind of data that the policy was adapted to."""
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
