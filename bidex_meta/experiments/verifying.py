"""Verification of a run: its checkpoint is evaluated again, and compared with its recorded evaluation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError, one_line
from bidex_meta.evaluation.agreement import DIFFERS, EQUAL, WITHIN, Agreement, agreements
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.metatest import TASKS, Adaptation, Options, meta_test
from bidex_meta.experiments.policies import load_checkpoint, policy_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import (
    ClassSummary,
    Conditions,
    Evaluated,
    MetaTestEvaluation,
    OtherTasks,
    PolicyEvaluation,
    Summary,
    read_evaluation,
)
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.provenance import differences, versions_of
from bidex_meta.runs.versions import Versions
from bidex_meta.suite import OTHERS
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import exists
from bidex_meta.world.threads import set_up_torch, torch_settings_kept
from bidex_meta.worlds import Worlds, open_worlds


@dataclass(frozen=True)
class Verification:
    """The result of :func:`verify`."""

    run: RunFolder
    title: str
    steps: int
    """Environment steps that the policy was trained for."""
    conditions: Sequence[str]
    """Differences between the conditions of the two evaluations, one text for each."""
    classes: Sequence[Agreement]
    unverified: Sequence[str]
    """Recorded results that are not compared."""

    def count(self, outcome: str) -> int:
        """Return the number of classes with the given outcome: ``equal``, ``within`` or ``differs``.

        :mod:`bidex_meta.evaluation.agreement` defines these outcomes.
        """
        return sum(each.outcome == outcome for each in self.classes)

    @property
    def agrees(self) -> bool:
        """Return True if no class differs by more than the confidence intervals of the two evaluations allow."""
        return self.count(DIFFERS) == 0

    def to_json(self) -> Json:
        """Return the verification as a dict, ready for JSON: run, steps, conditions and results by class."""
        report: Json = {"run": str(self.run.path), "steps": self.steps, "conditions": list(self.conditions)}
        report |= {outcome: self.count(outcome) for outcome in (EQUAL, WITHIN, DIFFERS)}
        report["unverified"] = list(self.unverified)
        return report | {"classes": {each.name: each.to_json() for each in self.classes}}


@checked_arguments
@torch_settings_kept()
def verify(
    run: RunFolder | str | Path,
    *,
    evaluation: Path | None = None,
    device: str = "auto",
    engine: str | None = None,
    num_envs: int | None = None,
) -> Verification:
    """Repeat the recorded evaluation of a run's checkpoint, and compare the two evaluations class by class.

    Args:
        run: The run's folder.
        evaluation: A file that ``bidex-meta evaluate --json`` wrote for the run; None: the run's ``evaluation.json``.
        device: ``auto``, ``cpu`` or ``cuda:N``; auto: the device of the evaluation if this machine has it, else the
            CPU.
        engine: ``auto``, ``c`` or ``warp``; None: the engine of the evaluation, or ``auto`` on another device.
        num_envs: Environments stepped together; None: the number of the evaluation.

    Raises BidexError if the evaluation or its checkpoint is missing or damaged.
    """
    folder = RunFolder.open(run.path if isinstance(run, RunFolder) else run)
    config = folder.config()
    recorded = recorded_evaluation(folder.path, evaluation)
    then = recorded_conditions(recorded, versions_of(folder), config)
    config = _where(device, engine, then, config)
    worlds = open_worlds(config.to_json())
    set_up_torch(config.threads, config.deterministic)
    if num_envs is None:
        environments = then.num_envs
    else:
        environments = num_envs
    state, step = _checkpoint(folder, recorded.steps or 0)
    apart = others(then, conditions(worlds, environments))
    for line in apart:
        say(f"Conditions: {one_line(line)}.")
    again = _again(folder, config, worlds, recorded, environments, state)
    found = agreements(recorded.all_results, again)
    title = f"{config.algo} on {worlds.name}, {step:,} steps"
    return Verification(folder, title, step, apart, found, recorded.unverified)


def recorded_evaluation(run: Path, named: Path | None = None) -> Evaluated:
    """Return the evaluation of a run folder, or of another file, to compare with.

    Raises BidexError if the file is missing or damaged, or lacks entries that are needed to evaluate again.
    """
    path = named or run / "evaluation.json"
    again = f"bidex-meta evaluate {run} --json > {path}"
    if named is None and not exists(path):
        raise BidexError(f"{run} has no evaluation.json to verify. Let the run end, or write one: {again}")
    evaluation = read_evaluation(path, again)
    if evaluation.randomisation is not None:
        raise BidexError(f"{path}: expected an evaluation without --randomisation, got one with it. Name another.")
    if isinstance(evaluation, MetaTestEvaluation) and evaluation.agent is not None:
        raise BidexError(
            f"{path}: expected the evaluation of a run, got that of the agent {evaluation.agent}. Name another."
        )
    needed = {"steps": evaluation.steps, "seed": evaluation.seed}
    if isinstance(evaluation, PolicyEvaluation):
        needed["policy.episodes_per_task"] = evaluation.policy.episodes_per_task
        if evaluation.other_tasks is not None:
            needed["other_tasks.policy.episodes_per_task"] = evaluation.other_tasks.policy.episodes_per_task
            needed["other_tasks.task_seed"] = evaluation.other_tasks.task_seed
    else:
        for name, split in evaluation.splits.items():
            needed[f"splits.{name}.before.episodes_per_task"] = split.before.episodes_per_task
    for name, value in needed.items():
        if value is None:
            raise BidexError(f"{path}: {name}: expected it to be there, found none.")
    return evaluation


def _where(device: str, engine: str | None, then: Conditions, config: AnyConfig) -> AnyConfig:
    """Return the run's config with the device and engine to evaluate with."""
    on_gpu = open_worlds(config.to_json()).on_gpu
    recorded = then.device or config.device
    try:
        found = resolve_device(recorded if device == "auto" else device, on_gpu)
    except BidexError:
        if device != "auto":
            raise
        found = "cpu"
    same = found.partition(":")[0] == recorded.partition(":")[0]
    usual = then.engine if same else None
    return replace(config, device=found, engine=engine or usual or "auto")


