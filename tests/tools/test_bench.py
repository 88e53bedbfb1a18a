"""``python -m tools.bench``: each of its benches once, as small as it goes."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import metaworld
import pytest
import torch

from bidex_meta.metaworld import batched
from tools.bench import field
from tools.bench import stability as physics
from tools.bench.__main__ import main
from tools.bench.against import HERE
from tools.bench.capacity import capacity
from tools.bench.stability import stability


def test_stability(monkeypatch: pytest.MonkeyPatch) -> None:
    found = stability(task="HandOver", steps=40, num_envs=8, threads=1)
    assert list(found) == ["HandOver", "HandOver (fixed base)"]
    for result in found.values():
        assert (result["env_steps"], result["unstable"], result["warnings"], result["holds"]) == (40, 0, 0, True)
        assert 0.0 < result["fastest_object"] < physics.MAX_OBJECT_SPEED
    rough = physics.rough_actions

    def broken(*given: torch.Tensor) -> torch.Tensor:
        action = rough(*given)  # type: ignore[arg-type]
        action[0, 0] = math.nan
        return action

    monkeypatch.setattr(physics, "rough_actions", broken)
    result = stability(task="CatchUnderarm", steps=16, num_envs=4, threads=1)["CatchUnderarm"]
    assert result["unstable"] == 4 and result["holds"] is False


@pytest.mark.timeout(900)  # a cold cache of Warp kernels compiles for a minute and more
@pytest.mark.xdist_group("warp")
def test_capacity_counts_what_c_and_the_warp_engine_see() -> None:
    (result,) = capacity(task="CatchUnderarm", steps=24, num_envs=8, threads=1).values()
    assert [result[name]["samples"] for name in ("contacts", "rows", "candidates", "convex")] == [24, 24, 96, 96]
    for counts in result.values():
        assert 0 <= counts["median"] <= counts["q999"] <= counts["q9999"] <= counts["max"]
    assert 0 < result["contacts"]["max"] <= result["candidates"]["max"] < 60


def test_gpu_measures_no_row_of_its_file_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "sweep.json"
    words = ["gpu", "--suite", "MT1", "--tasks", "HandOver", "--sizes", "4", "--steps", "2", "--device", "cpu"]
    main([*words, "--learning", "--out", str(out)])
    found = json.loads(out.read_text())
    assert list(found["rows"]) == ["MT1 4", "HandOver 4"] and found["setting"]["machine"] == "cpu"
    assert all(min(row["env_steps_per_s"], row["training_steps_per_s"]) > 1 for row in found["rows"].values())
    monkeypatch.setattr("tools.bench.gpu._measured", None)
    main([*words, "--out", str(out)])
    with pytest.raises(SystemExit, match="name another file"):
        main([*words, "--steps", "3", "--out", str(out)])


def test_the_same_code_has_the_same_physics(tmp_path: Path) -> None:
    out = tmp_path / "against.json"
    flags = "--suite MT1 --num-envs 8 --steps 2 --repeats 2 --threads 1 --classes"
    main(["against", str(HERE), *flags.split(), "--out", str(out)])
    table = json.loads(out.read_text())["table"]
    assert [(row["what"], row["rows"]) for row in table] == [("MT1", 8), ("CatchUnderarm", 2)]
    assert all(row["old physics"] == row["new physics"] != "" for row in table)


def test_other_peoples_worlds_are_measured_where_they_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(field, "importlib", SimpleNamespace(import_module=missing))
    monkeypatch.setattr(field, "_SUITES", ("MT1",))
    monkeypatch.setattr(metaworld, "_N_GOALS", 2)  # drawing all fifty tasks of a class takes seconds
    monkeypatch.setattr(batched, "TASKS_PER_CLASS", 2)
    found = field.field(num_envs=4, steps=20, repeats=1, seed=1919)  # no other test's tasks stay cached as two
    assert list(found["skipped"]) == ["gymnasium-robotics"]
    assert [(row["rows"], row["actions"]) for row in found["table"]] == [(10, 4), (10, 4), (4, 52)]
