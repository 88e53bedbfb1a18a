"""Parse flags into dataclasses with tyro, and put every error message on one line."""

import contextlib
import dataclasses
import difflib
import inspect
import io
import re
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar, get_type_hints

import tyro

from bidex_meta.config import Switch
from bidex_meta.errors import BidexError
from bidex_meta.utils.streams import output_width
from bidex_meta.utils.validation import Seed, check_fields, refuse_unused

Options = TypeVar("Options")


_HELP_COLUMN = 26  # column at which texts of the short help begin
_END = re.compile(r"[.;](?: |$)(?![^(]*\))")
"""End of the first sentence of a help text: a full stop or semicolon outside parentheses."""


class FlagsFound(Exception):
    """An exception that carries the flags of a command out of ``parse``; it is raised only inside ``flags_of``."""

    def __init__(self, options: type, default: object) -> None:
        self.options = options
        self.default = default


_asked_for_flags: ContextVar[bool] = ContextVar("asked_for_flags", default=False)


def flags_of(command: Callable[[Sequence[str]], None], arguments: Sequence[str] = ()) -> FlagsFound:
    """Return the dataclass of a subcommand's flags, and the default values if the subcommand sets its own.

    ``command`` is the subcommand's ``main``. ``arguments`` are the words on which the flags may depend, e.g.
    ``--algo``.
    """
    token = _asked_for_flags.set(True)
    try:
        command(arguments)
    except FlagsFound as found:
        return found
    finally:
        _asked_for_flags.reset(token)
    raise TypeError(f"{command.__module__}.main parses no flags")


JsonSwitch = Annotated[Switch, tyro.conf.arg(help="Print the result as JSON.")]
Device = Annotated[str, tyro.conf.arg(help="Device: auto, cpu or cuda:N.")]
Engine = Annotated[
    Literal["auto", "c", "warp"], tyro.conf.arg(help="Physics engine: c, warp, or auto (the faster one on the device).")
]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]  # a run folder, the first word
RunPaths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
"""Run folders, or studies of ``results/data/``: ``FILE``, or ``FILE:RUN`` for one of its runs."""


@dataclasses.dataclass(frozen=True)
class LookFlags:
    """Flags that choose the world in which a policy is shown."""

    run: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = None
    """Folder of the run whose policy is shown; the same as --policy RUN."""
    task: str | None = None
    """Task class to show. None: the first class of the run. The browser's page can switch to another class."""
    object: str | None = None
    """With --task and without --suite: throw this object, a name from `bidex-meta list objects` or an MJCF file
    (docs/objects.md). None: the object of the run, or the class's own."""
    policy: str = "zero"  # Policy to show: zero (the action 0), random, or the folder of a run.
    checkpoint: str = "last"  # Checkpoint of a run: last, best (kept by `bidex-meta run --evaluate-every N`) or a file.
    suite: str | None = None
    """Show the task with the rules and tasks of this suite. None: those of the run; without a run, those of the class
    itself."""
    seed: Seed | None = None
    """Seed that draws tasks and start states. None: that of the run, which draws the tasks of its training; 0 without a
    run."""

    def __post_init__(self) -> None:
        if self.run is not None:
            refuse_unused(self, ("policy",), "with a run folder, which is the policy")
        elif self.policy in ("zero", "random"):
            refuse_unused(self, ("checkpoint",), "without a run")

    @property
    def actor(self) -> str:
        """Return the name of the policy, given as RUN or by --policy."""
        if self.run is None:
            return self.policy
        if str(self.run) in ("zero", "random"):  # a folder may have the name of a policy
            return str(self.run.absolute())
        return str(self.run)


