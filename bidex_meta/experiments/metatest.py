"""Run a meta-test, which evaluates an agent before and after it adapts, and choose its number of environments."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from bidex_meta.agents import Agent
from bidex_meta.config import RunConfig, Switch
from bidex_meta.errors import BidexError, shortened
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.evaluation.meta_test import MetaEvaluation, meta_evaluate
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.suite import OTHERS
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.utils.waiting import note
from bidex_meta.worlds import Worlds

Played = Literal["auto", "train", "test", "others", "unseen"]
"""Words for the splits that an evaluation plays."""
TASKS = 5  # default tasks of each class, the first of its pool: all of ML1's, a tenth of ML20's
# default episodes of a task in a shot, if the config sets no number; the largest number taken from a config
_ROLLOUTS = 10
_MOST_ROLLOUTS = 40
ENVIRONMENTS = 1024  # default maximum of environments stepped together; the world needs half a GB


@dataclass(frozen=True, kw_only=True)
class EvaluationSize:
    """The tasks and episodes of an evaluation at the end of training (``bidex-meta run``) or of a stored run."""

    episodes: Few | None = None
    """Evaluation episodes of each task; None: 4, or 1 if a task has a fixed start (metaworld/...); for learners that
    adapt, the number of --rollouts."""
    shots: Shots | None = None
    """Adaptation rounds of an evaluation, one after the other, of --rollouts episodes each; None: 2."""
    rollouts: Few | None = None
    """Episodes of each task in one of these rounds; None: as in training, at most 40 (if not set: 10)."""
    tasks: Few | None = None
    """Number of tasks of each class to adapt to in an evaluation, the first of its pool; None: 5."""
    hidden_rewards: Switch = False
    """For learners that adapt: also play the evaluation episodes with their rewards hidden."""

    def refuse_adaptation(self, algo: str) -> None:
        """Raise BidexError if an option is given that only concerns adaptation."""
        for name in ("shots", "rollouts", "tasks", "trials"):
            number = vars(self).get(name)
            if number is not None:
                raise BidexError(f"{algo} does not adapt to tasks, got --{name} {number}. Leave it out.")
        if self.hidden_rewards:
            raise BidexError(f"{algo} does not adapt to tasks, got --hidden-rewards. Leave it out.")


@dataclass(frozen=True, kw_only=True)
class Options(EvaluationSize):
    """Options of a meta-test or an evaluation of a stored run: also trials, environments and seed."""

    trials: Few | None = None
    """Number of adaptations to each task, each from the unadapted policy and with new episodes; None: 1, or enough for
    five adaptations per class. Several are needed because the episodes after one adaptation show nothing about other
    adaptations."""
    num_envs: Environments | None = None
    """Environments stepped together, a multiple of the number of tasks. None: one per task (metaworld/...: 5 per
    class). For learners that adapt: the maximum number, which bounds memory and does not change the protocol; None:
    1024."""
    seed: Seed = EVALUATION_SEED
    """Seed of the start states of the evaluation episodes. Training never uses the default seed."""


@dataclass(frozen=True)
class Adaptation:
    """The facts about an agent's adaptation that the size of its meta-test depends on."""

    name: str
    """Name of the learner or of the agent's class."""
    rollouts: int = _ROLLOUTS
    """Default number of episodes of each task in a shot."""
    max_adapt_steps: int | None = None
    """Longest episode that the agent adapts to, in steps; None: whole episodes."""
    is_per_environment: bool = True
    """True if each environment adapts only from its own episodes."""

    @staticmethod
    def of(worlds: Worlds, config: RunConfig) -> "Adaptation":
        """Return the facts about a run's learner that determine the size of its meta-test.

        The number of episodes per task in a shot is the number in training, but at most 40.
        """
        rollouts = _ROLLOUTS
        of_batch = config.learner_values.get("tasks_per_class")
        if of_batch is not None:
            counts = [len(pool) for pool in worlds.tasks("train").values()]
            of_class = config.num_envs // len(counts)
            rollouts = max(1, min(of_class // min(of_batch, max(counts)), _MOST_ROLLOUTS))
        capabilities = learner_kind(config.algo).capabilities
        longest = config.learner_values.get("max_adapt_steps")
        return Adaptation(config.algo, rollouts, longest, Capability.ADAPTS_INDEPENDENTLY in capabilities)


def meta_test(
    worlds: Worlds, adaptation: Adaptation, load: Callable[[], Agent], options: Options, splits: list[str]
) -> dict[str, MetaEvaluation]:  # fmt: skip
    """Play the meta-test on some splits of worlds.

    ``load`` makes a new MetaLearningAgent for each split, so that the splits do not influence each other.
    """
    check_worlds(worlds, adaptation.name)
    found = {}
    for split in splits:
        if split == OTHERS:
            source = worlds.others
        else:
            source = worlds
        part = "train" if split == OTHERS else split
        counts = [len(pool) for pool in source.tasks(part).values()]
        limit = options.num_envs or ENVIRONMENTS
        protocol = _protocol(adaptation, options, split, counts, limit)
        rollouts = protocol.rollouts or 1
        num_envs = environments_for(len(counts), (protocol.tasks or 1) * protocol.trials, rollouts, limit)
        if protocol.trials > 1:
            often = f", each {protocol.trials} times"
        else:
            often = ""
        kind = "other" if split == OTHERS else split
        say(
            f"Meta-test on {kind} tasks: {len(counts)} class{'es' * (len(counts) > 1)}, {protocol.tasks} of "
            f"{max(counts)} tasks of each{often}, {protocol.shots} shot{'s' * (protocol.shots != 1)} of {rollouts} "
            f"episodes, {protocol.episodes_per_task} evaluation episodes, {num_envs} environments."
        )
        note(f"Building the world of {source.name}")
        world = source.world(part, num_envs)
        found[split] = meta_evaluate(load(), world, protocol=protocol, references=source.references())
        world.close()
    return found


def _protocol(adaptation: Adaptation, options: Options, split: str, counts: list[int], limit: int) -> Protocol:
    """Return the protocol of a meta-test on one split: numbers of tasks, episodes and adaptations.

    ``counts`` has the number of tasks of each class, and ``limit`` is the maximum number of environments.
    """
    rollouts = rollouts_of(adaptation, options.rollouts, max(1, limit // len(counts)))
    tasks = min(options.tasks or TASKS, max(counts))
    protocol = Protocol(
        split, options.seed, tasks, rollouts=rollouts,
        episodes_per_task=options.episodes or rollouts,  # the same environments play these episodes at once
        trials=options.trials or -(-TASKS // tasks), hidden_rewards=options.hidden_rewards,
        max_adapt_steps=adaptation.max_adapt_steps
    )  # fmt: skip
    return protocol.changed(shots=options.shots)


def rollouts_of(adaptation: Adaptation, asked: int | None, most: int) -> int:
    """Return the number of episodes of each task in a shot: ``asked``, or the agent's default if ``asked`` is None.

    If each environment adapts only from its own episodes, it plays one episode per shot. The number of episodes is then
    limited to ``most``, the largest number of environments per class.
    """
    rollouts = asked or adaptation.rollouts
    if adaptation.is_per_environment:
        return min(rollouts, most)
    return rollouts


def environments_for(classes: int, adaptations: int, rollouts: int, limit: int) -> int:
    """Return the number of environments that allows the largest number of simultaneous adaptations.

    There are ``adaptations`` (tasks times trials) per class. Each adaptation takes ``rollouts`` environments, or
    several rounds in fewer environments. ``limit`` is the maximum number of environments, but each class gets at least
    one.
    """
    of_class = max(1, limit // classes)
    if of_class < rollouts:
        # The number is a divisor, so that every environment plays in every round.
        return classes * max(number for number in range(1, of_class + 1) if rollouts % number == 0)
    portions = -(-adaptations // (of_class // rollouts))
    return classes * -(-adaptations // portions) * rollouts


def check_worlds(worlds: Worlds, name: str) -> None:
    """Raise BidexError if observations show the task, so that there is nothing to adapt to.

    This is true of Meta-World, multi-task suites and single classes. ``name`` is the agent's name for the message.
    """
    if not worlds.hides_goals:
        raise BidexError(
            f"{name} adapts to hidden goals, but {worlds.name} shows them. Name an ML suite (ML1-v2, ML5-v2, ML20-v2, "
            "ML1-CLASS-v2 for any class) or a file of kind meta."
        )


def splits_of(worlds: Worlds, asked: str) -> list[str]:
    """Return the splits that a meta-test plays: the named split, all splits for ``auto``, two for ``unseen``.

    Raises BidexError for another word, and for a split or unseen tasks that the worlds do not have.
    """
    if asked not in get_args(Played):
        raise BidexError(f"split: expected one of {', '.join(get_args(Played))}, got {shortened(asked)}.")
    if asked in (OTHERS, "unseen"):
        _ = worlds.others  # raises BidexError if there are no unseen tasks
    if asked == OTHERS:
        return [OTHERS]
    wanted = "test" if asked == "unseen" else asked
    if wanted in ("train", "test") and wanted not in worlds.splits:
        raise BidexError(f"{worlds.name} has no {wanted} tasks. Leave --split out.")
    found = [name for name in worlds.splits if wanted in ("auto", name)]
    return [OTHERS, *found] if asked == "unseen" else found
