"""The table of learners from data sets: which runs make a cell, and its scores against the paper's formula."""

import json
from pathlib import Path

import pytest

from bidex_meta.errors import BidexError
from tests.fakes import change, evaluated_run, log
from tests.tools import test_collect
from tests.tools.test_collect import collect
from tools.collect import portable
from tools.pages.blocks import fill

no_weights = test_collect.no_weights
RANDOM = {"classes": {"C": {"success": 0.0, "return": 2.0}}}


def made(root: Path, name: str, algo: str, seed: int, score: float, dataset: str | None, **learner: float) -> Path:
    """An evaluated run on class C whose return is 2 + 0.2 ``score``; the expert's is 22."""
    path = evaluated_run(root, seed, {"C": 0.5}, algo, task="C", **learner)
    log(path, {"step": 1000, "Perf/training_time": 7.0})
    change(path, steps=1000, **({} if dataset is None else {"dataset": [dataset], "task_seed": 0}))
    found = json.loads((path / "evaluation.json").read_text())
    found["policy"]["classes"]["C"]["return"] = 2.0 + 0.2 * score
    (path / "evaluation.json").write_text(json.dumps({**found, "random": RANDOM}))
    (path / "versions.json").write_text(json.dumps({"git": {"commit": "a" * 40, "dirty": False}}))
    return path.rename(root / name)


def test_cells_are_scores_of_seeds_by_kind_of_data_and_learner(tmp_path: Path) -> None:
    into, page = tmp_path / "data" / "offline", tmp_path / "page.md"
    runs = [
        made(tmp_path, f"C-medium-iql-s{seed}", "iql", seed, 30 + 10 * seed, "C/medium-v0", gamma=0.9)
        for seed in (0, 1, 2)
    ]
    runs.append(made(tmp_path, "C-random-bc-s0", "bc", 0, -5.0, str(tmp_path / "C" / "random-v0")))
    page.write_text("<!-- results: study=offline show=offline on=C -->\n<!-- end -->\n")
    assert fill(page, tmp_path / "data") and "No runs yet." in page.read_text()
    collect(*runs, made(tmp_path, "expert", "ppo", 0, 100.0, None), into=into)
    assert fill(page, tmp_path / "data") == [page] and fill(page, tmp_path / "data") == []
    text = page.read_text()
    assert [line for line in text.splitlines() if line.startswith("|")] == [
        "| data | bc | iql |",
        "|---|---|---|",
        "| random | -5.0; 50 % | – |",
        "| medium | – | 40.0 (30.0 to 50.0); 50 % |",
    ]
    assert "Seeds: 1 or 3. Updates: bc 1,000; iql 1,000." in text
    assert "Returns: expert 22 (success 50 %), uniform actions 2." in text
    assert json.loads((into / "C-random-bc-s0.json").read_text())["config"]["dataset"] == ["C/random-v0"]
    other = made(tmp_path, "C-medium-iql-s3", "iql", 3, 1.0, "C/medium-v0", gamma=0.5)
    collect(other, into=into)
    with pytest.raises(BidexError, match=r"both of the arm 'medium iql', but learner.gamma"):
        fill(page, tmp_path / "data")


def test_places_of_data_do_not_get_into_files() -> None:
    config = {"suite": None, "task": "C", "dataset": ["/a/b/C/x-v0", "C/y-v0"], "demonstrations": "/a/C/z-v0"}
    kept = portable(config)
    assert (kept["dataset"], kept["demonstrations"]) == (["C/x-v0", "C/y-v0"], "C/z-v0")
