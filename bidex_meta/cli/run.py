"""``bidex-meta run``: train, then evaluate."""

import signal
from collections.abc import Sequence
from typing import Any

from bidex_meta.cli.run_flags import RunFlags, run_flags
from bidex_meta.cli.tables import print_evaluation, print_meta_test
from bidex_meta.config import printed
from bidex_meta.errors import BidexError
from bidex_meta.experiments.evaluating import evaluate, meta_test
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.metatest import splits_of
from bidex_meta.experiments.run_config import check, check_resumed
from bidex_meta.experiments.training import Stopped, train
from bidex_meta.runs import RunFolder
from bidex_meta.training import distributed
from bidex_meta.training.distributed import together
from bidex_meta.training.launch import launch, resume_command, say
from bidex_meta.training.learner import Capability
from bidex_meta.worlds import Worlds


def main(arguments: Sequence[str]) -> None:
    """Train and evaluate. Bad input is reported before anything is written.

    Raises SystemExit: 1 if another process was lost, 2 if another process has reported bad input, and, after a signal
    has ended the training and training has saved, 128 plus the signal's number (no SystemExit for SIGTERM).
    """
    try:
        distributed.init_from_environment()
        flags = together(lambda: _checked(run_flags(arguments)))
        if flags.print_config:
            together(lambda: _check_printed(flags))
            if launch().rank == 0:
                print(printed(flags.config))
            distributed.shut_down()
            return
        folder = train(flags.config, run_dir=flags.run_dir, resume=flags.resume, show_progress=True)
    except distributed.LostProcess:
        raise SystemExit(1) from None
    except Stopped as stop:
        command = resume_command(stop.folder.path, launch().count)
        say(f"Stopped after {stop.step:,} steps and saved. Continue: {command}")
        # A batch system's SIGTERM requests a checkpoint, which is saved now. Other signals also stop the caller.
        if stop.number != signal.SIGTERM:
            raise SystemExit(128 + stop.number) from None
        return
    if flags.evaluate and launch().rank == 0:
        _evaluate(flags, folder)


def _checked(flags: RunFlags) -> RunFlags:
    """Refuse flags of an evaluation that this learner does not have."""
    config = flags.config
    asked = [name for name in ("split", "shots", "rollouts", "tasks") if vars(flags)[name] not in (None, "auto")]
    adapts = Capability.ADAPTS in learner_kind(config.algo, config.task).make.capabilities
    if asked and not adapts:
        raise BidexError(
            f"--{asked[0]} is for learners that adapt (maml, promp, rl2), not {config.algo}. Leave it out."
        )
    if flags.other_tasks and adapts:
        raise BidexError(f"{config.algo} adapts: --split others plays other tasks of its train classes.")
    if adapts:
        splits_of(Worlds.open(config.to_json()), flags.split)
    return flags


def _check_printed(flags: RunFlags) -> None:
    """Refuse a config as ``train`` would, but for the memory of this machine."""
    check(flags.config, with_memory=False)
    if flags.resume is not None:
        check_resumed(RunFolder.open(flags.resume), flags.config)


def _evaluate(flags: RunFlags, folder: RunFolder) -> None:
    """Evaluate on the device of the training, write evaluation.json and print the tables."""
    config = flags.config
    where: dict[str, Any] = {"device": launch().own_device(config.device), "engine": config.engine, "save": True}
    if Capability.ADAPTS in learner_kind(config.algo, config.task).make.capabilities:
        size = {"shots": flags.shots, "rollouts": flags.rollouts, "episodes": flags.episodes, "tasks": flags.tasks}
        print_meta_test(meta_test(folder, split=flags.split, **size, **where))
        say(f"More: bidex-meta evaluate {folder.path} --shots 3 --tasks 50   See bidex-meta plot --help for curves.")
        return
    found = evaluate(folder, episodes=flags.episodes, random=True, other_tasks=flags.other_tasks, **where)
    print_evaluation(found, brief=True)
    say(f"More columns: bidex-meta evaluate {folder.path}   Curves: bidex-meta plot {folder.path}")
