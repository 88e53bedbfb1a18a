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
from bidex_meta.rules import rules_apart
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.training.distributed import LostProcess
from bidex_meta.training.launch import say
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import is_file
from bidex_meta.worlds import Worlds, open_worlds


def load_checkpoint(folder: RunFolder, which: str = "last", noted: bool = False) -> tuple[Json, int]:
    """Return the state and the environment steps of a run's checkpoint; raise BidexError if there is none.

    ``which`` is ``last`` (the newest), ``best`` (its state has only the policy), or a file: a path, or a name in the
    run's folder of checkpoints.

    A line is logged if the run was made with other versions than those of this installation. The caller sets ``noted``
    if such a line was logged before; in this case the line is left out.
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
        if own.parent == folder.checkpoints.folder and is_file(own):
            return folder.checkpoints.load_one(own)
        found = folder.checkpoints.load_one(Path(which))
        _check_shape(folder, found[0], which)
        return found
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(
            f"{folder.path} has no checkpoint yet. Continue its training: bidex-meta run --resume {folder.path}"
        )
    return loaded


def _check_shape(folder: RunFolder, state: Json, file: str) -> None:
    """Raise BidexError if a checkpoint of elsewhere has a policy of another shape than the run's own checkpoint."""
    own = folder.checkpoints.load()
    if own is None:
        return
    with fitting(folder.path):
        wanted = own[0]["learner"]["policy"].get("shape")
        shape = state["learner"]["policy"].get("shape")
    if shape != wanted:
        raise BidexError(
            f"{file}: expected a policy of the shape {wanted} of {folder.path}, got {shape}. Name a checkpoint of this "
            "run."
        )


@contextlib.contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn errors in the block into a BidexError that says that a checkpoint does not fit its run's config.

    The block loads the checkpoint; ``path`` is the run's folder. The checkpoint may come from another version or
    another author, so its tensors and texts can be anything.
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
        return learner_kind(folder.config().algo).learner_class.load_policy(state["learner"]["policy"], device)


def policy_loader(folder: RunFolder, device: str, which: str = "last") -> tuple[Callable[[], Agent], int]:
    """Return a function that makes the policy of a run's checkpoint, and the checkpoint's environment steps.

    Each call of this function makes a new copy of the policy. The checkpoint is read only once, so all calls return the
    same policy even if the run is still training.
    """
    state, step = load_checkpoint(folder, which)
    return lambda: policy_of(folder, state, device), step


def say_other_rules(folder: RunFolder, worlds: Worlds) -> None:
    """Log a line if a run was trained under other rules than those of ``worlds``, and if only one of both hides goals.

    Rules are the suite's choices of reward, success condition, goal range and start states. Nothing is logged if the
    run's suite cannot be opened.
    """
    with contextlib.suppress(BidexError):  # the suite's file of the run may be missing
        learned = open_worlds(folder.config().to_json())
        if learned.hides_goals != worlds.hides_goals:
            if learned.hides_goals:
                difference = f"which hides goals; {worlds.name} shows goals"
            else:
                difference = f"which shows goals; {worlds.name} hides goals"
            say(f"Note: {folder.path} learned {learned.name}, {difference}.")
        if learned.rules and worlds.rules and (apart := rules_apart(vars(learned.rules), worlds.rules)):
            say(f"Note: {folder.path} learned {learned.name} by other rules than those of {worlds.name}: {apart}.")


def say_other_classes(folder: RunFolder, worlds: Worlds) -> None:
    """Log one line if the classes of a run and of ``worlds`` are equal in number, but not the same in the same order.

    The policy fits such worlds, but its weights and statistics of single classes belong to other classes.
    Nothing is logged if the run's suite cannot be opened.
    """
    with contextlib.suppress(BidexError):  # the suite's file of the run may be missing
        learned = slots_of(open_worlds(folder.config().to_json()))
        wanted = slots_of(worlds)
        if learned != wanted and len(learned) == len(wanted) > 1:
            names = " ".join(learned)
            say(f"Note: {folder.path} learned other classes: {names}. Weights of single classes go to yours in order.")


def slots_of(worlds: Worlds) -> list[str]:
    """Return the class name of each slot in the train split of ``worlds``.

    A slot is a class with its tasks. If a suite lists the tasks of a class by name, each listed task has its own slot,
    named Class/task; this function returns only the class.
    """
    return [name.split("/")[0] for name in worlds.tasks("train")]
