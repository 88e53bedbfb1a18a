from pathlib import Path

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.utils import paths


def test_checkout_rooms_hold_the_data() -> None:
    assert (paths.suites_dir() / "MT4.toml").is_file()
    assert list(paths.assets_dir().rglob("*.xml"))


def test_packed_room_wins_over_the_one_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "bidex_meta"
    monkeypatch.setattr(paths, "_PACKAGE", package)
    (tmp_path / "suites").mkdir()
    assert paths.suites_dir() == tmp_path / "suites"
    (package / "suites").mkdir(parents=True)
    assert paths.suites_dir() == package / "suites"


def test_missing_room_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "_PACKAGE", tmp_path / "bidex_meta")
    with pytest.raises(BidexError, match="Expected the folder assets/"):
        paths.assets_dir()
