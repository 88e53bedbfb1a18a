"""What commands print on: encodings that lack letters, terminals of any width."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.utils import streams

SWEEP = """\
name = "tiny"
tasks = ["HandOver"]
seeds = [0]
[[arms]]
name = "ppo"
algo = "ppo"
"""


def test_a_table_with_a_dash_is_printed_where_the_encoding_has_none(tmp_path: Path) -> None:
    file = tmp_path / "tiny.toml"
    file.write_text(SWEEP)
    command = [sys.executable, "-m", "bidex_meta.cli", "sweep", str(file), "--status"]
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr
    assert b"0 done, 0 runs, 0 failed, 1 left" in done.stdout
    assert b"?" in done.stdout


def test_streams_within_python_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="latin-1"))
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    streams.print_anything()
    print("5 – 6 °", flush=True)
    assert raw.getvalue() == "5 ? 6 °\n".encode("latin-1")


@pytest.mark.parametrize(
    ("given", "set_to"),
    [("1", "40"), ("0", "80"), ("-3", "80"), ("wide", "80"), ("9" * 12, "1000"), ("100", "100"), (None, None)],
)
def test_columns_are_ones_that_text_fits_in(given: str | None, set_to: str | None, monkeypatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    if given is not None:
        monkeypatch.setenv("COLUMNS", given)
    monkeypatch.setattr(sys, "__stdout__", None)  # no terminal to ask
    streams.bound_width()
    assert os.environ.get("COLUMNS") == set_to
    assert streams.output_width(180) == int(set_to or 180)


def test_help_in_one_column_is_that_of_forty(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    shown = []
    for columns in ("1", "40"):
        monkeypatch.setenv("COLUMNS", columns)
        with pytest.raises(SystemExit, match="0"):
            main(["sweep", "--help"])
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]
