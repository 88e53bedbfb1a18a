"""``against`` and ``field`` of ``python -m tools.bench``: our worlds beside other code's and other people's."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import metaworld
import pytest

from bidex_meta.metaworld import batched
from bidex_meta.runs.versions import git_state
from tools.bench import against, field
from tools.bench.__main__ import main
from tools.bench.against import HERE


def test_world_against_the_same_code_finds_the_same_physics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, str]] = []
    ask = against._Worker.ask

    def noted(worker: Any, name: str, **given: Any) -> Any:
        asked.append((id(worker), name))
        return ask(worker, name, **given)

    monkeypatch.setattr(against._Worker, "ask", noted)
    out = tmp_path / "against.json"
    flags = "--suite MT1 --num-envs 8 --steps 2 --repeats 2 --threads 1 --classes"
    main(["against", str(HERE), *flags.split(), "--out", str(out)])
    assert "1/" in capsys.readouterr().out
    found = json.loads(out.read_text())
    assert (found["suite"], found["num_envs"], found["threads"], found["steps"]) == ("MT1", 8, 1, 2)
    assert found["old"]["commit"] == (git_state(HERE / "bidex_meta") or {"commit": None})["commit"]
    assert [(row["what"], row["rows"]) for row in found["table"]] == [("MT1", 8), ("CatchUnderarm", 2)]
    for row in found["table"]:
        assert min(row["old"], row["new"]) > 1
        assert 0.0 < row["least"] <= row["ratio"] <= row["most"]
        assert row["old physics"] == row["new physics"] != ""
    steps = [worker for worker, name in asked if name == "step"]
    assert len(set(steps)) == 2 and steps[:6] == [*steps[:2], *steps[:2][::-1], *steps[:2]]  # each first in turn


def test_bench_field_measures_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(field, "importlib", SimpleNamespace(import_module=missing))
    monkeypatch.setattr(field, "_SUITES", ("MT1",))
    monkeypatch.setattr(metaworld, "_N_GOALS", 2)  # drawing all fifty tasks of a class takes seconds
    monkeypatch.setattr(batched, "TASKS_PER_CLASS", 2)
    found = field.field(num_envs=4, steps=20, repeats=1, seed=1919)  # no other test's tasks stay cached as two
    assert list(found["skipped"]) == ["gymnasium-robotics"]
    theirs, through_ours, ours = found["table"]
    assert [row["rows"] for row in found["table"]] == [10, 10, 4]
    assert (theirs["ratio"], theirs["actions"], ours["actions"]) == (1.0, 4, 52)
    assert theirs["physics_s_per_step"] == through_ours["physics_s_per_step"] == 0.0125
    assert ours["physics_s_per_step"] == pytest.approx(1 / 60, abs=1e-4)
    assert all(row["env_steps_per_s"] > 0 and row["env_steps_per_cpu_s"] > 0 for row in found["table"])
