"""Fills the marked blocks of pages with tables and pictures of studies.

::

    <!-- results: study=multitask show=table -->
    (whatever stands here is replaced)
    <!-- end -->

``show`` is ``table`` (an arm a row), ``classes`` (success and return of each class), ``gains`` (what adaptation
gained, by class and run), ``best`` (the best run of each class, in one table), ``offline`` (data sets by learners),
``rows`` (numbers of rows by learners), ``curves``, ``points`` or ``row-curves`` (pictures, written beside the page);
``on=MT4`` shows one suite or class of the study, ``split=test`` of a meta-test one split. ``show=references`` is of no
study: both ends of the score, and witnesses.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError, known_name
from bidex_meta.reading import is_file, read_text
from bidex_meta.record import plots
from bidex_meta.record.atomic import write_atomic
from tools.pages.best import best_table
from tools.pages.gained import gains_table
from tools.pages.offline import offline_table
from tools.pages.reference_ends import references_table
from tools.pages.scaling import rows_figure, rows_table
from tools.pages.studies import Study, arms_table, classes_table, figures, read_studies

_BLOCK = re.compile(r"(?P<head><!-- results: (?P<words>[^\n]*?) -->\n)(?P<old>.*?)(?P<end><!-- end -->)", re.DOTALL)
_OPTIONS = ("study", "show", "on", "split")
_TABLES = {
    "table": arms_table,
    "classes": classes_table,
    "gains": gains_table,
    "offline": offline_table,
    "rows": rows_table,
}
_OVER_ALL = {"best": best_table}
"""Tables of all suites and classes of a study at once."""
_REFERENCES = "references"
_TITLES = {
    "curves": "Return and success over training",
    "points": "Success and score, 95 % intervals over seeds",
    "row-curves": "Return over training, by rows",
}
_DIGEST = "Description"
"""Of a picture's PNG metadata: what data it was drawn from."""


def fill(page: Path, data: Path, check: bool = False) -> list[Path]:
    """Brings a page's blocks and pictures to what the data say.

    Args:
        page: A file of Markdown.
        data: Folder of the studies' folders.
        check: Write nothing.

    Returns:
        The files that are (or, with ``check``, would be) written; none where everything is as the data say.

    Raises:
        BidexError: A block does not end, asks for what there is not, or a file of the data cannot be read.
    """
    text, changed = read_text(page, "a page"), []
    if text.count("<!-- results:") != len(_BLOCK.findall(text)):
        raise BidexError(f"{page}: a block begins with <!-- results: ... --> and ends with <!-- end -->. Mend it.")
    for found in _BLOCK.finditer(text):
        if "<!-- results:" in found["old"]:
            raise BidexError(f"{page}: the block of {found['words']} does not end. Put <!-- end --> below it.")

    def block(found: re.Match[str]) -> str:
        options = _options(found["words"], page)
        if options["show"] == _REFERENCES:
            lines = list(references_table())
        else:
            studies = read_studies(data, options["study"], options.get("on"), options.get("split"))
            lines = list(_lines(studies, options, page, check, changed))
        return f"{found['head']}\n" + "\n".join(lines or ["No runs yet."]) + f"\n\n{found['end']}"

    new = _BLOCK.sub(block, text)
    if new != text:
        changed.append(page)
        if not check:
            write_atomic(page, lambda file: file.write(new.encode()))
    return changed


def _options(words: str, page: Path) -> dict[str, str]:
    options = {"show": "table"}
    for word in words.split():
        name, given, value = word.partition("=")
        if not given or not value:
            raise BidexError(f"{page}: a block's options are written name=value, got {word!r}.")
        options[known_name("option of a block", name, _OPTIONS)] = value
    if options["show"] != _REFERENCES and not re.fullmatch(r"[\w.-]+", options.get("study", "")):
        raise BidexError(f"{page}: expected a block to name its study, such as study=multitask, got {words!r}.")
    options["show"] = known_name("block", options["show"], [*_TABLES, *_OVER_ALL, *_TITLES, _REFERENCES])
    return options


def _lines(
    studies: list[Study], options: dict[str, str], page: Path, check: bool, changed: list[Path]
) -> Iterator[str]:
    show = options["show"]
    if show in _OVER_ALL:
        yield from _OVER_ALL[show](studies) if studies else ()
        return
    for place, study in enumerate(studies):
        if len(studies) > 1:
            yield from ["", f"**{study.on}**", ""] if place else [f"**{study.on}**", ""]
        if show in _TABLES:
            yield from _TABLES[show](study)
            continue
        # A page may have a block for each class of a study: their pictures are two.
        on = [study.on] if len(studies) > 1 or "on" in options else []
        told = [study.name, *on, *([study.split] if study.split else []), show]
        out = page.parent / f"{'-'.join(told)}.png"
        if _digest_of(out) != study.digest:
            changed.append(out)
            if not check:
                plots.save(_figure(study, show), out, {_DIGEST: study.digest})
        yield f"![{_TITLES[show]}: {study.name}, {study.on}]({out.name})"


def _figure(study: Study, show: str) -> Any:
    return rows_figure(study) if show == "row-curves" else figures(study)[show]()


def _digest_of(picture: Path) -> str | None:
    """What a picture was drawn from: its bytes differ with matplotlib's version, what it shows does not."""
    if not is_file(picture):
        return None
    told = plots.missing()
    if told is not None:
        raise BidexError(told)
    from PIL import Image

    with Image.open(picture) as opened:
        return opened.info.get(_DIGEST)
