"""What ``bidex-meta run --demonstrations`` adds: a data set that is imitated beside what is learned by playing."""

import sys
from typing import Any

from bidex_meta.commands.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.errors import BidexError, known_name
from bidex_meta.reading import expanded
from bidex_meta.sources import Source


def named(name: str | None) -> str | None:
    """The data set as a config keeps it: a folder stands with its whole path."""
    return str(expanded(name).resolve()) if name is not None and expanded(name).is_dir() else name


def check(kind: LearnerKind, name: str | None, source: Source) -> None:
    """Refuses, before a world is made, what could not be imitated in it; reads the data set's metadata alone.

    Raises:
        BidexError: The learner takes none, there is no such data set, or it is of another class, of other bases or with
            other goals shown.
    """
    if name is None:
        return
    if not kind.imitates:
        takers = ", ".join(each for each in ALGOS if learner_kind(each).imitates)
        raise BidexError(f"{kind.name} imitates nothing; --demonstrations goes with {takers}. Leave one of them out.")
    from bidex_meta.data import open_dataset

    dataset, classes = open_dataset(name), source.task_classes()
    for slot in dataset.metadata["tasks"]:
        known_name(f"class in {source.name} of", slot.partition("/")[0], classes)
    if dataset.metadata.get("hides_goals", source.hides_goals) != source.hides_goals:
        raise BidexError(f"{dataset.name} and {source.name} do not both show goals. Record what shall be learned.")
    actions = max(each.action_size for each in classes.values())
    if dataset.action_size != actions:
        raise BidexError(
            f"{dataset.name} has {dataset.action_size} actions, {source.name} here {actions}: its bases do not move "
            f"alike. {'Add --base moving' if dataset.action_size > actions else 'Record it with the same bases'}."
        )


def give(name: str, learner: Any) -> None:
    """Reads the data set and hands it to a fresh learner; errors as of ``join``."""
    from bidex_meta.data import open_dataset
    from bidex_meta.data.joined import join

    dataset = open_dataset(name)
    told = f"Demonstrations: {dataset.num_steps:,} transitions of {dataset.num_episodes:,} episodes."
    print(told, file=sys.stderr, flush=True)
    learner.learn_from_demonstrations(join([dataset], learner.world, every=False))
