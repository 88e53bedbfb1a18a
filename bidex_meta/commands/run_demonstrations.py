"""What ``bidex-meta run --demonstrations`` adds: data sets that are imitated beside what is learned by playing."""

import sys
from collections.abc import Sequence
from typing import Any

from bidex_meta.commands.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.errors import BidexError, known_name
from bidex_meta.worlds import Worlds


def check(kind: LearnerKind, names: Sequence[str], source: Worlds) -> None:
    """Refuses, before a world is made, what could not be imitated in it; reads the data sets' metadata alone.

    Raises:
        BidexError: The learner takes none, there is no such data set, or it is of another class, of other bases or with
            other goals shown.
    """
    if not names:
        return
    if not kind.imitates:
        takers = ", ".join(each for each in ALGOS if learner_kind(each).imitates)
        raise BidexError(f"{kind.name} imitates nothing; --demonstrations goes with {takers}. Leave one of them out.")
    from bidex_meta.data import open_dataset

    for name in names:
        _check_dataset(open_dataset(name), source)


def _check_dataset(dataset: Any, source: Worlds) -> None:
    classes = source.task_classes()
    for slot in dataset.metadata["tasks"]:
        known_name(f"class in {source.name} of", slot.partition("/")[0], classes)
    check_goals(dataset, source)
    actions = max(each.action_size for each in classes.values())
    if dataset.action_size != actions:
        raise BidexError(
            f"{dataset.name} has {dataset.action_size} actions, {source.name} here {actions}: its bases do not move "
            f"alike. {'Add --base moving' if dataset.action_size > actions else 'Record it with the same bases'}."
        )


def check_goals(dataset: Any, source: Worlds) -> None:
    """Refuses data that do not show the goals which the source shows; what it hides, they may show.

    Raises:
        BidexError: They do not.
    """
    about = dataset.metadata
    if about.get("hides_goals", source.hides_goals) == source.hides_goals:
        return
    if about["hides_goals"]:
        raise BidexError(f"{dataset.name} hides goals, {source.name} shows them. Record what shall be learned.")
    if about.get("points"):
        raise BidexError(f"{dataset.name} has point clouds, where {source.name} hides goals. Record without --points.")


def give(names: Sequence[str], learner: Any) -> None:
    """Reads the data sets and hands them to a fresh learner; errors as of ``join``."""
    from bidex_meta.data import open_dataset
    from bidex_meta.data.joined import join

    datasets = [open_dataset(name) for name in names]
    steps, episodes = sum(each.num_steps for each in datasets), sum(each.num_episodes for each in datasets)
    print(f"Demonstrations: {steps:,} transitions of {episodes:,} episodes.", file=sys.stderr, flush=True)
    learner.learn_from_demonstrations(join(datasets, learner.world, every=False))
