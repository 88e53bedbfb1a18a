"""Flags to dataclasses by tyro, with every complaint on one line."""

import contextlib
import dataclasses
import difflib
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import check_writable, refuse_links
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.stored import StoredRun, open_run
from bidex_meta.utils.validation import check_fields

Options = TypeVar("Options")


class FlagsFound(Exception):
    """Tells the flags of a command in place of parsing them; only ``flags_of`` asks for it."""

    def __init__(self, options: type, default: Any) -> None:
        super().__init__(options.__name__)
        self.options, self.default = options, default


_asked_for_flags: ContextVar[bool] = ContextVar("asked_for_flags", default=False)


def flags_of(command: Callable[[Sequence[str]], None], arguments: Sequence[str] = ()) -> FlagsFound:
    """The dataclass of a command's flags, and the default of it where the command has one of its own.

    Args:
        command: A subcommand's ``main``, which calls ``parse`` before it does anything.
        arguments: What the flags may depend on, e.g. ``--algo``.
    """
    token = _asked_for_flags.set(True)
    try:
        command(arguments)
    except FlagsFound as found:
        return found
    finally:
        _asked_for_flags.reset(token)
    raise TypeError(f"{command.__module__}.main parses no flags")


Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""A flag without a value and without a ``--no-`` twin."""


RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
"""A run folder, as the first word."""


RunPaths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
"""Run folders, or files of ``results/data/``."""


def named_runs(paths: Sequence[Path], command: str) -> list[RunFolder | StoredRun]:
    """The runs that a command was given.

    Raises:
        BidexError: None, or one that is no run.
    """
    if not paths:
        raise BidexError(f"Name the run folders: bidex-meta {command} RUN...")
    return [open_run(path) for path in paths]


def output(asked: Path | None, runs: Sequence[RunFolder | StoredRun], name: str) -> Path:
    """Where a command writes: as asked, else of this name into the run's folder or, of several runs, here.

    Raises:
        BidexError: The file cannot be written.
    """
    out = asked or (runs[0].path if len(runs) == 1 and runs[0].path.is_dir() else Path()) / name
    if asked is None:
        refuse_links(out)
    check_writable(out)
    return out


def parse(options: type[Options], arguments: Sequence[str], command: str, default: Options | None = None) -> Options:
    """The flags of one subcommand.

    Args:
        options: A dataclass whose docstring opens with a sentence and an example: it heads the help text.
        arguments: What follows the subcommand's name.
        command: The subcommand's name.
        default: Values of the flags that are not given; the dataclass's own by default.

    Raises:
        BidexError: An unknown flag (with the nearest one) or a bad value.
        SystemExit: After printing the help text.
    """
    if _asked_for_flags.get():
        raise FlagsFound(options, default)
    complaint = io.StringIO()
    keywords: dict[str, Any] = {} if default is None else {"default": default}
    try:
        # tyro prints a box of several lines and exits; we keep its words and drop the box.
        with contextlib.redirect_stderr(complaint):
            parsed, unknown = tyro.cli(
                options, args=list(arguments), prog=f"bidex-meta {command}", return_unknown_args=True, **keywords
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise BidexError(f"{_one_line(complaint.getvalue())}. See bidex-meta {command} --help.") from None
    if unknown:
        _refuse(unknown[0], options if default is None else default, command)
    check_fields(parsed, command, as_flags=True)
    return parsed


def peek(arguments: Sequence[str], flag: str) -> str | None:
    """The value of ``flag`` before the real parse, which may need it to know its own defaults; None if not given.

    Of several the last, as in the real parse.
    """
    found = None
    for place, word in enumerate(arguments):
        if word == flag and place + 1 < len(arguments):
            found = arguments[place + 1]
        if word.startswith(f"{flag}="):
            found = word.partition("=")[2]
    return found


def peek_all(arguments: Sequence[str], flag: str) -> list[str]:
    """As ``peek``, the values of a flag that may be given several times, in their order."""
    pairs = zip_longest(arguments, arguments[1:])
    found = [value if word == flag else word.partition("=")[2] for word, value in pairs if word.split("=")[0] == flag]
    return [value for value in found if value]


def _refuse(word: str, options: Any, command: str) -> NoReturn:
    end = f"See bidex-meta {command} --help."
    if not word.startswith("-"):
        raise BidexError(f"Unexpected {word!r} after bidex-meta {command}. {end}")
    flag = word.split("=")[0]
    near = _near(flag, list(_flags(options)))
    hint = f"Did you mean {' or '.join(near)}? " if near else ""
    raise BidexError(f"Unknown flag {flag} of bidex-meta {command}. {hint}{end}")


def _near(flag: str, known: list[str]) -> list[str]:
    """The flags that were probably meant.

    Those of the same last part (``--gamma``) or of words that begin with its letters (``--lr``), else what is spelt
    most like it.
    """
    given = flag.lstrip("-").lower().replace("_", "-").rpartition(".")[2]
    last = {name: name.lstrip("-").rpartition(".")[2] for name in known}
    same = [name for name in known if last[name] == given]
    short = [name for name in known if _initials(last[name]) == given]
    # Of critic-learning-rate and the like, where there is no plain learning-rate.
    ending = [name for name in known if _initials(last[name])[-2:] == given]
    spelt = difflib.get_close_matches(flag.lower(), known, n=1, cutoff=0.5)
    by_last = difflib.get_close_matches(given, list(last.values()), n=1, cutoff=0.75)
    return same or short or ending or spelt or [name for name in known if last[name] in by_last]


def _initials(name: str) -> str:
    return "".join(word[:1] for word in name.split("-"))


def _flags(options: Any, prefix: str = "--") -> Iterator[str]:
    """Every flag of a dataclass and of those it holds."""
    for field in dataclasses.fields(options):
        name = prefix + field.name.replace("_", "-")
        value = getattr(options, field.name, field.default)
        if dataclasses.is_dataclass(value):
            yield from _flags(value, prefix if field.name == "config" else f"{name}.")
        else:
            yield name
            if isinstance(value, bool):
                yield f"{prefix}no-{field.name.replace('_', '-')}"


def _one_line(box: str) -> str:
    """The message in tyro's box: what stands between its title and the first rule."""
    lines = [line.strip().strip("│").strip() for line in box.splitlines()]
    # Where the terminal cannot draw, the title is a line of its own with a rule below, not part of the upper edge.
    start = next((i + 1 for i, line in enumerate(lines) if line and set(line) <= set("-")), 0)
    start = 1 if box.lstrip().startswith("╭") else start
    words: list[str] = []
    for line in lines[start:]:
        if words and re.fullmatch(r"[─-]+|╰.*", line):
            break
        words += [line] if line else []
    return " ".join(words).rstrip(".") or "Bad command line"
