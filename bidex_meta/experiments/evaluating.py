"""Evaluations of a run's policy on tasks of its suite, and meta-tests of runs and of other agents that adapt."""

from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from bidex_meta.agents import Agent, TrialAgent
from bidex_meta.config import Switch
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.meta_test import MetaEvaluation
from bidex_meta.evaluation.play import RandomAgent
from bidex_meta.evaluation.results import Evaluation, compare
from bidex_meta.evaluation.trial_agents import adapting
from bidex_meta.experiments import metatest
from bidex_meta.experiments.conditions import conditions
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.metatest import Adaptation, EvaluationSize, Options, Played
from bidex_meta.experiments.policies import load_checkpoint, policy_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import (
    Conditions,
    MetaTestEvaluation,
    OtherTasks,
    PolicyEvaluation,
    evaluation_json,
    write_evaluation,
)
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.training.launch import launch, say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Environments, Few, Seed, Shots, check_fields
from bidex_meta.utils.waiting import note
from bidex_meta.world.threads import set_up_torch, torch_settings_kept
from bidex_meta.worlds import Worlds, open_worlds


@dataclass(frozen=True)
class PlayedTasks:
    """A policy's evaluation on the tasks of one split."""

    worlds: Worlds
    split: str
    seed: int
    """Seed of the episodes' starts."""
    policy: Evaluation
    random: Evaluation | None
    """The evaluation of a random policy on the same tasks, if it was requested."""

    @property
    def success(self) -> float:
        """Return the mean over classes of the success rate, in [0, 1]."""
        return self.policy.success

    def entries(self) -> dict[str, Any]:
        """Return the fields that both kinds of evaluation records have, by name.

        The kinds are :class:`PolicyEvaluation`, for tasks that the run was trained on or test tasks, and
        :class:`OtherTasks`, for tasks that the run was not trained on.
        """
        entries = {"split": self.split, "seed": self.seed, "policy": self.policy.summary()}
        if self.random is not None:
            differences = compare(self.policy, self.random)
            entries |= {"random": self.random.summary(), "return_above_random": differences}
        return entries


@dataclass(frozen=True)
class RunEvaluation:
    """The result of :func:`evaluate`."""

    run: RunFolder
    algo: str
    worlds: Worlds
    steps: int
    """Environment steps that the policy was trained for."""
    own: PlayedTasks
    others: PlayedTasks | None
    """The evaluation on tasks that the run was not trained on, if it was requested."""
    conditions: Conditions

    @property
    def success(self) -> float:
        """Return the mean over classes of the success rate, in [0, 1]."""
        return self.own.success

    def record(self) -> PolicyEvaluation:
        """Return the record of the evaluation, as ``evaluation.json`` holds it."""
        if self.others is None:
            others = None
        else:
            others = OtherTasks(task_seed=self.others.worlds.seed, steps=self.steps, **self.others.entries())
        return PolicyEvaluation(
            run=portable(str(self.run.path)), steps=self.steps, other_tasks=others, conditions=self.conditions,
            randomisation=_randomised(self.worlds), **self.own.entries()
        )  # fmt: skip

    def to_json(self) -> Json:
        """Return the content of ``evaluation.json``."""
        return evaluation_json(self.record())


