"""``bidex-meta run``: train, then evaluate."""

import signal
from collections.abc import Sequence

from bidex_meta.cli.run_flags import RunFlags, run_flags
from bidex_meta.cli.tables import print_evaluation, print_meta_test
from bidex_meta.config import printed
from bidex_meta.experiments.evaluating import RunMetaTest
from bidex_meta.experiments.run_config import check, resumed
from bidex_meta.experiments.training import Stopped, train
from bidex_meta.runs import RunFolder
from bidex_meta.training import distributed
from bidex_meta.training.distributed import together
from bidex_meta.training.launch import launch, resume_command, say


def main(arguments: Sequence[str]) -> None:
    """Train and evaluate. Bad input is reported before anything is written.

    SystemExit is raised with code 1 if another process of the run was lost, and with code 2 if another process has
    reported bad input. If a signal arrives, training saves a checkpoint and ends. SystemExit is then raised with 128
    plus the signal's number, but not after SIGTERM.
    """
    try:
        distributed.init_from_environment()
        flags = together(lambda: run_flags(arguments))
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
        # SIGTERM from a batch system requests a checkpoint, which is saved by now. Other signals also stop the caller.
        if stop.number != signal.SIGTERM:
            raise SystemExit(128 + stop.number) from None
        return
    if flags.evaluate and launch().rank == 0:
        _evaluate(flags, folder)


def _check_printed(flags: RunFlags) -> None:
    """Raise BidexError for a config that ``train`` would refuse. The memory of this machine is not checked."""
    check(flags.config, with_memory=False)
    if flags.resume is not None:
        resumed(RunFolder.open(flags.resume), flags.config)


def _evaluate(flags: RunFlags, folder: RunFolder) -> None:
    """Evaluate on the device that training used, write evaluation.json and print the tables."""
    found = flags.final.play(folder, flags.config)
    if isinstance(found, RunMetaTest):
        print_meta_test(found)
        say(f"More: bidex-meta evaluate {folder.path} --tasks 50   Curves: bidex-meta plot {folder.path} --adaptation")
    else:
        print_evaluation(found, brief=True)
        say(f"More columns: bidex-meta evaluate {folder.path}   Curves: bidex-meta plot {folder.path}")
