"""``bidex-meta verify``: does a run's checkpoint still do what its recorded evaluation says?"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NotRequired, TypedDict

from bidex_meta.cli.parsing import Engine, JsonSwitch, RunPath, parse
from bidex_meta.cli.tables import Json, Sheet, percent, print_table, ranged
from bidex_meta.config import RunConfig
from bidex_meta.errors import EXIT_FAILED, BidexError, one_line
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, Agreement, agreements, classes_of
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.metatest import TASKS, Options, meta_test
from bidex_meta.experiments.policies import checkpoint, policy_of
from bidex_meta.runs import RunFolder, schemas
from bidex_meta.runs.provenance import differences
from bidex_meta.suite import OTHERS
from bidex_meta.train.launch import say
from bidex_meta.utils.files import exists
from bidex_meta.utils.validation import Environments, Few, Finite, Seed, Shots, Text, Whole
from bidex_meta.utils.validation import parse as parse_content
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds


class _Row(TypedDict):
    episodes: NotRequired[Few]
    tasks: NotRequired[Few]
    length: NotRequired[Finite]


class _Part(TypedDict):
    episodes_per_task: Few
    classes: dict[str, _Row]


class _Split(TypedDict):
    shots: Shots
    rollouts: Few
    trials: Few
    max_adapt_steps: NotRequired[Few]
    before: _Part
    after: _Part


class _Conditions(TypedDict):
    device: NotRequired[Text]
    engine: NotRequired[Engine]
    num_envs: NotRequired[Environments | None]
    packages: NotRequired[Json]
    physics: NotRequired[Text | None]
    suite_version: NotRequired[Whole | None]
    suite_digest: NotRequired[Text | None]


class _Recorded(TypedDict):
    """What ``evaluation.json`` must hold beyond :mod:`bidex_meta.runs.schemas` to be made again."""

    steps: Whole
    seed: Seed
    conditions: NotRequired[_Conditions]
    splits: NotRequired[dict[str, _Split]]
    policy: NotRequired[_Part]


@dataclass(frozen=True)
class VerifyFlags:
    """Evaluates a run's checkpoint again as its evaluation.json was made, and compares the two class by class.

    Example: bidex-meta verify runs/MT4/mtppo/2026-11-21_10-00-00_seed0

    Exit code 0 where all is equal bit for bit or within the intervals, 1 where something differs.
    """

    run: RunPath  # Run folder.
    evaluation: Path | None = None  # What `bidex-meta evaluate --json` wrote of the run; None: its evaluation.json.
    device: str = "auto"  # auto, cpu or cuda:N; auto: where the evaluation was made, if that is here, else the CPU.
    engine: Engine | None = None  # auto, c or warp; None: as the evaluation was made, on another device auto.
    num_envs: Environments | None = None  # Environments stepped together; None: as the evaluation was made.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Verify a run and print a table or JSON; exit code 1 where something differs."""
    flags = parse(VerifyFlags, arguments, "verify")
    folder = RunFolder.open(flags.run)
    config = folder.config()
    recorded = recorded_evaluation(folder.path, flags.evaluation)
    then = recorded_conditions(recorded, schemas.read_versions(folder.path), config)
    config = _where(flags, then, config)
    worlds = Worlds.open(config.to_json())
    set_up_torch(config.threads)
    num_envs = then["num_envs"] if flags.num_envs is None else flags.num_envs
    state, step = _checkpoint(folder, recorded["steps"])
    apart = others(then, conditions(worlds, num_envs))
    for line in apart:
        say(f"Conditions: {one_line(line)}.")
    again = _again(folder, config, worlds, recorded, num_envs, state)
    found = agreements(classes_of(recorded), classes_of(again))
    counts = {outcome: sum(each.outcome == outcome for each in found) for outcome in (EQUAL, WITHIN, DIFFERS)}
    if flags.json:
        report = {"run": str(folder.path), "steps": step, "conditions": apart, **counts}
        print(json.dumps(report | {"classes": {each.name: each.to_json() for each in found}}, indent=2))
    else:
        _print_table(f"{config.algo} on {worlds.name}, {step:,} steps, recorded and again", found)
        verdict = f"{counts[EQUAL]} equal bit for bit, {counts[WITHIN]} within, {counts[DIFFERS]} differ"
        end = ": this run is not what its evaluation says" if counts[DIFFERS] else ""
        print(f"{len(found)} classes: {verdict}{end}")
    if counts[DIFFERS]:
        raise SystemExit(EXIT_FAILED)


def _print_table(title: str, found: Sequence[Agreement]) -> None:
    """A class a row."""
    caption = "within: apart by no more than both 95 % intervals allow, over all classes together"
    table = Sheet(["task", "outcome", "success", "again", "return [95 %]", "return again [95 %]"], title, caption)
    for each in found:
        both = each.recorded, each.again
        cells = [each.name, each.outcome, *(percent(row["success"]) for row in both)]
        cells += [ranged(row["return"], row.get("return_interval")) for row in both]
        table.add(*cells, style="bold red" if each.outcome == DIFFERS else "")
    print_table(table)


