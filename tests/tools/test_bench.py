"""``python -m tools.bench``: each of its benches once, as small as it goes."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import metaworld
import numpy as np
import pytest
import torch

from bidex_meta.metaworld import batched
from tools.bench import field
from tools.bench import stability as physics
from tools.bench.__main__ import main
from tools.bench.against import HERE
from tools.bench.capacity import capacity
from tools.bench.cones import _parts, cones
from tools.bench.launches import launches
from tools.bench.scripted import scripted
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


@pytest.mark.timeout(900)
@pytest.mark.xdist_group("warp")
def test_cones_counts_what_changes_between_iterations() -> None:
    assert cones(task="CatchUnderarm-v2", steps=2, num_envs=2, threads=1) == {"table": []}, "it has pyramids"
    (row,) = cones(task="Switch-v2", steps=40, every=20, num_envs=4, threads=1)["table"]
    assert row["class"] == "Switch-v2" and row["played"] == "script"
    assert 1.0 <= row["iterations"] <= row["loops"] < 20.0
    assert 0.0 < row["cone"] <= row["active"] <= 100.0 and row["part changes"] > 0.0
    assert 0.0 < row["work of cones"] <= 100.0 and row["still"] < 100.0


def test_a_contacts_part_of_the_hessian_is_the_second_derivative_of_its_cost() -> None:
    rng = np.random.default_rng(0)
    weight = rng.uniform(1.0, 5.0, 6)
    friction = rng.uniform(0.1, 1.0, 5)
    mu = 0.3
    scale = np.concatenate(([mu], friction))

    def cost(x: np.ndarray) -> float:
        tangent = np.linalg.norm(friction * x[1:])
        return 0.5 * weight[0] / (mu**2 * (1.0 + mu**2)) * (mu * x[0] - mu * tangent) ** 2

    x = np.concatenate(([0.2], rng.normal(size=5)))
    step = 1e-4 * np.eye(6)
    second = np.empty((6, 6))
    for i, a in enumerate(step):
        for j, b in enumerate(step):
            second[i, j] = (cost(x + a + b) - cost(x + a - b) - cost(x - a + b) + cost(x - a - b)) / 4e-8
    (part,) = _parts(np.array([4]), weight[None], x[None], scale[None], np.array([mu]))
    np.testing.assert_allclose(part, second, atol=1e-5 * abs(second).max())
    weights, residuals, scales = (np.stack([each, each]) for each in (weight, x, scale))
    quadratic, none = _parts(np.array([1, 0]), weights, residuals, scales, np.full(2, mu))
    np.testing.assert_array_equal(quadratic, np.diag(weight))
    assert not none.any()


@pytest.mark.timeout(900)
@pytest.mark.xdist_group("warp")
def test_launches_lists_the_kernels_of_a_substep() -> None:
    plain, ours = (
        launches("Switch-v2", 4, steps=20, threads=1, most=99, switches=text) for text in ("", "incremental")
    )
    by_kernel = {row["kernel"]: row for row in plain["table"]}
    assert sum(row["launches"] for row in plain["table"]) == pytest.approx(plain["kernels"], abs=2.0)
    assert by_kernel["_solve_done"]["launches"] >= by_kernel["_solve_done"]["passes"] > 0.0
    kernels = {row["kernel"] for row in ours["table"]}
    assert {"_prepare", "_finish"} <= kernels and "_solve_done" not in kernels
    assert ours["kernels"] < plain["kernels"]


def test_scripted_compares_success_with_and_without_switches() -> None:
    (row,) = scripted(["pyramids"], ["Switch"], threads=1)["table"]
    assert row["class"] == "Switch" and 0 <= row["pyramids"] <= 100 and row["none"] > 50


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
