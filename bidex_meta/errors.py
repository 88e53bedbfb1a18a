"""The exception for bad input, and exit codes.

The exception's message is one line that says what was expected, what was given, and how to fix it.
"""

import difflib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

EXIT_BAD_INPUT = 2
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130
EXIT_UNREAD = 141
"""Exit codes of the command line. After Ctrl-C, SIGTERM, SIGHUP, SIGUSR1 or SIGUSR2 the code is 128 plus the signal's
number, as shells expect. If the reader of the output has ended, the code is that of SIGPIPE."""


class BidexError(ValueError):
    """Bad input from a user. The command line prints it as one line and exits with code 2."""

    def __init__(self, message: str) -> None:
        # Given values may contain line breaks, which would spread the message over several lines.
        super().__init__(" ".join(message.split()) if "\n" in message else message)


def known_name(kind: str, name: str, known: Iterable[str], meant: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the known name that equals ``name``, ignoring case.

    ``kind`` says what is looked up, e.g. ``"suite"``. Raises BidexError if there is none. The message suggests the
    nearest name, or the name that ``meant`` maps ``name`` to, and lists all known names.
    """
    names = list(known)
    if isinstance(name, str) and name in names:
        return name
    found = [other for other in names if other.casefold() == str(name).casefold()]
    if len(found) != 1:
        raise unknown_name(kind, name, names, meant)
    return found[0]


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that was probably meant, or None.

    The part of a known name after its prefix is enough: ``MT10`` for ``metaworld/MT10``.
    """
    given = name.casefold()
    names = list(known)
    for other in names:
        if other.rpartition("/")[2].casefold() == given:
            return other
    folded = {other.casefold(): other for other in names}
    near = difflib.get_close_matches(given, list(folded), n=1, cutoff=0.4)
    return folded[near[0]] if near else None


def unknown_name(
    kind: str, name: str, known: Iterable[str], meant: Mapping[str, str] = MappingProxyType({})
) -> BidexError:
    """Return the error for an unknown name, with the nearest known name and a list of all known names.

    ``kind`` says what was looked up, e.g. ``"suite"``. ``meant`` maps names, in lower case, to the names to suggest.
    """
    names = sorted(known)
    near = meant.get(str(name).casefold()) or nearest(str(name), names)
    hint = f" Did you mean {near!r}?" if near else ""
    return BidexError(f"Unknown {kind} {shortened(name)}.{hint} Known: {', '.join(names) or 'none'}.")


def shortened(value: object) -> str:
    """Return a value as text of at most 80 characters, for one line of an error.

    Python refuses to print whole numbers of more than 4,300 digits; the text then says so.
    """
    try:
        shown = " ".join(repr(value).split())
    except Exception:
        shown = f"a {type(value).__name__} that cannot be printed"
    return shown if len(shown) <= 80 else shown[:77] + "..."


def one_line(text: object) -> str:
    """Return a text on one line, without control characters that a terminal would act on.

    The text may contain names that strangers chose. Words of more than 400 letters are cut after 200.
    """
    words = " ".join(word if len(word) <= 400 else f"{word[:200]}..." for word in str(text).split())
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in words)
