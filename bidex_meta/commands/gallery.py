"""``bidex-meta gallery``: the page of all task classes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.commands.parsing import parse


@dataclass(frozen=True)
class GalleryFlags:
    """Write a page with a picture and the facts of every task class.

    Example: bidex-meta gallery --out docs/tasks.md
    """

    out: Path = Path("docs/tasks.md")
    """The Markdown file; pictures go to images/tasks/ beside it."""


def main(arguments: Sequence[str]) -> None:
    """Write the page and print where it is."""
    flags = parse(GalleryFlags, arguments, "gallery")
    from bidex_meta import gallery
    from bidex_meta.record.atomic import check_writable

    check_writable(flags.out)
    gallery.write(flags.out)
    print(flags.out)
