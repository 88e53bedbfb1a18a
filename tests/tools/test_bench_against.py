"""``against`` and ``field`` of ``python -m tools.bench``: our worlds beside other code's and other people's."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import metaworld
import mujoco
import numpy as np
import pytest

from bidex_meta.errors import BidexError
from bidex_meta.metaworld import batched
from bidex_meta.runs.versions import git_state
from tools.bench import against, field
from tools.bench.__main__ import main
from tools.bench.against import HERE, checkout, commit_name, recorded


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


def test_a_worker_says_what_is_wrong_and_that_it_ended(tmp_path: Path) -> None:
    world = {"suite": "MT1", "task": None, "num_envs": 2, "threads": 1, "seed": 0}
    with against._Worker(HERE) as worker:
        with pytest.raises(BidexError, match="cannot build: num_envs: expected at least 4"):
            worker.ask("build", **world)
        with pytest.raises(BidexError, match=f"imports that of {HERE}"):
            worker.ask("classes", checkout=str(tmp_path), suite="MT1", seed=0)
        worker._process.kill()
        with pytest.raises(BidexError, match="its process ended"):
            worker.ask("step", steps=1, seed=0)


@pytest.mark.skipif(git_state(HERE / "bidex_meta") is None, reason="not a git checkout")
def test_a_commit_is_unpacked_for_the_time_being() -> None:
    with checkout("HEAD") as folder:
        assert (folder / "suites" / "MT4.toml").is_file() and folder != HERE
    assert not folder.exists()
    assert commit_name("HEAD") == (git_state(HERE / "bidex_meta") or {})["commit"]


def test_a_file_names_its_commit_and_the_ratios_of_its_run(tmp_path: Path) -> None:
    file = tmp_path / "then.json"
    table = [{"what": "MT4", "ratio": 1.5}, {"what": "HandOver", "ratio": 2.0}]
    file.write_text(json.dumps({"old": {"commit": "e0e28c4", "dirty": False}, "table": table}))
    assert recorded(str(file)) == ("e0e28c4", {"MT4": 1.5, "HandOver": 2.0})
    assert recorded("e0e28c4") == ("e0e28c4", {})
    file.write_text(json.dumps({"old": {"commit": "e0e28c4", "dirty": True}, "table": []}))
    with pytest.raises(BidexError, match="not measured against a commit"):
        recorded(str(file))


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


def test_the_mend_of_gymnasium_robotics_lets_joint_types_be_found() -> None:
    utils = SimpleNamespace(mujoco=mujoco)
    field._mend(utils)
    assert np.int32(3) in (utils.mujoco.mjtJoint.mjJNT_HINGE, utils.mujoco.mjtJoint.mjJNT_SLIDE)
    assert utils.mujoco.mj_forward is mujoco.mj_forward
    assert utils.mujoco.mjtObj is mujoco.mjtObj
