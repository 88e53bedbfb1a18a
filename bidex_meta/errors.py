"""The one exception for bad input: a line that names the expected, the received and the mend."""

import difflib
from collections.abc import Iterable


class BidexError(ValueError):
    """Bad input from a user. The command line prints it as one line and exits with code 2."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> BidexError:
    """An error for a name that does not exist, with the nearest known name and the list.

    Args:
        kind: What was looked up, e.g. ``"suite"``.
        name: The name that was given.
        known: All names that exist.
    """
    names = sorted(known)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return BidexError(f"Unknown {kind} {name!r}.{hint} Known: {', '.join(names) or 'none'}.")
