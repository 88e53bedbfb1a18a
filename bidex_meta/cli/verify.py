"""``bidex-meta verify``: does a run's checkpoint still do what its recorded evaluation says?"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bidex_meta.cli.parsing import RunPath, Switch, parse
from bidex_meta.config import RunConfig
from bidex_meta.errors import EXIT_FAILED, BidexError, one_line
from bidex_meta.utils.files import exists
from bidex_meta.utils.validation import Environments
from bidex_meta.worlds import Worlds


@dataclass(frozen=True)
class VerifyFlags:
    """Evaluates a run's checkpoint again as its evaluation.json was made, and compares the two class by class.

    Example: bidex-meta verify runs/MT4/mtppo/2026-11-21_10-00-00_seed0

    Exit code 0 where all is equal bit for bit or within the intervals, 1 where something differs.
    """

    run: RunPath
    """Run folder."""
    evaluation: Path | None = None
    """What `bidex-meta evaluate --json` wrote of the run; None: its evaluation.json."""
    device: str = "auto"
    """auto, cpu or cuda:N; auto: where the evaluation was made, if that is here, else the CPU."""
    engine: str | None = None
    """auto, c or warp; None: as the evaluation was made, on another device auto."""
    num_envs: Environments | None = None
    """Rows stepped together; None: as the evaluation was made."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Verify a run and print a table or JSON.

    Raises:
        BidexError: There is nothing to compare with, or the checkpoint is not the one that was evaluated.
        SystemExit: With exit code 1: something differs.
    """
    flags = parse(VerifyFlags, arguments, "verify")

    from bidex_meta.cli.conditions import conditions, others, recorded_conditions
    from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, agreements, classes_of
    from bidex_meta.runs import RunFolder
    from bidex_meta.runs.schemas import read_versions
    from bidex_meta.world.threads import set_up_torch

    folder = RunFolder.open(flags.run)
    config = folder.config()
    recorded = recorded_evaluation(folder.path, flags.evaluation)
    then = recorded_conditions(recorded, read_versions(folder.path), config)
    config = replace(config, **_place(flags, then, config))
    source = Worlds.open(config.to_json())
    set_up_torch(config.threads)
    rows = then["num_envs"] if flags.num_envs is None else flags.num_envs
    state, step = _checkpoint(folder, recorded["steps"])
    apart = others(then, conditions(source, rows))
    for line in apart:
        print(f"Conditions: {one_line(line)}.", file=sys.stderr, flush=True)
    again = _again(folder, config, source, recorded, rows, state)
    found = agreements(classes_of(recorded), classes_of(again))
    counts = {outcome: sum(each.outcome == outcome for each in found) for outcome in (EQUAL, WITHIN, DIFFERS)}
    verdict = (
        f"{len(found)} classes: {counts[EQUAL]} equal bit for bit, {counts[WITHIN]} within, {counts[DIFFERS]} differ"
    )
    if flags.json:
        report = {"run": str(folder.path), "steps": step, "conditions": apart, **counts}
        print(json.dumps(report | {"classes": {each.name: each.to_json() for each in found}}, indent=2))
    else:
        _print(f"{config.algo} on {source.name}, {step:,} steps, recorded and again", found)
        print(verdict if not counts[DIFFERS] else f"{verdict}: this run is not what its evaluation says")
    if counts[DIFFERS]:
        raise SystemExit(EXIT_FAILED)


def recorded_evaluation(run: Path, named: Path | None = None) -> dict[str, Any]:
    """The evaluation to compare with, all that is read of it checked.

    Args:
        run: The run folder.
        named: A file in the place of its ``evaluation.json``.

    Raises:
        BidexError: There is none, or it is damaged, or does not say how it was made.
    """
    from bidex_meta.runs.schemas import read_evaluation
    from bidex_meta.utils.files import TABLE, TEXT, check, choice, number, whole

    path = named or run / "evaluation.json"
    again = f"bidex-meta evaluate {run} --json > {path}"
    if named is None and not exists(path):
        raise BidexError(f"{run} has no evaluation.json to be verified. Let the run end, or write one: {again}")
    found = read_evaluation(path, again)
    many = whole(1, 1_000_000)
    check(found, {"seed": whole(0), "conditions": TABLE}, path, ("steps", "seed"))
    rules = {"device": TEXT, "engine": choice("auto", "c", "warp"), "num_envs": whole(1, 10_000_000).or_none()}
    rules |= {"packages": TABLE, "physics": TEXT.or_none(), "suite_version": whole(0).or_none()}
    check(found.get("conditions", {}), rules, path, place="conditions.")
    parts = [("policy.", found.get("policy", found))] if "splits" not in found else []
    for split, part in found.get("splits", {}).items():
        limits = {"shots": whole(0, 1000), "rollouts": many, "trials": many}
        check(part, limits, path, tuple(limits), f"splits.{split}.")
        parts += [(f"splits.{split}.before.", part["before"]), (f"splits.{split}.after.", part["after"])]
    for place, part in parts:
        check(part, {"episodes_per_task": many}, path, ("episodes_per_task",), place)
        for name, row in part["classes"].items():
            check(row, {"episodes": many, "tasks": many, "length": number()}, path, (), f"{place}classes.{name}.")
    return found


def _place(flags: VerifyFlags, then: dict[str, Any], config: RunConfig[Any]) -> dict[str, Any]:
    """Device and engine to evaluate with."""
    from bidex_meta.cli.learners import resolve_device

    on_gpu = Worlds.open(config.to_json()).on_gpu
    try:
        device = resolve_device(then["device"] if flags.device == "auto" else flags.device, on_gpu)
    except BidexError:
        if flags.device != "auto":
            raise
        device = "cpu"
    same = _kind(device) == _kind(then["device"])
    return {"device": device, "engine": flags.engine or (then["engine"] if same else "auto")}


def _kind(device: str) -> str:
    """``cuda`` of ``cuda:0``."""
    return device.partition(":")[0]


def _checkpoint(folder: Any, steps: int) -> tuple[dict[str, Any], int]:
    """The checkpoint that was evaluated.

    Raises:
        BidexError: It is not there any more.
    """
    from bidex_meta.cli.policies import checkpoint

    for which in ("last", f"step_{steps}.pt", "best"):
        there = which == "last" or exists(folder.checkpoints.folder / (f"{which}.pt" if which == "best" else which))
        found = checkpoint(folder, which) if there else None
        if found is not None and found[1] == steps:
            return found
    raise BidexError(
        f"The evaluation is of {steps:,} steps, and {folder.path} has no checkpoint of these: its newest is at "
        f"{folder.checkpoints.newest_step() or 0:,}. Evaluate anew: bidex-meta evaluate {folder.path} --json"
    )


def _again(
    folder: Any, config: RunConfig[Any], source: Worlds, recorded: dict[str, Any], rows: int | None, state: Any
) -> dict[str, Any]:
    """The recorded evaluation, made again."""
    from bidex_meta.cli.learners import learner_kind
    from bidex_meta.cli.policies import policy_of

    if learner_kind(config.algo).make.adapts != ("splits" in recorded):
        kind = "a meta-test" if "splits" in recorded else "no meta-test"
        raise BidexError(f"{folder.path}: the evaluation is {kind}, which is not how {config.algo} is judged.")
    if "splits" not in recorded:
        world = source.world(recorded.get("split", "train"), rows)
        episodes = recorded.get("policy", recorded)["episodes_per_task"]
        found = source.judge(policy_of(folder, state, config.device), world, episodes, recorded["seed"])
        world.close()
        return {"policy": found.to_json()}
    from bidex_meta.cli import metatest

    splits = {}
    for split, part in recorded["splits"].items():
        if split not in source.splits:
            raise BidexError(f"{source.name} has no {split} tasks, which the evaluation is of.")
        tasks = max(row.get("tasks", metatest.TASKS) for row in part["before"]["classes"].values())
        options = metatest.Options(
            shots=part["shots"],
            rollouts=part["rollouts"],
            episodes=part["before"]["episodes_per_task"],
            tasks=tasks,
            trials=part["trials"],
            num_envs=rows,
            seed=recorded["seed"],
        )
        say = lambda text: print(text, file=sys.stderr, flush=True)  # noqa: E731
        load = lambda: policy_of(folder, state, config.device)  # noqa: E731
        splits |= metatest.report(metatest.meta_test(source, config, load, options, [split], say))
    return {"splits": splits}


def _print(title: str, found: list[Any]) -> None:
    from bidex_meta.cli.tables import agreement_table, print_table

    print_table(agreement_table(title, found))
