"""The meta-test of a run whose learner adapts: its size, its worlds, its tables."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from bidex_meta.agents import Agent
from bidex_meta.cli.learners import learner_kind
from bidex_meta.cli.tables import evaluation_table, print_table
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.meta_test import MAX_ADAPT_STEPS, MetaEvaluation, meta_evaluate
from bidex_meta.evaluation.play import EVALUATION_SEED
from bidex_meta.utils.validation import Environments, Few, Seed, Shots
from bidex_meta.utils.waiting import note
from bidex_meta.worlds import Worlds

OTHER_SEED = 500_000  # added to a run's seed for tasks that it was not trained on
OTHERS = "others"  # the split of train classes with such tasks
TASKS = 5  # default tasks of each class, the first of its pool: all of ML1's, a tenth of ML20's
_ROLLOUTS, _MOST_ROLLOUTS = 10, 40  # episodes of a task in a shot where the config has none; the most taken from it
_ENVIRONMENTS = 1024  # environments stepped together at most, by default: half a GB for the world


@dataclass(frozen=True, kw_only=True)
class Options:
    """How much an evaluation plays."""

    episodes: Few | None = None
    """Episodes of each task; None: 4, or 1 where a task fixes its start (metaworld/...); for learners that adapt, as
    many as --rollouts."""
    shots: Shots | None = None  # Adapt so often, one after the other, to --rollouts episodes each; None: 1.
    rollouts: Few | None = None  # Episodes of each task in a shot; None: as the run was trained, 40 at most, else 10.
    tasks: Few | None = None  # Adapt to the first so many tasks of each class; None: 5.
    trials: Few | None = None
    """Adapt to each task so often, each time from the start and to other episodes; None: once, or as often as makes
    five adaptations of each class, since an interval over one adaptation's episodes says nothing of another."""
    num_envs: Environments | None = None
    """Environments stepped together, a multiple of the number of tasks; None: one per task (metaworld/...: 5 per
    class). For learners that adapt, at most so many, which bounds memory and not results' meaning; None: 1024."""
    seed: Seed | None = None  # Seed of the episodes' starts; None: one that training does not use.

    @property
    def starts(self) -> int:
        """The seed of the episodes' starts."""
        return EVALUATION_SEED if self.seed is None else self.seed


def meta_test(
    worlds: Worlds, config: RunConfig, load: Callable[[], Agent], options: Options, splits: list[str],
    say: Callable[[str], None] = lambda text: None
) -> dict[str, MetaEvaluation]:  # fmt: skip
    """The meta-test on some splits of a run's worlds.

    ``load`` makes a MetaLearningAgent, anew for each split, so that neither depends on the other; of the config
    ``algo``, ``num_envs`` and ``learner`` are read; ``say`` is called with what begins.
    """
    check_worlds(worlds, config.algo)
    found, own = {}, worlds
    limit = options.num_envs or _ENVIRONMENTS
    for name in splits:
        worlds, split = (others_of(own), "train") if name == OTHERS else (own, name)
        counts = [len(pool) for pool in worlds.tasks(split).values()]
        rollouts = rollouts_of(worlds, config, options.rollouts, max(1, limit // len(counts)))
        tasks = min(options.tasks or TASKS, max(counts))
        trials = options.trials or -(-TASKS // tasks)
        num_envs = environments_for(len(counts), tasks * trials, rollouts, limit)
        shots = 1 if options.shots is None else options.shots
        episodes = options.episodes or rollouts  # which the same environments play at once
        often = f", each {trials} times" if trials > 1 else ""
        kind = "other" if name == OTHERS else name
        say(
            f"Meta-test on {kind} tasks: {len(counts)} class{'es' * (len(counts) > 1)}, {tasks} of {max(counts)} "
            f"tasks of each{often}, {shots} shot{'s' * (shots != 1)} of {rollouts} episodes, {episodes} evaluation "
            f"episodes, {num_envs} environments."
        )
        note(f"Building the world of {worlds.name}")
        world = worlds.world(split, num_envs)
        found[name] = meta_evaluate(
            load(), world, shots, rollouts=rollouts, episodes_per_task=episodes, tasks=tasks, trials=trials,
            max_adapt_steps=adapt_steps_of(config), seed=options.starts, references=worlds.references(), split=name,
        )  # fmt: skip
        world.close()
    return found


def adapt_steps_of(config: RunConfig) -> int:
    """Longest episode that a run's learner adapts to."""
    return config.learner_values.get("max_adapt_steps", MAX_ADAPT_STEPS)


def rollouts_of(worlds: Worlds, config: RunConfig, asked: int | None, most: int) -> int:
    """Episodes of each task in a shot: as asked, else as the run was trained.

    ``most`` are the environments that a class has at most. Where each adapts from its own episodes alone it must have
    no second one in a shot: then there are fewer.
    """
    if asked is None:
        asked, of_batch = _ROLLOUTS, config.learner_values.get("tasks_per_class")
        if of_batch is not None:
            counts = [len(pool) for pool in worlds.tasks("train").values()]
            of_class = config.num_envs // len(counts)
            asked = max(1, min(of_class // min(of_batch, max(counts)), _MOST_ROLLOUTS))
    return min(asked, most) if learner_kind(config.algo).make.independent_adaptation else asked


def environments_for(classes: int, adaptations: int, rollouts: int, limit: int) -> int:
    """Environments of a world that plays as many adaptations (tasks times trials) of each class at once as it can.

    Each takes ``rollouts`` environments, if there are so many; else it takes several rounds. ``limit`` is the number
    of environments at most, but never fewer than one for each class.
    """
    of_class = max(1, limit // classes)
    if of_class < rollouts:
        # A divisor, so that every environment plays in every round.
        return classes * max(number for number in range(1, of_class + 1) if rollouts % number == 0)
    portions = -(-adaptations // (of_class // rollouts))
    return classes * -(-adaptations // portions) * rollouts


def check_worlds(worlds: Worlds, algo: str) -> None:
    """Refuses worlds that show their tasks: Meta-World's, multi-task or of a class alone."""
    if not worlds.hides_goals:
        raise BidexError(
            f"{algo} adapts to hidden goals, but {worlds.name} shows them. Name an ML suite: "
            "--suite ML1, ML4, ML20, or a file of kind meta."
        )


def others_of(worlds: Worlds) -> Worlds:
    """Worlds of as many tasks of each class, drawn by another seed."""
    return Worlds.open(replace(worlds.config, task_seed=worlds.seed + OTHER_SEED))


def splits_of(worlds: Worlds, asked: str) -> list[str]:
    """The splits that a meta-test plays: the one of this name, or all there are for ``both`` and ``auto``."""
    if asked == OTHERS:
        return [OTHERS]
    if asked in ("train", "test") and asked not in worlds.splits:
        raise BidexError(f"{worlds.name} has no {asked} tasks. Leave --split out.")
    return [name for name in worlds.splits if asked in ("auto", "both", name)]


def print_tables(subject: str, found: Mapping[str, MetaEvaluation]) -> None:
    """For each split a table before adaptation and one after, the latter with the gains."""
    for split, result in found.items():
        shots = len(result.adapt_steps)
        print_table(evaluation_table(f"{subject}, {split} tasks, before adaptation", result.before))
        if shots:
            title = f"{subject}, {split} tasks, after {shots} shot{'s' * (shots > 1)} of {result.rollouts} episodes"
            print_table(evaluation_table(title, result.after, gains=result.gains()))
