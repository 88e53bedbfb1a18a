"""Runs of several processes: they agree on the config, and tell if one of them is lost."""

import logging

from bidex_meta.errors import BidexError
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.training import distributed
from bidex_meta.training.distributed import together
from bidex_meta.training.launch import launch, resume_command

_LOG = logging.getLogger("bidex_meta")

Checkpoint = tuple[Json, int]  # a state and its environment steps


def agree(config: AnyConfig, loaded: Checkpoint | None) -> AnyConfig:
    """Return the config of process 0, which all processes then use.

    Raises BidexError if a process has another config (apart from the number of threads), or sees another checkpoint.
    """
    everyone = distributed.share((config, loaded and loaded[1]))
    first, step = everyone[0]

    def refuse_others() -> None:
        here = first.flat()
        for number, (other, other_step) in enumerate(everyone):
            there = other.flat()
            # Machines may differ in cores, so the run keeps the number of threads of process 0.
            for name in here.keys() - {"threads"}:
                if here[name] != there.get(name):
                    raise BidexError(
                        f"Process {number} has {name} = {there.get(name)}, not {here[name]} as process 0. Start all "
                        "with the same flags."
                    )
            if other_step != step:
                raise BidexError(
                    f"Process {number} finds a checkpoint at {other_step} steps, process 0 at {step}. The run folder "
                    "must be one that all machines see."
                )

    together(refuse_others)
    return first


def report_loss(loss: Exception, folder: RunFolder | None = None) -> None:
    """Log that another process is gone, and which checkpoint is left; only the first process that notices logs this."""
    missing = distributed.report_loss()
    if missing is None:
        return
    count = launch().count
    which = ", ".join(map(str, missing))
    if which:
        gone = f"process {which} of {count} is gone or stuck"
    else:
        gone = f"one of {count} processes has ended"
    left = "Training had not begun."
    if folder is not None:
        if folder.checkpoints_path.is_dir():
            step = folder.checkpoints.newest_step()
        else:
            step = None
        if step is None:
            saved = "There is no checkpoint yet"
        else:
            saved = f"The last checkpoint is at {step:,} steps"
        left = f"{saved}, in {folder.checkpoints_path}. Continue: {resume_command(folder.path, count)}"
    _LOG.error("%s (%s). %s", gone, loss, left)