def parse(
    options: type[Options],
    arguments: Sequence[str],
    command: str,
    default: Options | None = None,
    usual: Mapping[str, Sequence[str]] | None = None,
) -> Options:
    """Parse the flags of a subcommand into the dataclass ``options``.

    The docstring of ``options`` is shown as help, so it opens with a sentence and an example. ``default`` has the
    values of flags that are not given. ``usual`` maps headings to flags; if it is given, ``--help`` shows only these
    flags, and ``--help-all`` shows all flags. BidexError is raised if a flag is unknown (the message names the nearest
    flag) or a value is bad; SystemExit is raised after the help text is printed.
    """
    if _asked_for_flags.get():
        raise FlagsFound(options, default)
    if usual is not None:
        if not {"-h", "--help"}.isdisjoint(arguments):
            print(_short_help(options, command, default, usual))
            raise SystemExit(0)
        arguments = ["--help" if word == "--help-all" else word for word in arguments]
    complaint = io.StringIO()
    keywords: dict[str, Any] = {} if default is None else {"default": default}
    try:
        # tyro prints a box of several lines and exits. We print its words without the box.
        with contextlib.redirect_stderr(complaint):
            parsed, unknown = tyro.cli(
                options, args=list(arguments), prog=f"bidex-meta {command}", return_unknown_args=True, **keywords
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        # tyro may take a flag that it does not know for a positional argument, and then complains about that.
        known = {*_flags(options if default is None else default), "--help", "--help-all"}
        for word in arguments:
            if word.startswith("--") and len(word) > 2 and word.split("=")[0] not in known:
                _refuse(word, options if default is None else default, command)
        raise BidexError(f"{_one_line(complaint.getvalue())}. See bidex-meta {command} --help.") from None
    if unknown:
        _refuse(unknown[0], options if default is None else default, command)
    check_fields(parsed, command, as_flags=True)
    return parsed


def _short_help(options: type, command: str, default: object, usual: Mapping[str, Sequence[str]]) -> str:
    """Return the usual flags under their headings, each with the first sentence of its help and its default."""
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        parser = tyro.extras.get_parser(options, default=default)
    actions = {}
    for action in parser._actions:
        actions |= dict.fromkeys(action.option_strings, action)
    doc = getattr(options, "__origin__", options).__doc__ or ""
    width = min(output_width(80), 100)
    lines = [f"usage: bidex-meta {command} [OPTIONS]", ""]
    for line in inspect.cleandoc(doc).splitlines():
        lines += textwrap.wrap(line, width) or [""]
    for heading, flags in usual.items():
        lines += ["", f"{heading}:"]
        for flag in flags:
            if flag not in actions:
                continue
            action = actions[flag]
            text, _, value = " ".join((action.help or "").split()).partition(" (default: ")
            text = re.sub(r" \([^)]{60,}\)", "", re.split(_END, text)[0])
            if value not in ("", "None)", "True)", "False)"):
                text += f" (default: {value}"
            metavar = re.sub(r"^\{None\}\||[\[\]]", "", str(action.metavar or "")).replace("INT INT ...", "INT ...")
            if len(metavar) > _HELP_COLUMN:
                metavar = "NAME"  # --help-all shows the choices
            head = f"  {', '.join(action.option_strings)} {metavar}".rstrip()
            if len(head) >= _HELP_COLUMN:
                lines.append(head)
                head = ""
            indent = " " * _HELP_COLUMN
            lines += textwrap.wrap(text, width, initial_indent=head.ljust(_HELP_COLUMN), subsequent_indent=indent)
    return "\n".join([*lines, "", f"bidex-meta {command} --help-all shows all {len(parser._actions)} flags."])


def peek(arguments: Sequence[str], flag: str) -> str | None:
    """Return the last value of ``flag``, or None.

    The flag is read before the full parse, because the defaults of other flags may depend on it.
    """
    return next(reversed(peek_all(arguments, flag)), None)


def peek_all(arguments: Sequence[str], flag: str) -> list[str]:
    """Return all values of a flag that may be given several times, in the given order; see ``peek``."""
    pairs = zip_longest(arguments, arguments[1:])
    found = [value if word == flag else word.partition("=")[2] for word, value in pairs if word.split("=")[0] == flag]
    return [value for value in found if value]


def _refuse(word: str, options: Any, command: str) -> NoReturn:
    end = f"See bidex-meta {command} --help."
    if not word.startswith("-"):
        raise BidexError(f"Unexpected {word!r} after bidex-meta {command}. {end}")
    flag = word.split("=")[0]
    near = _near(flag, list(_flags(options)))
    if near:
        hint = f"Did you mean {' or '.join(near)}? "
    else:
        hint = ""
    raise BidexError(f"Unknown flag {flag} of bidex-meta {command}. {hint}{end}")


def _near(flag: str, known: list[str]) -> list[str]:
    """Return the known flags that the user may have meant by an unknown flag.

    These have the same last part (``--gamma`` for ``--learner.gamma``), the initials that were given (``--lr`` for
    ``--learner.learning-rate``), or a similar spelling.
    """
    given = flag.lstrip("-").lower().replace("_", "-").rpartition(".")[2]
    last = {name: name.lstrip("-").rpartition(".")[2] for name in known}
    initials = {name: "".join(word[:1] for word in last[name].split("-")) for name in known}
    same = [name for name in known if last[name] == given]
    short = [name for name in known if initials[name] == given]
    # --lr also matches names such as critic-learning-rate if there is no plain learning-rate.
    ending = [name for name in known if initials[name][-2:] == given]
    spelt = difflib.get_close_matches(flag.lower(), known, n=1, cutoff=0.5)
    by_last = difflib.get_close_matches(given, list(last.values()), n=1, cutoff=0.75)
    return same or short or ending or spelt or [name for name in known if last[name] in by_last]


def _flags(options: Any, prefix: str = "--") -> Iterator[str]:
    """Yield every flag of a dataclass and of the dataclasses that it holds; positional arguments are no flags."""
    hints = get_type_hints(options if isinstance(options, type) else type(options), include_extras=True)
    for field in dataclasses.fields(options):
        marks = getattr(hints[field.name], "__metadata__", ())
        if tyro.conf.Positional in marks:
            continue
        for mark in marks:
            yield from getattr(mark, "aliases", None) or ()
        name = field.name.replace("_", "-")
        value = getattr(options, field.name, field.default)
        if dataclasses.is_dataclass(value):
            yield from _flags(value, prefix if name in ("config", "final") else f"{prefix}{name}.")
        else:
            yield from [prefix + name, f"{prefix}no-{name}"][: 1 + isinstance(value, bool)]


def _one_line(box: str) -> str:
    """Extract the error message from the box that tyro draws around it.

    The message is between the box's title and the next horizontal line.
    """
    lines = [line.strip().strip("│").strip() for line in box.splitlines()]
    # If the terminal cannot draw boxes, the title is a separate line with a rule below, not part of the upper edge.
    start = next((i + 1 for i, line in enumerate(lines) if line and set(line) <= set("-")), 0)
    if box.lstrip().startswith("╭"):
        start = 1
    words: list[str] = []
    for line in lines[start:]:
        if words and re.fullmatch(r"[─-]+|╰.*", line):
            break
        words += [line] if line else []
    return " ".join(words).rstrip(".") or "Bad command line"
