"""Fill the marked blocks of pages with tables and pictures of studies.

::

    <!-- results: study=multitask show=table -->
    (replaced)
    <!-- end -->

``docs/sweeps.md`` lists the values of ``show``.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from PIL import Image

from bidex_meta.errors import BidexError
from bidex_meta.runs import plots
from bidex_meta.utils.files import read_text
from tools.pages import tables
from tools.pages.gained import adaptation_table, gains_table
from tools.pages.gpu import gpu_table
from tools.pages.ladder import ladder_figure, ladder_table, suites_table
from tools.pages.leaderboard import leaderboard_table
from tools.pages.offline import offline_table
from tools.pages.pretrained import pretrained_table
from tools.pages.scaling import rows_figure, rows_table
from tools.pages.studies import bars_figure, curves_figure, digest_of, read_studies
from tools.pages.validity import teachers_table, validity_table

_BLOCK = re.compile(r"(?P<head><!-- results: (?P<words>[^\n]*?) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)
_TABLES = {
    "table": tables.arms_table,
    "classes": tables.classes_table,
    "adaptation": adaptation_table,
    "gains": gains_table,
    "ladder": ladder_table,
    "ladder-suites": suites_table,
    "offline": offline_table,
    "rows": rows_table,
}
_WITHOUT_STUDY = {
    "gpu": gpu_table,
    "teachers": teachers_table,
    "validity": validity_table,
    "leaderboard": leaderboard_table,
    "pretrained": pretrained_table,
}
_FIGURES = {
    "bars": (bars_figure, "Success per class"),
    "curves": (curves_figure, "Return and success of training episodes, which have exploration noise"),
    "ladder-curves": (ladder_figure, "Success after each shot of exploring episodes; bands: worst and best seed"),
    "row-curves": (rows_figure, "Return over training, by number of environments"),
}
_JOINED = ("ladder", "ladder-suites", "ladder-curves")
"""Tables and pictures that show all suites of a study together. All others show one suite each."""
_DIGEST = "Description"
"""Entry of a picture's PNG metadata that holds the digest of the picture's data."""


@dataclass(frozen=True)
class Block:
    """Options of a marked block of a page: the table or picture that fills the block."""

    study: str = ""  # Name of a study, or of several studies with commas between for a joint table or picture.
    show: str = "table"  # Kind of the table or picture.
    on: str | None = None  # Suite or class to show; None: all.
    split: str | None = None  # Split of meta-tests to show; None: all.


def filled_pages(root: Path) -> list[Path]:
    """List the pages of the repository whose blocks are kept up to date."""
    return [root / "README.md", root / "docs" / "pretrained.md", *sorted((root / "docs" / "results").glob("*.md"))]


def fill(page: Path, data: Path, check: bool = False) -> list[Path]:
    """Update the blocks and pictures of a Markdown page from the studies' files in the folder ``data``.

    Returns the files that are written, or, with ``check``, would be written. Raises BidexError if a block does not end
    or names an unknown study or table, or if a data file cannot be read.
    """
    text = read_text(page, "a page")
    changed: list[Path] = []
    if text.count("<!-- results:") != text.count("<!-- end -->"):
        raise BidexError(f"{page}: a block begins with <!-- results: ... --> and ends with <!-- end -->. Fix it.")

    def replaced(found: re.Match[str]) -> str:
        try:
            block = Block(**dict(word.split("=") for word in found["words"].split()))
            lines = list(_lines(block, page, data, check, changed))
        except (KeyError, TypeError, ValueError) as error:
            raise BidexError(f"{page}: cannot make the block {found['words']!r}: {error}") from error
        return f"{found['head']}\n" + "\n".join(lines or ["No runs yet."]) + f"\n\n{found['end']}"

    new = _BLOCK.sub(replaced, text)
    if new != text:
        changed.append(page)
        if not check:
            page.write_text(new)
    return changed


def _lines(block: Block, page: Path, data: Path, check: bool, changed: list[Path]) -> Iterator[str]:
    """Yield the Markdown lines that fill a marked block of a page, and draw the block's pictures."""
    if block.show == "references":
        yield from tables.references_table(block.on or "")
        return
    if block.show in _WITHOUT_STUDY:
        yield from _WITHOUT_STUDY[block.show](block.on or "", data)
        return
    if not block.study:
        raise ValueError("expected the name of a study")
    names = block.study.split(",")
    studies = list(chain.from_iterable(read_studies(data, name, block.on, block.split) for name in names))
    if block.show == "best":
        yield from tables.best_table(studies) if studies else ()
        return
    if studies and (len(names) > 1 or block.show in _JOINED):
        parts = [studies]
    else:
        parts = [[study] for study in studies]
    several = len(parts) > 1
    for number, part in enumerate(parts):
        on = ", ".join(dict.fromkeys(study.on for study in part))
        if several:
            yield from ["", f"**{on}**", ""] if number else [f"**{on}**", ""]
        if block.show in _TABLES:
            yield from _TABLES[block.show](*part)
            continue
        draw, title = _FIGURES[block.show]
        words = [*names, on if several or block.on else None, block.split, block.show]
        picture, digest = page.parent / f"{'-'.join(filter(None, words))}.png", digest_of(part)
        if _stored_digest(picture) != digest:
            changed.append(picture)
            if not check:
                plots.save(draw(*part), picture, {_DIGEST: digest})
        yield f"![{title}: {', '.join(names)}, {on}]({picture.name})"


def _stored_digest(picture: Path) -> str | None:
    """Return the digest of a picture's data that is stored in the picture; None if there is no picture.

    The bytes of pictures cannot be compared instead, because they depend on the version of matplotlib.
    """
    if not picture.exists():
        return None
    with Image.open(picture) as opened:
        return opened.info.get(_DIGEST)