def _checkpoint(folder: RunFolder, steps: int) -> tuple[Json, int]:
    """Return the run's checkpoint at ``steps`` environment steps, with which the recorded evaluation was made."""
    for which in ("last", f"step_{steps}.pt", "best"):
        there = which == "last" or exists(folder.checkpoints.folder / (f"{which}.pt" if which == "best" else which))
        if there:
            found = load_checkpoint(folder, which, noted=True)
        else:
            found = None
        if found is not None and found[1] == steps:
            return found
    raise BidexError(
        f"The evaluation is of {steps:,} steps, and {folder.path} has no checkpoint of these: its newest is at "
        f"{folder.checkpoints.newest_step() or 0:,}. Evaluate again: bidex-meta evaluate {folder.path} --json"
    )


def _again(
    folder: RunFolder, config: AnyConfig, worlds: Worlds, recorded: Evaluated, num_envs: int | None, state: Json
) -> dict[str, ClassSummary]:
    """Repeat the recorded evaluation, and return its results by class."""
    load = partial(policy_of, folder, state, config.device)
    seed = recorded.seed or 0
    adapts = Capability.ADAPTS in learner_kind(config.algo).capabilities
    if adapts != isinstance(recorded, MetaTestEvaluation):
        if isinstance(recorded, MetaTestEvaluation):
            kind = "a meta-test"
        else:
            kind = "no meta-test"
        raise BidexError(f"{folder.path}: the evaluation is {kind}, which is not how {config.algo} is evaluated.")
    if isinstance(recorded, PolicyEvaluation):
        own = _replayed(worlds, load(), recorded, seed, num_envs)
        others = recorded.other_tasks
        if others is not None:
            unseen = worlds.with_new_tasks(others.task_seed or 0)
            others = replace(others, policy=_replayed(unseen, load(), others, others.seed or seed, num_envs))
        return replace(recorded, policy=own, other_tasks=others).all_results
    splits = {}
    adaptation = Adaptation.of(worlds, config)
    for split, part in recorded.splits.items():
        if split not in (*worlds.splits, OTHERS):
            raise BidexError(f"{worlds.name} has no {split} tasks, which the evaluation is of.")
        if not part.rewards_shown:
            raise BidexError(
                f"{folder.path}: the evaluation hid the rewards of its episodes, as before version 0.3.0. Evaluate "
                f"again: bidex-meta evaluate {folder.path} --json"
            )
        options = Options(
            shots=part.shots, rollouts=part.rollouts, trials=part.trials, episodes=part.before.episodes_per_task,
            tasks=max(row.tasks or TASKS for row in part.before.classes.values()), num_envs=num_envs, seed=seed,
            hidden_rewards=part.hidden_by_shot is not None,
        )  # fmt: skip
        if part.max_adapt_steps is not None:
            adaptation = replace(adaptation, max_adapt_steps=part.max_adapt_steps)
        splits[split] = meta_test(worlds, adaptation, load, options, [split])[split].summary()
    return MetaTestEvaluation(splits=splits).all_results


def _replayed(
    worlds: Worlds, policy: Agent, recorded: PolicyEvaluation | OtherTasks, seed: int, num_envs: int | None
) -> Summary:
    """Repeat a recorded evaluation of a policy that does not adapt, on the tasks of ``worlds``."""
    world = worlds.world(recorded.split, num_envs)
    protocol = worlds.protocol(recorded.split, recorded.policy.episodes_per_task, seed)
    found = worlds.evaluate(policy, world, protocol)
    world.close()
    return found.summary()


def recorded_conditions(evaluation: Evaluated, versions: Versions, config: AnyConfig) -> Conditions:
    """Return the conditions of a recorded evaluation; missing entries are taken from the run's training."""
    recorded = evaluation.conditions
    return replace(
        recorded,
        device=recorded.device or config.device,
        engine=recorded.engine or config.engine,
        packages=recorded.packages or versions.packages,
        physics=recorded.physics or versions.physics,
        suite_version=versions.suite_version if recorded.suite_version is None else recorded.suite_version,
        suite_digest=recorded.suite_digest or versions.suite_digest,
    )


def others(then: Conditions, now: Conditions) -> list[str]:
    """Return a text for each difference between recorded and present conditions, and one for unrecorded conditions."""
    texts = list(map(str, differences(then, now)))
    for name in ("device", "engine", "threads"):
        recorded = getattr(then, name)
        present = getattr(now, name)
        if recorded not in (None, present):
            texts.append(f"{name} {recorded} then, {present} now")
    unknown = [name for name in now.packages if then.packages.get(name) is None]
    for name in ("device", "engine", "physics", "suite_version"):
        if getattr(then, name) is None and getattr(now, name) is not None:
            unknown.append(name.replace("_", " "))
    if unknown:
        texts.append(f"not recorded: {', '.join(unknown)}")
    return texts
