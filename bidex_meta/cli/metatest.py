"""The meta-test of a run whose learner adapts: its worlds, its defaults, its tables, its JSON."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bidex_meta.agents import Agent
from bidex_meta.cli.learners import learner_kind
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import EVALUATION_SEED
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.worlds import Worlds

SHOTS = 1
"""Shots where nobody says otherwise."""
TASKS = 5
"""Tasks of each class, the first of its pool, where nobody says otherwise: all of ML1's, a tenth of ML20's."""
ROLLOUTS = 10
"""Episodes of each task in a shot, where neither flags nor the run's config say otherwise."""
MOST_ROLLOUTS = 40
"""The most that are taken from the run's config: ML1's three tasks may be trained with hundreds."""
ROWS = 1024
"""Rows stepped together at most, where nobody says otherwise: half a GB for the world."""


@dataclass(frozen=True)
class Options:
    """How much is played; None: as the run was trained, else the default above."""

    shots: Shots | None = None
    """Shots of adaptation."""
    rollouts: Few | None = None
    """Episodes of each task in a shot."""
    episodes: Few | None = None
    """Evaluation episodes of each task; None: as many as rollouts, which the same rows play at once."""
    tasks: Few | None = None
    """Tasks of each class."""
    trials: Few | None = None
    """Adaptations of each task; None: so many that a class has as many as ``TASKS``, since an interval over the
    episodes of a single adaptation says nothing of another."""
    num_envs: Environments | None = None
    """Rows stepped together at most."""
    seed: Seed = EVALUATION_SEED
    """Of all starts."""


def meta_test(
    source: Worlds,
    config: RunConfig[Any],
    load: Callable[[], Agent],
    options: Options,
    splits: list[str],
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """The meta-test on some of a run's splits.

    Args:
        source: Of the run's worlds.
        config: The run's config; read are ``algo``, ``num_envs`` and ``learner``.
        load: Makes the agent, a MetaLearningAgent; called anew for each split, so that neither depends on the other.
        options: How much is played.
        splits: Out of ``source.splits``.
        say: Told what begins.

    Returns:
        A MetaEvaluation for each split, by its name.

    Raises:
        BidexError: The suite shows its tasks, or a number is out of range.
    """
    from bidex_meta.evaluation.meta_test import MAX_ADAPT_STEPS, meta_evaluate

    check_source(source, config.algo)
    check_numbers(options, "rollouts", "episodes", "tasks", "trials", "num_envs")
    found = {}
    limit = options.num_envs or ROWS
    for split in splits:
        counts = [len(pool) for pool in source.tasks(split).values()]
        rollouts = rollouts_of(source, config, options.rollouts, max(1, limit // len(counts)))
        tasks = min(options.tasks or TASKS, max(counts))
        trials = options.trials or -(-TASKS // tasks)
        rows = rows_for(len(counts), tasks * trials, rollouts, limit)
        shots = SHOTS if options.shots is None else options.shots
        episodes = options.episodes or rollouts
        often = f", each {trials} times" if trials > 1 else ""
        say(
            f"Meta-test on {split} tasks: {len(counts)} class{'es' * (len(counts) > 1)}, {tasks} of {max(counts)} "
            f"tasks of each{often}, {shots} shot{'s' * (shots != 1)} of {rollouts} episodes, {episodes} evaluation "
            f"episodes, {rows} rows."
        )
        world = source.world(split, rows)
        found[split] = meta_evaluate(
            load(),
            world,
            shots,
            rollouts=rollouts,
            episodes_per_task=episodes,
            tasks=tasks,
            trials=trials,
            max_adapt_steps=config.learner_values.get("max_adapt_steps", MAX_ADAPT_STEPS),
            seed=options.seed,
            references=source.references(),
            split=split,
        )
        world.close()
    return found


def rollouts_of(source: Worlds, config: RunConfig[Any], asked: int | None, rows: int) -> int:
    """Episodes of each task in a shot.

    Args:
        source: Of the run's worlds.
        config: The run's config.
        asked: What the user wants; None: what the run was trained with.
        rows: Rows that a class has at most. Where each row learns from its own episodes alone it must have no second
            one in a shot: then there are fewer.
    """
    rollouts = asked or trained_rollouts(source, config)
    return min(rollouts, rows) if learner_kind(config.algo).make.independent_adaptation else rollouts


def trained_rollouts(source: Worlds, config: RunConfig[Any]) -> int:
    """Episodes of each task that the run's learner adapted to."""
    of_batch = config.learner_values.get("tasks_per_class")
    if of_batch is None:
        return ROLLOUTS
    counts = [len(pool) for pool in source.tasks("train").values()]
    of_class = config.num_envs // len(counts)
    return max(1, min(of_class // min(of_batch, max(counts)), MOST_ROLLOUTS))


def check_numbers(options: Any, *names: str) -> None:
    """Refuse fields below 1; None is whatever the default is.

    Raises:
        BidexError: One is.
    """
    for name in names:
        number = getattr(options, name)
        if number is not None and number < 1:
            raise BidexError(f"--{name.replace('_', '-')} must be at least 1, not {number}.")


def check_source(source: Worlds, algo: str) -> None:
    """Refuse a source on which there is no meta-test.

    Raises:
        BidexError: It shows its tasks: it is Meta-World's, multi-task or a class alone.
    """
    if not source.hides_goals:
        raise BidexError(
            f"{algo} adapts to hidden goals, but {source.name} shows them. Name an ML suite: "
            "--suite ML1, ML4, ML20, or a file of kind meta."
        )


def splits_of(source: Worlds, asked: str) -> list[str]:
    """The splits that a meta-test plays.

    Args:
        source: Of the run's worlds.
        asked: A split's name; ``both`` or ``auto``: all there are.

    Raises:
        BidexError: The source has no such split.
    """
    if asked in ("train", "test") and asked not in source.splits:
        raise BidexError(f"{source.name} has no {asked} tasks. Leave --split out.")
    return [name for name in source.splits if asked in ("auto", "both", name)]


def rows_for(classes: int, adaptations: int, rollouts: int, limit: int) -> int:
    """Rows of a world that plays as many adaptations of each class at once as the limit allows.

    Args:
        classes: Classes of the world.
        adaptations: Adaptations (tasks times trials) of each class.
        rollouts: Rows each takes, if there are so many; else it takes several rounds.
        limit: Rows at most, but never fewer than one for each class.
    """
    of_class = max(1, limit // classes)
    if of_class < rollouts:
        # A divisor, so that every row plays in every round.
        return classes * max(number for number in range(1, of_class + 1) if rollouts % number == 0)
    portions = -(-adaptations // (of_class // rollouts))
    return classes * -(-adaptations // portions) * rollouts


def report(found: dict[str, Any]) -> dict[str, Any]:
    """All splits, ready for JSON; what ``evaluation.json`` of such a run holds under ``splits``."""
    return {split: result.to_json() for split, result in found.items()}


def print_tables(subject: str, found: dict[str, Any]) -> None:
    """For each split a table before adaptation and one after, the latter with the gains."""
    from bidex_meta.cli.tables import evaluation_table, print_table

    for split, result in found.items():
        shots = len(result.adapt_steps)
        print_table(evaluation_table(f"{subject}, {split} tasks, before adaptation", result.before))
        if shots:
            title = f"{subject}, {split} tasks, after {shots} shot{'s' * (shots > 1)} of {result.rollouts} episodes"
            print_table(evaluation_table(title, result.after, gains=result.gains()))
