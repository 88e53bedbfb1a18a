from pathlib import Path

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.utils import paths


def test_a_packed_folder_goes_before_the_one_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "bidex_meta"
    monkeypatch.setattr(paths, "_PACKAGE", package)
    (tmp_path / "suites").mkdir()
    assert paths.suites_dir() == tmp_path / "suites"
    (package / "suites").mkdir(parents=True)
    assert paths.suites_dir() == package / "suites"
    with pytest.raises(BidexError, match="Expected the folder assets/"):
        paths.assets_dir()
