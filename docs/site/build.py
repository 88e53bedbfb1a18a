"""Builds the documentation site from the repository's Markdown: stages pages and what they link to, calls mkdocs.

Links are relative, as GitHub has them. So the pages are laid out as in the repository, with every file they link to; a
link to a folder leads to its README.
"""

import re
import shutil
import sys
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STAGE = ROOT / "build" / "site-pages"
LINK = re.compile(r"(\]\()(?!https?://|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)")
WITHIN_VALUES = re.compile(r"(?<=\d) (?=%|[→×]|to [-\d])|(?<=\d to) (?=[-\d])|(?<=[→×]) (?=[-\d])|(?<=,) (?=[^],\s]+])")
"""Spaces within a value of a table, as in ``89.5 % (88.7 to 90.6)``, where a narrow cell must not break the line."""


def stage() -> list[Path]:
    """Copy README.md, every page under docs/ and, repeatedly, the files that pages link to; return the pages."""
    shutil.rmtree(STAGE, ignore_errors=True)
    waiting = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "CHANGELOG.md",
        *(ROOT / "docs" / "site" / name for name in ("site.css", "iframe-worker.js")),
        *sorted((ROOT / "docs").rglob("*.md")),
    ]
    seen: list[Path] = []
    while waiting:
        source = waiting.pop()
        if source in seen:
            continue
        seen.append(source)
        target = STAGE / source.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix != ".md":
            shutil.copyfile(source, target)
            continue
        text = source.read_text(encoding="utf-8")
        linked = [(source.parent / found[2]).resolve() for found in LINK.finditer(text)]
        waiting += [_page_of(path) for path in linked if _page_of(path).is_file()]
        text = LINK.sub(partial(_for_the_site, source), text)
        text = re.sub(r"^\|.*$", _with_whole_values, text, flags=re.MULTILINE)
        target.write_text(text, encoding="utf-8")
    return [page for page in seen if page.suffix == ".md"]


def _page_of(path: Path) -> Path:
    return path / "README.md" if path.is_dir() else path


def _for_the_site(source: Path, found: re.Match[str]) -> str:
    """Return a link as the site needs it: to a folder's README."""
    path = (source.parent / found[2]).resolve()
    if not path.is_dir():
        return found[0]
    return f"{found[1]}{found[2].rstrip('/')}/README.md{found[3] or ''})"


def _with_whole_values(row: re.Match[str]) -> str:
    """Return the row of a table whose values do not break between number and unit."""
    return WITHIN_VALUES.sub("\N{NO-BREAK SPACE}", row[0])


if __name__ == "__main__":
    from mkdocs.__main__ import cli

    print(f"{len(stage())} pages")
    sys.exit(cli(["build", "--clean", "--config-file", str(Path(__file__).with_name("mkdocs.yml")), *sys.argv[1:]]))
