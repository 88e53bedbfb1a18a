"""The documentation site: every page is in its navigation, its links lead to what is staged, and mkdocs builds it."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from tests.pages import ROOT


@pytest.fixture
def build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_build", ROOT / "docs" / "site" / "build.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "STAGE", tmp_path / "pages")
    return module


def test_navigation_has_every_page_once(build: ModuleType) -> None:
    pages = sorted(page.relative_to(ROOT).as_posix() for page in build.stage())
    config = (ROOT / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8")
    assert sorted(re.findall(r"[\w/-]+\.md\b", config.partition("\nnav:")[2])) == pages


def test_what_pages_link_to_is_staged(build: ModuleType) -> None:
    build.stage()
    for page in build.STAGE.rglob("*.md"):
        for found in build.LINK.finditer(page.read_text(encoding="utf-8")):
            assert (page.parent / found[2]).is_file(), f"{page.name}: {found[0]}"


def test_mkdocs_builds_it_and_it_loads_nothing_from_elsewhere(build: ModuleType, tmp_path: Path) -> None:
    mkdocs_config = pytest.importorskip("mkdocs.config", reason="needs the extra docs: `make docs`")
    pytest.importorskip("material", reason="needs the extra docs")
    from mkdocs.commands.build import build as make  # pyright: ignore[reportMissingImports]

    build.stage()
    config = ROOT / "docs" / "site" / "mkdocs.yml"
    made = tmp_path / "site"
    make(mkdocs_config.load_config(str(config), docs_dir=str(build.STAGE), site_dir=str(made)))
    for page in made.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?https?:", text), page
        assert 'class="mermaid"' not in text, "mermaid's script would be loaded from a network"
