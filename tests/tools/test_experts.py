"""The best known policy of each class: witness, script or a run."""

import json
from pathlib import Path

import pytest

from bidex_meta.witness.replay import Replay
from tools import collect, experts


def evaluated_run(path: Path, task: str | None, suite: str | None, returns: dict[str, float]) -> Path:
    path.mkdir()
    config = {"task": task, "suite": suite, "algo": "mtppo", "steps": 1000, "seed": 3, "num_envs": 8, "learner": {}}
    (path / "config.json").write_text(json.dumps(config))
    classes = {name: {"success": 0.5, "return": value, "score": None} for name, value in returns.items()}
    (path / "evaluation.json").write_text(json.dumps({"policy": {"classes": classes}}))
    return path


def test_the_expert_is_the_best_of_witness_script_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    totals = {"HandOver": 40.0, "CatchAbreast": 5.0, "CatchUnderarm": 90.0}
    monkeypatch.setattr(experts, "witness_path", lambda name: Path(__file__) if name in totals else tmp_path / "none")
    monkeypatch.setattr(experts, "load_witness", lambda name: name)
    # CatchUnderarm's no longer holds: only three of ten shifted starts succeed.
    monkeypatch.setattr(
        experts, "replay", lambda name, *_: Replay(totals[name], 1, 3 if name == "CatchUnderarm" else 9, 0.0)
    )
    scripts = {name: {"return": value} for name, value in (("HandOver", 39.0), ("TwoCatchUnderarm", 7.0))}
    monkeypatch.setattr(experts, "load", lambda kind: scripts if kind == "script" else {})
    suite = evaluated_run(tmp_path / "a", None, "MT4", {"HandOver": 30.0, "CatchAbreast": 20.0})
    alone = evaluated_run(tmp_path / "b", "CatchAbreast", None, {"CatchAbreast": 12.0})
    for name, row in (("metrics.jsonl", {"step": 1000}), ("versions.json", {"git": {"commit": "c" * 40}})):
        (suite / name).write_text(json.dumps(row) + "\n")
    monkeypatch.setattr(collect, "_parameters", lambda folder: None)
    collect.collect((suite,), into=tmp_path / "data")
    (stored,) = (tmp_path / "data").iterdir()
    out = tmp_path / "expert.json"
    experts.experts((stored, alone), suite="MT4", out=out)
    found = json.loads(out.read_text())["classes"]
    assert {name: (row["return"], row["source"]) for name, row in found.items()} == {
        "HandOver": (40.0, "witness, task 0"),
        "CatchAbreast": (20.0, "mtppo on MT4, 1,000 steps, seed 3"),
        "TwoCatchUnderarm": (7.0, "script"),
    }
