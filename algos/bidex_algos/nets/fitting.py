"""Refuses a world that a learner's options, or its one discount, do not fit."""

from typing import Any

from bidex_algos.nets.shape import Shape
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import VectorWorld

_OF_SEVERAL = ("task_embedding", "normalise_per_task")


def check_options(name: str, config: Any, world: VectorWorld, shape: Shape) -> None:
    """Options that tell tasks apart need the one-hot of the tasks.

    Raises:
        BidexError: The world does not show one.
    """
    wanted = [option for option in (*_OF_SEVERAL, "policy_heads") if getattr(config, option, False)]
    if world.num_tasks == 1:
        wanted = [option for option in wanted if option not in _OF_SEVERAL]  # one task needs none; heads it cannot have
    if not getattr(config, "shares_a_trunk", True):
        wanted.append(f"architecture {config.architecture}")
    for option in wanted:
        if shape.num_id_columns != world.num_tasks:
            raise BidexError(
                f"{name}: {option} needs the one-hot of {world.num_tasks} tasks in the observation (an MT "
                f"suite), this world shows {shape.num_id_columns} such entries. Leave {option} off."
            )


def check_discounts(name: str, world: VectorWorld, by_class: bool) -> None:
    """A suite's own discounts need a learner that takes them.

    Raises:
        BidexError: This one does not.
    """
    own = [task for task, gamma in zip(world.task_names, world.gammas, strict=True) if gamma is not None]
    if own and not by_class:
        raise BidexError(
            f"{name}: has one discount for all classes, but the suite gives {', '.join(own)} one of its own. "
            "Leave gamma out of the suite's file."
        )
