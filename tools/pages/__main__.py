"""``python -m tools.pages [--check] [PAGE...]`` (``make results``): fill pages, from the repository's root."""

import sys
from itertools import chain
from pathlib import Path

import tyro

import tools
from tools.pages.blocks import fill, filled_pages


def main(pages: tyro.conf.Positional[tuple[Path, ...]] = (), check: bool = False) -> None:
    """Fill the marked blocks of pages from results/data and print the files that changed.

    Args:
        pages: Markdown files; default: README.md, docs/pretrained.md and docs/results.
        check: Write nothing; exit code 1 if a file is out of date.
    """
    named = pages or filled_pages(Path("."))
    changed = list(chain.from_iterable(fill(page, Path("results/data"), check) for page in named))
    print("\n".join(map(str, changed)) or "nothing changed")
    sys.exit(check and bool(changed))


if __name__ == "__main__":
    tools.run(main)
