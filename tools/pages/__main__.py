"""``make results``: every table and picture that pages make of ``results/data``; run from the repository's root.

``python -m tools.pages [--check] [PAGE...]``; with ``--check`` it writes nothing, and ends with exit code 1
where something is not as the data say.
"""

import sys
from pathlib import Path

from bidex_meta.errors import EXIT_BAD_INPUT, EXIT_FAILED, BidexError


def main(words: list[str]) -> int:
    """Fill the pages and print what has changed."""
    from tools.pages.blocks import fill

    check = "--check" in words
    named = [Path(word) for word in words if word != "--check"]
    try:
        pages = named or [Path("README.md"), *sorted(Path("docs/results").glob("*.md"))]
        changed = [path for page in pages for path in fill(page, Path("results/data"), check)]
    except BidexError as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    print("\n".join(f"{path}{' is not as the data say' if check else ''}" for path in changed) or "nothing changed")
    return EXIT_FAILED if check and changed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
