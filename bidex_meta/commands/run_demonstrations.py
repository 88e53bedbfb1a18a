"""What ``bidex-meta run --demonstrations`` adds: data sets that are imitated beside what is learned by playing."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from bidex_meta.commands.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.commands.parsing import peek_all
from bidex_meta.errors import BidexError, known_name
from bidex_meta.reading import absolute, expanded
from bidex_meta.worlds import Worlds


def listed(kept: str | Sequence[str] | None) -> tuple[str, ...]:
    """The data sets of a config, which keeps none as None and a single one as its name."""
    return () if kept is None else (kept,) if isinstance(kept, str) else tuple(kept)


def named(arguments: Sequence[str], stored: Mapping[str, Any]) -> str | list[str] | None:
    """The data sets that the flags name, or those of the run to be resumed, as a config keeps them.

    A folder stands with its whole path.
    """
    given = peek_all(arguments, "--demonstrations") or listed(stored.get("demonstrations"))
    names = [str(absolute(name)) if expanded(name).is_dir() else name for name in given]
    return names if len(names) > 1 else names[0] if names else None


def check(kind: LearnerKind, kept: str | Sequence[str] | None, source: Worlds) -> None:
    """Refuses, before a world is made, what could not be imitated in it; reads the data sets' metadata alone.

    Raises:
        BidexError: The learner takes none, there is no such data set, or it is of another class, of other bases or with
            other goals shown.
    """
    names = listed(kept)
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


def give(kept: str | Sequence[str], learner: Any) -> None:
    """Reads the data sets and hands them to a fresh learner; errors as of ``join``."""
    from bidex_meta.data import open_dataset
    from bidex_meta.data.joined import join

    datasets = [open_dataset(name) for name in listed(kept)]
    steps, episodes = sum(each.num_steps for each in datasets), sum(each.num_episodes for each in datasets)
    print(f"Demonstrations: {steps:,} transitions of {episodes:,} episodes.", file=sys.stderr, flush=True)
    learner.learn_from_demonstrations(join(datasets, learner.world, every=False))
