"""Load a run's policy from its folder, in the same way for all commands."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from bidex_meta.agents import Agent
from bidex_meta.engine.choice import checked_device
from bidex_meta.errors import BidexError, one_line
from bidex_meta.experiments.conditions import say_differences
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.suite import rules_apart
from bidex_meta.training.distributed import LostProcess
from bidex_meta.training.launch import say
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import is_file
from bidex_meta.worlds import Worlds, open_worlds


def checkpoint(folder: RunFolder, which: str = "last", noted: bool = False) -> tuple[Json, int]:
    """Return the state and the environment steps of a run's checkpoint; raise BidexError if there is none.

    Differences between the run's record and this installation or the run's suite are printed, unless they were
    ``noted`` before.

    ``which`` is ``last`` (the newest), ``best`` (its state has only the policy), or a file: a path, or a name in the
    run's folder of checkpoints.
    """
    loaded = _loaded(folder, which)
    if not noted:
        say_differences(folder)
    return loaded


def _loaded(folder: RunFolder, which: str) -> tuple[Json, int]:
    if which == "best":
        if not folder.checkpoints.best.is_file():
            raise BidexError(
                f"{folder.path} has no best.pt: it was not evaluated while training (run --evaluate-every N). Use "
                "--checkpoint last."
            )
        return folder.checkpoints.load_one(folder.checkpoints.best)
    if which != "last":
        own = folder.checkpoints.folder / which
        return folder.checkpoints.load_one(own if is_file(own) else Path(which))
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(
            f"{folder.path} has no checkpoint yet. Continue its training: bidex-meta run --resume {folder.path}"
        )
    return loaded


@contextlib.contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn errors while a checkpoint is loaded into a BidexError: the checkpoint does not fit the run's config.

    A checkpoint may come from another version or another author, so its tensors and texts can be anything.
    """
    try:
        yield
    except (BidexError, LostProcess):
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {one_line(error)[:200].rstrip('.')}"
        raise BidexError(
            f"The checkpoint of {path} does not fit its config ({reason}). Use the version in versions.json, or start "
            "a new run."
        ) from error


@checked_arguments
def load_policy(
    run: RunFolder | str | Path, device: str | torch.device = "cpu", which: str = "last"
) -> tuple[Agent, int]:
    """Return the policy of a run's checkpoint and the environment steps that it was trained for.

    ``which`` is ``last``, ``best`` or a file. Raises BidexError if there is no such run or checkpoint.
    """
    if isinstance(run, RunFolder):
        folder = run
    else:
        folder = RunFolder.open(run)
    load, step = policy_loader(folder, str(checked_device(device)), which)
    return load(), step


def policy_of(folder: RunFolder, state: Json, device: str) -> Agent:
    """Return the policy in a run's checkpoint; raise BidexError if the checkpoint does not fit the run's config."""
    with fitting(folder.path):
        return learner_kind(folder.config().algo).make.load_policy(state["learner"]["policy"], device)


def policy_loader(folder: RunFolder, device: str, which: str = "last") -> tuple[Callable[[], Agent], int]:
    """Return a function that makes a new policy from a run's checkpoint at each call, and the checkpoint's steps.

    The checkpoint is read only once, so all calls return the same policy even if the run is still training.
    """
    state, step = checkpoint(folder, which)
    return lambda: policy_of(folder, state, device), step


def say_other_rules(folder: RunFolder, worlds: Worlds) -> None:
    """Say in one line how the rules under which a run trained differ from the rules of some worlds, if they differ."""
    with contextlib.suppress(BidexError):  # the suite's file of the run may be missing
        learned = open_worlds(folder.config().to_json())
        if learned.rules and worlds.rules and (apart := rules_apart(vars(learned.rules), worlds.rules)):
            say(f"Note: {folder.path} learned {learned.name} by other rules than those of {worlds.name}: {apart}.")


def slots_of(worlds: Worlds) -> list[str]:
    """Return the class of each slot of some worlds; a slot of listed tasks is named Class/task."""
    return [name.split("/")[0] for name in worlds.tasks("train")]
