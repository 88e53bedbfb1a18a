"""From a run folder to its policy: the commands' one way."""

from collections.abc import Callable
from typing import Any

from bidex_meta.agents import Agent
from bidex_meta.commands.learners import learner_kind
from bidex_meta.errors import BidexError
from bidex_meta.record import RunFolder


def checkpoint(folder: RunFolder) -> tuple[dict[str, Any], int]:
    """State and environment steps of a run's newest checkpoint.

    Raises:
        BidexError: The run has not saved one yet.
    """
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(f"{folder.path} has no checkpoint yet. Train on: bidex-meta run --resume {folder.path}")
    return loaded


def load_policy(folder: RunFolder, device: str) -> tuple[Agent, int]:
    """The policy of a run's newest checkpoint and the environment steps it was trained for.

    Raises:
        BidexError: The run has not saved a checkpoint yet.
    """
    load, step = policy_loader(folder, device)
    return load(), step


def policy_shape(state: dict[str, Any]) -> dict[str, Any]:
    """Numbers of ``observations`` and ``actions`` of the policy in a run's ``checkpoint``, and more that it keeps."""
    return state["learner"]["policy"]["shape"]


def policy_of(folder: RunFolder, state: dict[str, Any], device: str) -> Agent:
    """The policy in a run's ``checkpoint``."""
    return learner_kind(folder.config()["algo"]).make.load_policy(state["learner"]["policy"], device)


def policy_loader(folder: RunFolder, device: str) -> tuple[Callable[[], Agent], int]:
    """What makes the policy of a run's newest checkpoint anew, as often as it is asked, and that checkpoint's steps.

    The checkpoint is read once: a run that trains on meanwhile gives no other.

    Raises:
        BidexError: The run has not saved a checkpoint yet.
    """
    state, step = checkpoint(folder)
    return lambda: policy_of(folder, state, device), step