@dataclass(frozen=True)
class RunMetaTest:
    """The result of :func:`meta_test`."""

    run: RunFolder | None
    """The run; None for the caller's own agent."""
    algo: str
    """Name of the learner, or of the agent's class."""
    worlds: Worlds
    steps: int | None
    """Environment steps that the learner was meta-trained for; None for the caller's own agent."""
    adapts_per_environment: bool
    """True if each environment adapts only to its own episodes, of which a shot has one."""
    seed: int
    splits: dict[str, MetaEvaluation]
    """Results before and after adaptation by split: ``train``, ``test`` or ``others``."""
    conditions: Conditions

    @property
    def success(self) -> dict[str, list[float]]:
        """Return the mean over classes of the success rate after 0, 1, ... shots, in [0, 1], for each split."""
        return {split: [shot.success for shot in found.by_shot] for split, found in self.splits.items()}

    def record(self) -> MetaTestEvaluation:
        """Return the record of the meta-test, as ``evaluation.json`` holds it."""
        subject: dict[str, Any] = {"agent": self.algo, "suite": self.worlds.short_name, "task_seed": self.worlds.seed}
        if self.run is not None:
            subject = {"run": portable(str(self.run.path))}
        splits = {split: found.summary() for split, found in self.splits.items()}
        return MetaTestEvaluation(
            steps=self.steps, seed=self.seed, splits=splits, conditions=self.conditions,
            randomisation=_randomised(self.worlds), **subject
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write the content of ``evaluation.json`` to a file."""
        write_evaluation(Path(path), self.record())

    def to_json(self) -> Json:
        """Return the content of ``evaluation.json``."""
        return evaluation_json(self.record())


@dataclass(frozen=True, kw_only=True)
class FinalEvaluation(EvaluationSize):
    """The evaluation at the end of training."""

    other_tasks: Switch = False
    """In the final evaluation, also play tasks of the train classes that the run was not trained on. For learners that
    adapt, use --split others instead."""
    split: Played = "auto"
    """Tasks of the final evaluation of learners that adapt (maml, promp, rl2, ...). auto: train and test tasks (on
    ML20, tasks of fifteen train classes and of five unseen classes). others: tasks of the train classes that the run
    was not trained on. unseen: others and test."""

    def check(self, config: AnyConfig) -> None:
        """Raise BidexError for a bad value, or for an option that the learner of a resolved config does not support."""
        check_fields(self, "run", as_flags=True)
        adapts = Capability.ADAPTS in learner_kind(config.algo, config.task).capabilities
        if adapts:
            if self.other_tasks:
                raise BidexError(f"{config.algo} adapts: --split others plays unseen tasks of its train classes.")
            metatest.splits_of(open_worlds(config.to_json()), self.split)
            return
        if self.other_tasks:
            _ = open_worlds(config.to_json()).others  # raises BidexError if there are no unseen tasks
        if self.split != "auto":
            raise BidexError(f"{config.algo} does not adapt to tasks, got --split {self.split}. Leave it out.")
        self.refuse_adaptation(config.algo)

    def play(self, run: RunFolder, config: AnyConfig) -> "RunEvaluation | RunMetaTest":
        """Evaluate a run on the device that it was trained on, and write its ``evaluation.json``."""
        device = launch().own_device(config.device)
        if Capability.ADAPTS in learner_kind(config.algo, config.task).capabilities:
            size = {entry.name: getattr(self, entry.name) for entry in fields(EvaluationSize)}
            return meta_test(run, split=self.split, device=device, engine=config.engine, save=True, **size)
        return evaluate(
            run, episodes=self.episodes, random=True, other_tasks=self.other_tasks, device=device,
            engine=config.engine, save=True,
        )  # fmt: skip


USUAL_EVALUATION = FinalEvaluation()


@checked_arguments
@torch_settings_kept()
def evaluate(
    run: RunFolder | str | Path,
    *,
    split: str = "train",
    checkpoint: str = "last",
    random: bool = False,
    other_tasks: bool = False,
    episodes: Few | None = None,
    num_envs: Environments | None = None,
    seed: Seed = Options.seed,
    randomisation: str | Path | None = None,
    device: str = "auto",
    engine: str = "auto",
    save: bool = False,
) -> RunEvaluation:
    """Evaluate the mean action of a run's policy, with the same number of episodes of every task.

    Args:
        run: The run's folder.
        split: ``train``: the tasks that the run was trained on; if ``tasks_per_class`` is 0, training drew a new
            task in each episode, and the evaluation uses tasks that training never draws. ``test``: the test tasks of a
            meta suite.
        checkpoint: ``last``, ``best`` or a file.
        random: Whether a random policy is also evaluated on the same tasks.
        other_tasks: Whether the policy is also evaluated on the same number of tasks that no run was trained on.
        episodes: Episodes of each task; None: 4, or 1 if a task has a fixed start.
        num_envs: Environments stepped together, a multiple of the number of tasks; None: one per task.
        seed: Seed of the start states of the episodes. Training never uses the default seed.
        randomisation: A TOML file with the randomisation of the worlds (docs/randomisation.md).
        device: ``auto``, ``cpu`` or ``cuda:N``.
        engine: ``auto``, ``c`` or ``warp``.
        save: Whether the result is written to the run's ``evaluation.json``.

    Raises BidexError if the run has no such checkpoint or split, or if its learner adapts to tasks; for these learners,
    call :func:`meta_test`.
    """
    folder = _opened(run)
    config, worlds = _set_up(folder, device, engine, randomisation)
    if Capability.ADAPTS in learner_kind(config.algo, config.task).capabilities:
        raise BidexError(f"{config.algo} adapts to tasks, so its unadapted policy says little. Use meta_test(run).")
    state, steps = load_checkpoint(folder, checkpoint)
    policy = policy_of(folder, state, config.device)
    size = Options(episodes=episodes, num_envs=num_envs, seed=seed)
    count = episodes or worlds.default_episodes
    if random:
        beside = ", and the same of a random policy"
    else:
        beside = ""
    unseen = worlds.others if other_tasks else None
    say(f"Evaluating: {count} episode{'s' * (count > 1)} of each task{beside}.")
    own = _played(worlds, policy, split, size, random)
    others = None
    if unseen is not None:
        others = _played(unseen, policy, split, size, random)
    found = RunEvaluation(folder, config.algo, worlds, steps, own, others, conditions(worlds, num_envs))
    if save:
        write_evaluation(folder.evaluation_path, found.record())
    return found


@checked_arguments
@torch_settings_kept()
def meta_test(
    agent: RunFolder | str | Path | TrialAgent | Agent,
    suite: str | Path | None = None,
    *,
    split: str = "auto",
    checkpoint: str = "last",
    shots: Shots | None = None,
    rollouts: Few | None = None,
    episodes: Few | None = None,
    tasks: Few | None = None,
    trials: Few | None = None,
    num_envs: Environments | None = None,
    seed: Seed = Options.seed,
    task_seed: Seed | None = None,
    hidden_rewards: bool = False,
    randomisation: str | Path | None = None,
    device: str = "auto",
    engine: str = "auto",
    save: bool = False,
) -> RunMetaTest:
    """Evaluate an agent before and after it adapts to tasks.

    Args:
        agent: The folder of a run whose learner adapts; or your own agent, a ``TrialAgent`` or ``MetaLearningAgent``.
        suite: For an agent: name or file of a suite that hides its goals. A run has its own suite.
        split: ``train``; ``test``; ``others``, tasks of the train classes that no run was trained on; ``unseen``,
            others and test; or ``auto``, train and test tasks.
        checkpoint: For a run: ``last``, ``best`` or a file.
        shots: Adaptation rounds, one after the other; None: 2.
        rollouts: Episodes of each task in a shot. None: for a run, the number in training, but at most 40; for an
            agent, 10.
        episodes: Evaluation episodes of each task; None: the number of rollouts.
        tasks: Number of tasks of each class, the first ones of the class's pool; None: 5.
        trials: Number of adaptations to each task, each from the unadapted agent and with new episodes; None: enough
            for five adaptations per class.
        num_envs: Maximum number of environments stepped together; None: 1024.
        seed: Seed of the start states of the episodes. Training never uses the default seed.
        task_seed: For an agent: seed that draws the tasks, as in ``Benchmark(suite, task_seed)``; None: 0.
        hidden_rewards: Whether the evaluation episodes are also played with their rewards hidden.
        randomisation: A TOML file with the randomisation of the worlds (docs/randomisation.md).
        device: ``auto``, ``cpu`` or ``cuda:N``.
        engine: ``auto``, ``c`` or ``warp``.
        save: Whether the result is written to the run's ``evaluation.json``; for an agent, call ``result.save(path)``.

    Raises BidexError for a run without such a checkpoint or split, for learners and agents that do not adapt, and for
    suites that show their goals.
    """
    if isinstance(agent, RunFolder | str | Path):
        folder = _opened(agent)
        for name, value in (("suite", suite), ("task_seed", task_seed)):
            if value is not None:
                raise BidexError(f"meta_test: {name}: a run has its own, got {value}. Leave {name} out.")
        config, worlds = _set_up(folder, device, engine, randomisation)
        if Capability.ADAPTS not in learner_kind(config.algo, config.task).capabilities:
            raise BidexError(f"{config.algo} does not adapt to tasks. Use evaluate(run).")
        metatest.check_worlds(worlds, config.algo)
        state, steps = load_checkpoint(folder, checkpoint)
        adaptation = Adaptation.of(worlds, config)
        load = partial(policy_of, folder, state, config.device)
    else:
        if suite is None:
            raise BidexError(
                'meta_test: suite: expected the suite to play, got None: meta_test(agent, "ML1-Switch-v2").'
            )
        if save or checkpoint != "last":
            raise BidexError("meta_test: save and checkpoint are for runs. Leave both out, and call result.save(path).")
        folder = None
        steps = None
        worlds = _worlds_of(str(suite), task_seed or 0, device, engine, randomisation)
        load = partial(adapting, agent)
        adaptation = Adaptation(type(agent).__name__, is_per_environment=not hasattr(agent, "assign"))
        metatest.check_worlds(worlds, adaptation.name)
    options = Options(
        shots=shots, rollouts=rollouts, episodes=episodes, tasks=tasks, trials=trials, num_envs=num_envs, seed=seed,
        hidden_rewards=hidden_rewards,
    )  # fmt: skip
    found = metatest.meta_test(worlds, adaptation, load, options, metatest.splits_of(worlds, split))
    played = conditions(worlds, options.num_envs)
    result = RunMetaTest(
        folder, adaptation.name, worlds, steps, adaptation.is_per_environment, options.seed, found, played
    )
    if save and folder is not None:
        result.save(folder.evaluation_path)
    return result


def _worlds_of(suite: str, seed: int, device: str, engine: str, randomisation: str | Path | None) -> Worlds:
    """Open the suite on which a user's own agent is evaluated, with the device and engine to use."""
    config: Json = {"suite": suite, "seed": seed, "engine": engine}
    config["randomisation"] = None if randomisation is None else str(randomisation)
    on_gpu = open_worlds(config).on_gpu
    return open_worlds({**config, "device": resolve_device(device, on_gpu)})


def _randomised(worlds: Worlds) -> Json | None:
    """Return the randomisation of worlds as a dict; None if there is none."""
    if worlds.randomisation is None:
        return None
    return asdict(worlds.randomisation)


def _opened(run: RunFolder | str | Path) -> RunFolder:
    return RunFolder.open(run.path if isinstance(run, RunFolder) else run)


def _set_up(folder: RunFolder, device: str, engine: str, randomisation: str | Path | None) -> tuple[AnyConfig, Worlds]:
    """Return the run's config with the device and engine to evaluate with, and the run's worlds."""
    stored = folder.config()
    device = resolve_device(device, open_worlds(stored.to_json()).on_gpu)
    config = replace(stored, device=device, engine=engine)
    if randomisation is None:
        file = None
    else:
        file = str(randomisation)
    worlds = open_worlds({**config.to_json(), "randomisation": file})
    set_up_torch(config.threads, config.deterministic)
    return config, worlds


def _played(worlds: Worlds, policy: Agent, split: str, size: Options, random: bool) -> PlayedTasks:
    note(f"Building the world of {worlds.name}")
    world = worlds.world(split, size.num_envs)
    protocol = worlds.protocol(split, size.episodes, size.seed)
    found = worlds.evaluate(policy, world, protocol)
    if random:
        other = worlds.evaluate(RandomAgent(world.action_space), world, protocol)
    else:
        other = None
    world.close()
    return PlayedTasks(worlds, split, protocol.seed, found, other)
