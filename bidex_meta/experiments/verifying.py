"""Verification of a run: its checkpoint is evaluated again, and compared with its recorded evaluation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NotRequired, TypedDict

from bidex_meta.errors import BidexError, one_line
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, Agreement, agreements, classes_of
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.metatest import TASKS, Options, meta_test
from bidex_meta.experiments.policies import checkpoint, policy_of
from bidex_meta.runs import RunFolder, schemas
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.provenance import differences
from bidex_meta.suite import OTHERS
from bidex_meta.training.launch import say
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import exists
from bidex_meta.utils.validation import Environments, Few, Finite, Seed, Shots, Text, Whole
from bidex_meta.utils.validation import parse as parse_content
from bidex_meta.world.threads import set_up_torch
from bidex_meta.worlds import Worlds

Engine = Literal["auto", "c", "warp"]


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
    """The entries that ``evaluation.json`` needs beyond :mod:`bidex_meta.runs.schemas` for a verification."""

    steps: Whole
    seed: Seed
    conditions: NotRequired[_Conditions]
    splits: NotRequired[dict[str, _Split]]
    policy: NotRequired[_Part]


@dataclass(frozen=True)
class Verification:
    """The result of :func:`verify`."""

    run: RunFolder
    title: str
    steps: int
    """Environment steps that the policy was trained for."""
    conditions: Sequence[str]
    """How the conditions of both evaluations differ, one text each."""
    classes: Sequence[Agreement]

    def count(self, outcome: str) -> int:
        """Return the number of classes with an outcome of ``bidex_meta.evaluation.agreement``."""
        return sum(each.outcome == outcome for each in self.classes)

    @property
    def agrees(self) -> bool:
        """Whether no class differs beyond its intervals."""
        return self.count(DIFFERS) == 0

    def to_json(self) -> Json:
        """Return everything, ready for JSON."""
        report: Json = {"run": str(self.run.path), "steps": self.steps, "conditions": list(self.conditions)}
        report |= {outcome: self.count(outcome) for outcome in (EQUAL, WITHIN, DIFFERS)}
        return report | {"classes": {each.name: each.to_json() for each in self.classes}}


@checked_arguments
def verify(
    run: RunFolder | str | Path,
    *,
    evaluation: Path | None = None,
    device: str = "auto",
    engine: str | None = None,
    num_envs: int | None = None,
) -> Verification:
    """Evaluate a run's checkpoint again as its evaluation was made, and compare the two class by class.

    Args:
        run: The run's folder.
        evaluation: A file that ``bidex-meta evaluate --json`` wrote of the run; None: its ``evaluation.json``.
        device: ``auto``, ``cpu`` or ``cuda:N``; auto: the device of the evaluation if it is here, else the CPU.
        engine: ``auto``, ``c`` or ``warp``; None: the engine of the evaluation, on another device ``auto``.
        num_envs: Environments stepped together; None: the number of the evaluation.

    Raises BidexError if the evaluation or its checkpoint is missing or damaged.
    """
    folder = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    config = folder.config()
    recorded = recorded_evaluation(folder.path, evaluation)
    then = recorded_conditions(recorded, schemas.read_versions(folder.path), config)
    config = _where(device, engine, then, config)
    worlds = Worlds.open(config.to_json())
    set_up_torch(config.threads)
    if num_envs is None:
        environments = then["num_envs"]
    else:
        environments = num_envs
    state, step = _checkpoint(folder, recorded["steps"])
    apart = others(then, conditions(worlds, environments))
    for line in apart:
        say(f"Conditions: {one_line(line)}.")
    again = _again(folder, config, worlds, recorded, environments, state)
    found = agreements(classes_of(recorded), classes_of(again))
    return Verification(folder, f"{config.algo} on {worlds.name}, {step:,} steps", step, apart, found)


def recorded_evaluation(run: Path, named: Path | None = None) -> Json:
    """Return a run's recorded evaluation, or another file of the run, to compare with; check what is read of it.

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


def _where(device: str, engine: str | None, then: Json, config: AnyConfig) -> AnyConfig:
    """Return the run's config with the device and engine to evaluate with."""
    on_gpu = Worlds.open(config.to_json()).on_gpu
    try:
        found = resolve_device(then["device"] if device == "auto" else device, on_gpu)
    except BidexError:
        if device != "auto":
            raise
        found = "cpu"
    same = found.partition(":")[0] == then["device"].partition(":")[0]
    usual = then["engine"] if same else "auto"
    return replace(config, device=found, engine=engine or usual)


def _checkpoint(folder: RunFolder, steps: int) -> tuple[Json, int]:
    """Return the checkpoint that was evaluated."""
    for which in ("last", f"step_{steps}.pt", "best"):
        there = which == "last" or exists(folder.checkpoints.folder / (f"{which}.pt" if which == "best" else which))
        if there:
            found = checkpoint(folder, which, noted=True)
        else:
            found = None
        if found is not None and found[1] == steps:
            return found
    raise BidexError(
        f"The evaluation is of {steps:,} steps, and {folder.path} has no checkpoint of these: its newest is at "
        f"{folder.checkpoints.newest_step() or 0:,}. Evaluate anew: bidex-meta evaluate {folder.path} --json"
    )


def _again(
    folder: RunFolder, config: AnyConfig, worlds: Worlds, recorded: Json, num_envs: int | None, state: Json
) -> Json:
    """Repeat the recorded evaluation."""
    load = partial(policy_of, folder, state, config.device)
    if learner_kind(config.algo).make.adapts != ("splits" in recorded):
        if "splits" in recorded:
            kind = "a meta-test"
        else:
            kind = "no meta-test"
        raise BidexError(f"{folder.path}: the evaluation is {kind}, which is not how {config.algo} is judged.")
    if "splits" not in recorded:
        split = recorded.get("split", "train")
        episodes = recorded.get("policy", recorded)["episodes_per_task"]
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
        splits[split] = meta_test(worlds, config, load, options, [split])[split].to_json()
    return {"splits": splits}


def recorded_conditions(evaluation: Json, versions: Json, config: AnyConfig) -> Json:
    """Return the conditions as they were recorded; for older evaluations those that the run was trained with.

    Of the contents of ``evaluation.json`` and ``versions.json`` (empty where there is none), and the run's config.
    """
    found = {"device": config.device, "engine": config.engine, "num_envs": None}
    found |= {name: versions.get(name) for name in ("packages", "physics", "suite_version", "suite_digest")}
    found |= evaluation.get("conditions", {})
    packages = found["packages"]
    return found | {"packages": packages if isinstance(packages, dict) else {}}


def others(then: Json, now: Json) -> list[str]:
    """Return a text per condition that differs from its record; the last names conditions that were not recorded."""
    texts = list(map(str, differences(then, now)))
    where = ("device", "engine", "threads")
    texts += [f"{name} {then[name]} then, {now[name]} now" for name in where if then.get(name) not in (None, now[name])]
    packages = then["packages"]
    unknown = [name for name in now["packages"] if packages.get(name) is None]
    names = ("device", "engine", "physics", "suite_version")
    unknown += [name.replace("_", " ") for name in names if then.get(name) is None and now[name] is not None]
    return texts + ([f"not recorded: {', '.join(unknown)}"] if unknown else [])
