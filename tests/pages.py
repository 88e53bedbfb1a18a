"""What stands in the pages as code: docs/ and the READMEs. A comment before a block says what is special about it.

``<!-- code: file NAME -->``: the block is this file; ``<!-- code: skip REASON -->``: it is not run, and why;
``<!-- code: needs MODULE -->``: it is run where that is installed.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md")
PAGES += tuple(ROOT / folder / "README.md" for folder in ("algos", "assets", "suites"))
PAGES += tuple(sorted((ROOT / "bidex_meta").glob("*/README.md")))
PAGES += tuple(sorted((ROOT / "docs").rglob("*.md")))
_BLOCK = re.compile(
    r"(?:^<!-- code: (?P<mark>.*?) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    mark: str
    """``file NAME``, ``skip REASON``, ``needs MODULE`` or nothing."""


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    for found in _BLOCK.finditer(page.read_text(encoding="utf-8")):
        yield Block(found["language"], found["text"], found["mark"] or "")


def files_of(page: Path) -> dict[str, str]:
    """The files that a page shows whole, by name."""
    return {block.mark.split()[1]: block.text for block in blocks(page) if block.mark.startswith("file ")}
