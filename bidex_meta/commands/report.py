"""``bidex-meta report``: runs as one HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.commands.parsing import parse
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class ReportFlags:
    """Runs as one HTML page: final table, curves, adaptation, throughput, differences of configs, films.

    Example: bidex-meta report runs/MT4/mtppo/* runs/MT4/mttrpo/* --out mt4.html

    The page needs no network and no other file. Runs that differ in the seed alone are one line, with intervals.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or files of results/data/."""
    out: Path | None = None
    """The page; None: report.html, in the run folder or, of several, here."""


def main(arguments: Sequence[str]) -> None:
    """Write the page and print where it is.

    Raises:
        BidexError: No run is named, or none has logged anything.
    """
    flags = parse(ReportFlags, arguments, "report")
    if not flags.runs:
        raise BidexError("Name the run folders to show: bidex-meta report RUN...")
    from bidex_meta.record.atomic import check_writable, refuse_links, write_atomic
    from bidex_meta.record.stored import open_run
    from bidex_meta.report import page

    runs = [open_run(path) for path in flags.runs]
    out = flags.out or (runs[0].path if len(runs) == 1 and runs[0].path.is_dir() else Path()) / "report.html"
    refuse_links(*([] if flags.out else [out]))
    check_writable(out)
    text = page.render(runs)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(out, lambda file: file.write(text.encode()))
    print(out)