def recorded_evaluation(run: Path, named: Path | None = None) -> Json:
    """The evaluation of a run folder, or another file of it, to compare with; all that is read of it checked.

    Raises BidexError where there is none, or it is damaged, or does not say how it was made.
    """
    path = named or run / "evaluation.json"
    again = f"bidex-meta evaluate {run} --json > {path}"
    if named is None and not exists(path):
        raise BidexError(f"{run} has no evaluation.json to be verified. Let the run end, or write one: {again}")
    found = schemas.read_evaluation(path, again)
    if "randomisation" in found:
        raise BidexError(f"{path}: expected an evaluation without --randomisation, got one with it. Name another.")
    parse_content(found, _Recorded, str(path))
    if "splits" not in found and "policy" not in found:
        parse_content(found, _Part, str(path))
    return found


def _where(flags: VerifyFlags, then: Json, config: RunConfig) -> RunConfig:
    """The run's config with device and engine to evaluate with."""
    on_gpu = Worlds.open(config.to_json()).on_gpu
    try:
        device = resolve_device(then["device"] if flags.device == "auto" else flags.device, on_gpu)
    except BidexError:
        if flags.device != "auto":
            raise
        device = "cpu"
    same = device.partition(":")[0] == then["device"].partition(":")[0]
    return replace(config, device=device, engine=flags.engine or (then["engine"] if same else "auto"))


def _checkpoint(folder: RunFolder, steps: int) -> tuple[Json, int]:
    """The checkpoint that was evaluated."""
    for which in ("last", f"step_{steps}.pt", "best"):
        there = which == "last" or exists(folder.checkpoints.folder / (f"{which}.pt" if which == "best" else which))
        found = checkpoint(folder, which, noted=True) if there else None
        if found is not None and found[1] == steps:
            return found
    raise BidexError(
        f"The evaluation is of {steps:,} steps, and {folder.path} has no checkpoint of these: its newest is at "
        f"{folder.checkpoints.newest_step() or 0:,}. Evaluate anew: bidex-meta evaluate {folder.path} --json"
    )


def _again(
    folder: RunFolder, config: RunConfig, worlds: Worlds, recorded: Json, num_envs: int | None, state: Json
) -> Json:
    """The recorded evaluation, made again."""
    load = partial(policy_of, folder, state, config.device)
    if learner_kind(config.algo).make.adapts != ("splits" in recorded):
        kind = "a meta-test" if "splits" in recorded else "no meta-test"
        raise BidexError(f"{folder.path}: the evaluation is {kind}, which is not how {config.algo} is judged.")
    if "splits" not in recorded:
        split, episodes = recorded.get("split", "train"), recorded.get("policy", recorded)["episodes_per_task"]
        world = worlds.world(split, num_envs)
        found = worlds.judge(load(), world, worlds.protocol(split, episodes, recorded["seed"]))
        world.close()
        return {"policy": found.to_json()}
    splits = {}
    for split, part in recorded["splits"].items():
        if split not in (*worlds.splits, OTHERS):
            raise BidexError(f"{worlds.name} has no {split} tasks, which the evaluation is of.")
        before = part["before"]
        options = Options(
            shots=part["shots"], rollouts=part["rollouts"], trials=part["trials"], episodes=before["episodes_per_task"],
            tasks=max(row.get("tasks", TASKS) for row in before["classes"].values()),
            num_envs=num_envs, seed=recorded["seed"],
        )  # fmt: skip
        if "max_adapt_steps" in part:
            config = replace(config, learner={**config.learner, "max_adapt_steps": part["max_adapt_steps"]})
        splits[split] = meta_test(worlds, config, load, options, [split], say)[split].to_json()
    return {"splits": splits}


def recorded_conditions(evaluation: Json, versions: Json, config: RunConfig) -> Json:
    """The same of an evaluation as it was recorded; of an older one what its run was trained with.

    Of the contents of ``evaluation.json`` and ``versions.json`` (empty where there is none), and the run's config.
    """
    found = {"device": config.device, "engine": config.engine, "num_envs": None}
    found |= {name: versions.get(name) for name in ("packages", "physics", "suite_version", "suite_digest")}
    found |= evaluation.get("conditions", {})
    packages = found["packages"]
    return found | {"packages": packages if isinstance(packages, dict) else {}}


def others(then: Json, now: Json) -> list[str]:
    """What differs between recorded conditions and those now, a text each; the last names what was not recorded."""
    texts = list(map(str, differences(then, now)))
    where = ("device", "engine", "threads")
    texts += [f"{name} {then[name]} then, {now[name]} now" for name in where if then.get(name) not in (None, now[name])]
    packages = then["packages"]
    unknown = [name for name in now["packages"] if packages.get(name) is None]
    names = ("device", "engine", "physics", "suite_version")
    unknown += [name.replace("_", " ") for name in names if then.get(name) is None and now[name] is not None]
    return texts + ([f"not recorded: {', '.join(unknown)}"] if unknown else [])
