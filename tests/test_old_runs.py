"""Runs of earlier code are judged: a folder of each learner, kept from before the rooms (commit 3dffcfe)."""

import json
import shutil
from pathlib import Path

import pytest

from bidex_meta.cli import main

FOLDERS = sorted((Path(__file__).parent / "data" / "old_runs").iterdir())


@pytest.fixture(params=FOLDERS, ids=lambda folder: folder.name)
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return Path(shutil.copytree(request.param, tmp_path / "run"))


def test_options_keep_their_names_order_and_values(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["run", "--resume", str(run), "--print-config"])
    old, new = json.loads((run / "config.json").read_text()), json.loads(capsys.readouterr().out)
    known = {name: value for name, value in new["learner"].items() if name in old["learner"]}
    assert known == old["learner"] and [name for name in new if name in old] == list(old)
    if old["algo"] != "mtsac":  # two of its own once stood among those of all off-policy learners
        assert list(known) == list(old["learner"])


def test_an_old_run_is_judged(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = json.loads((run / "config.json").read_text())
    adapts = config["algo"] in ("promp", "maml", "rl2")
    size = ["--rollouts", "1", "--tasks", "1", "--trials", "1", "--episodes", "1"] if adapts else ["--episodes", "1"]
    main(["evaluate", str(run), "--json", *size])
    assert json.loads(capsys.readouterr().out)
