"""The command ``bidex-meta``: find the subcommand, call it, and turn errors into one line.

Nothing heavy is imported here: each subcommand is a module of this package with a function ``main(arguments)``,
imported when it is called.
"""

import contextlib
import importlib
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import NamedTuple

from bidex_meta import errors
from bidex_meta.errors import EXIT_BAD_INPUT, BidexError, known_name, one_line, shortened
from bidex_meta.training.launch import launch, notices
from bidex_meta.utils.plugins import own_fault
from bidex_meta.utils.streams import bound_width, open_missing, print_anything, silence, unread
from bidex_meta.utils.waiting import tell, watched

_MEANT = {"train": "run", "test": "evaluate", "learn": "run", "fit": "run", "view": "play", "watch": "play"}
_MEANT |= {"show": "render", "film": "render", "video": "render", "download": "pull", "upload": "push"}
"""Names that other programs use for these commands."""
_LONGEST = 2000  # most letters of an error message, which may quote any input


class Command(NamedTuple):
    """Module and summary of a subcommand of ``bidex-meta``."""

    module: str
    summary: str


COMMANDS: dict[str, Command] = {
    "run": Command("bidex_meta.cli.run", "train a learner on a suite or a task, then evaluate it"),
    "sweep": Command("bidex_meta.cli.sweep", "train many runs from one file; run it again to resume"),
    "evaluate": Command("bidex_meta.cli.evaluate", "measure success and return of a trained run, per task class"),
    "verify": Command("bidex_meta.cli.verify", "repeat a run's evaluation and compare it with the recorded one"),
    "submit": Command("bidex_meta.cli.submit", "write a leaderboard entry for runs or for a meta-test"),
    "compare": Command("bidex_meta.cli.compare", "compare groups of runs, with intervals over seeds"),
    "control": Command("bidex_meta.cli.control", "test whether adaptation uses a task's own data"),
    "transfer": Command("bidex_meta.cli.transfer", "learn held-out classes from a run's policy and from scratch"),
    "record": Command("bidex_meta.cli.record", "record episodes of a policy as a data set for offline learners"),
    "data": Command("bidex_meta.cli.data", "list, describe or check data sets"),
    "list": Command("bidex_meta.cli.listing", "list suites, tasks, hidden parts of tasks, algos or objects"),
    "render": Command("bidex_meta.cli.render", "draw a picture or a film of a task, or of all classes of a run"),
    "play": Command("bidex_meta.cli.play_live", "watch a policy live, in a window or in the browser"),
    "demo": Command("bidex_meta.cli.demo", "watch the policy that comes with bidex-meta, live or as a film"),
    "witness": Command("bidex_meta.cli.witness", "replay actions that solve a task"),
    "baseline": Command("bidex_meta.cli.baseline", "measure returns of untrained policies and known solutions"),
    "validity": Command("bidex_meta.cli.validity", "measure whether a suite's tasks must be identified to be solved"),
    "plot": Command("bidex_meta.cli.plot", "draw learning curves of runs"),
    "export": Command("bidex_meta.cli.export", "write a policy as an ONNX file and check it against torch"),
    "push": Command("bidex_meta.cli.push", "publish a policy or a data set with its card"),
    "pull": Command("bidex_meta.cli.pull", "fetch a published policy or data set"),
    "report": Command("bidex_meta.cli.report", "write an HTML page about runs: tables, curves, films"),
    "completion": Command("bidex_meta.cli.completion", "print a script that completes commands and flags in a shell"),
    "bench": Command("bidex_meta.cli.bench", "measure the speed of a suite's world"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line that follows ``bidex-meta`` and return the exit code.

    ``arguments`` are its words; None: those of this process. Some subcommands raise SystemExit with the code instead.

    - 0: the command has succeeded, or training has saved and ended after SIGTERM.
    - 1: training diverged, runs of a sweep failed, or a check found a difference.
    - 2: the input or a user's own code is faulty, or the system refuses something (full disk, read-only folder, no
      memory).
    - 130: Ctrl-C was pressed.
    - 141: nobody reads stderr any more.
    - 128 plus the signal's number: SIGHUP, SIGUSR1, SIGUSR2 or SIGTERM has ended the command.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    open_missing()
    print_anything()
    bound_width()
    try:
        with _signals_raise(), _log_on_stderr():
            try:
                return _dispatch(given)
            finally:
                sys.stdout.flush()  # a write that fails when Python exits would not be caught
    except BidexError as error:
        return _failed(str(error), EXIT_BAD_INPUT, debug)
    except FloatingPointError as error:
        return _failed(f"{error} What was saved before stays as it is.", errors.EXIT_FAILED, debug)
    except _Terminated as stop:
        return _failed(f"stopped by {stop}.", 128 + stop.number, debug=False)
    except KeyboardInterrupt:
        return _failed("interrupted.", errors.EXIT_INTERRUPTED, debug=False)
    except MemoryError as error:
        return _failed(f"out of memory: {error or 'ask for fewer rows'}.", EXIT_BAD_INPUT, debug)
    except BrokenPipeError:
        # A reader that closes only stdout has seen enough (`| head`). If stderr is closed too, work may have been
        # aborted.
        if unread(sys.stderr):
            code = errors.EXIT_UNREAD
        else:
            code = 0
        silence(sys.stdout)  # otherwise Python complains when it flushes at exit
        silence(sys.stderr)
        return code
    except OSError as error:
        silence(sys.stdout)  # otherwise Python retries the failed write at exit
        if error.filename is None:
            place = ""
        else:
            place = f"{os.fsdecode(error.filename)}: "
        return _failed(f"{place}{error.strerror or error}. Fix the path, or make room.", EXIT_BAD_INPUT, debug)
    except (Exception, SystemExit) as error:
        message = own_fault(error)
        if message is None:
            raise
        return _failed(f"{message} Fix it there; --debug shows the traceback.", EXIT_BAD_INPUT, debug)


class _Terminated(KeyboardInterrupt):
    """Raised when a signal asks the process to end: SIGTERM, or one of ``notices()`` (SIGHUP, SIGUSR1, SIGUSR2).

    The cleanup is the same as after Ctrl-C.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextlib.contextmanager
def _signals_raise() -> Iterator[None]:
    """Raise an exception in the ``with`` block when SIGTERM or one of ``notices()`` is received.

    ``notices()`` are further signals that ask a process to end, such as SIGHUP. Because of the exception, the command
    cleans up, leaves no half-written file, and prints why it ended.
    """
    # With several processes, signals keep their handlers, because a collective operation waits outside Python and would
    # delay ours.
    if threading.current_thread() is not threading.main_thread() or launch().count > 1:
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise _Terminated(number)

    before = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGTERM, *notices())}
    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _OnStderr(logging.Handler):
    """Prints the library's log records, one per line."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record; raise BrokenPipeError if nobody reads stderr.

        The standard handlers of ``logging`` would catch this error, and the command would continue.
        """
        tell(record.getMessage())


@contextlib.contextmanager
def _log_on_stderr() -> Iterator[None]:
    """Print the library's log while a command runs."""
    log = logging.getLogger("bidex_meta")
    level = log.level
    propagates = log.propagate
    handler = _OnStderr()
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        log.propagate = propagates


def _failed(reason: str, code: int, debug: bool) -> int:
    """Print the reason for a failure to stderr, on one line, and return ``code``.

    If ``debug`` is true, re-raise the exception that is being handled.
    """
    if debug:
        raise
    message = one_line(reason)
    if len(message) > _LONGEST:
        message = f"{message[: _LONGEST - 300]} ... {message[-200:]}"  # the end says how to fix the error
    with contextlib.suppress(OSError):  # nobody may read it
        print(f"bidex-meta: {message}", file=sys.stderr)
    return code


def _dispatch(arguments: list[str]) -> int:
    for word in arguments:
        try:
            word.encode()  # Python decodes other bytes as surrogates, which no config, log or event file can hold
        except UnicodeEncodeError:
            raise BidexError(
                f"Expected arguments in UTF-8, got {shortened(word)}. Rename the file or folder, or name another."
            ) from None
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help())
        return 0
    name, *rest = arguments
    if name == "--version":
        from bidex_meta import __version__

        print(__version__)
        return 0
    name = known_name("command", name, COMMANDS, _MEANT)
    for place, word in enumerate(rest):
        if not word or re.fullmatch(r"--[\w.-]+=", word):
            flag = word.rstrip("=") or (rest[place - 1] if place else "a word")
            raise BidexError(f"{flag} after bidex-meta {name} has no value. Add a value, or leave the flag out.")
    with watched(f"bidex-meta {name}, starting") if launch().rank == 0 else contextlib.nullcontext():
        importlib.import_module(COMMANDS[name].module).main(rest)
    return 0


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    return f"""\
Multi-task and meta reinforcement learning for two dexterous hands: train, judge and look at policies.
Example: bidex-meta run --suite MT4 --algo mtppo

usage: bidex-meta COMMAND [OPTIONS]

{commands}

bidex-meta COMMAND --help shows the options of a command; --debug shows the traceback of an error;
--version the version."""
