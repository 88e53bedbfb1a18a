import json
import math
from pathlib import Path

import pytest
import torch

from tools.bench import stability as physics
from tools.bench.__main__ import main
from tools.bench.capacity import capacity
from tools.bench.points import points
from tools.bench.speed import mixing, scaling
from tools.bench.stability import stability


def test_bench_scaling_compares_with_one_thread() -> None:
    found = scaling("MT4", num_envs=8, steps=2, repeats=1)
    assert found["speedup"]["1"] == 1.0
    assert found["env_steps_per_s"].keys() == found["speedup"].keys()


def test_bench_mixing_compares_with_the_classes_alone() -> None:
    found = mixing("MT4", num_envs=8, steps=2, repeats=1, threads=1)
    assert list(found["classes"]) == ["CatchUnderarm", "HandOver", "CatchAbreast", "TwoCatchUnderarm"]
    slowest, fastest = (f(row["env_steps_per_s"] for row in found["classes"].values()) for f in (min, max))
    assert slowest - 1 <= found["harmonic_mean"] <= fastest + 1
    assert found["ratio"] == pytest.approx(found["mixed"] / found["harmonic_mean"], rel=0.01)
    # Two classes with one egg share a batch; HandOver has a longer time step, TwoCatchUnderarm another egg.
    assert [row["group"] for row in found["classes"].values()] == [0, 1, 0, 2]
    assert [row["nv"] for row in found["classes"].values()] == [66, 66, 66, 72]


def test_bench_stability_counts_what_it_saw() -> None:
    found = stability(task="HandOver", steps=40, num_envs=8, threads=1)
    assert list(found) == ["HandOver", "HandOver (fixed base)"]
    for result in found.values():
        assert (result["env_steps"], result["unstable"], result["warnings"]) == (40, 0, 0)
        assert result["depth_samples"] == 5 * physics._SAMPLES_PER_STEP
        assert 0.0 < result["fastest_object"] < physics.MAX_OBJECT_SPEED
        assert result["holds"] is True
    assert json.loads(json.dumps(found)) == found


@pytest.mark.timeout(900)  # a cold cache of Warp kernels compiles for a minute and more
@pytest.mark.xdist_group("warp")
def test_bench_capacity_counts_what_c_and_the_warp_engine_see() -> None:
    (result,) = capacity(task="CatchUnderarm", steps=24, num_envs=8, threads=1).values()
    assert [result[name]["samples"] for name in ("contacts", "rows", "candidates", "convex")] == [24, 24, 96, 96]
    for counts in result.values():
        assert 0 <= counts["median"] <= counts["q999"] <= counts["q9999"] <= counts["max"]
    assert 0 < result["contacts"]["max"] <= result["candidates"]["max"] < 60
    assert result["contacts"]["max"] <= result["rows"]["max"]
    assert json.loads(json.dumps(result)) == result


def test_stability_does_not_hold_when_physics_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    rough = physics.rough_actions

    def broken(*given: torch.Tensor) -> torch.Tensor:
        action = rough(*given)  # type: ignore[arg-type]
        action[0, 0] = math.nan
        return action

    monkeypatch.setattr(physics, "rough_actions", broken)
    result = stability(task="CatchUnderarm", steps=16, num_envs=4, threads=1)["CatchUnderarm"]
    assert result["unstable"] == 4 and result["holds"] is False


@pytest.mark.parametrize(("client", "package"), [("sb3", "stable_baselines3"), ("rsl-rl", "rsl_rl")])
def test_bench_clients_tells_both_sides(client: str, package: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip(package, reason=f"needs the extra {client}")
    main(f"clients --client {client} --num-envs 4 --steps 8 --repeats 1 --threads 1 --json".split())
    found = json.loads(capsys.readouterr().out)
    for part in (found["rollout"], found["training"]):
        assert part["ratio"] == pytest.approx(part["through_the_adapter"] / part["own_loop"], rel=0.02)
        assert 0.01 < part["ratio"] < 100 and 0.01 < part["cpu_ratio"] < 100


def test_bench_points_compares_with_states(capsys: pytest.CaptureFixture[str]) -> None:
    found = points("HandOver", num_envs=4, count=32, steps=2, repeats=2, threads=1)
    assert found["points"] == 32 and found["frames_per_s"].keys() == {"points", "state"} and 0 < found["ratio"] < 1.5


def test_bench_gpu_measures_no_row_of_its_file_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "sweep.json"
    words = ["gpu", "--suite", "MT1", "--tasks", "HandOver", "--sizes", "4", "--steps", "2", "--device", "cpu"]
    main([*words, "--learning", "--out", str(out)])
    found = json.loads(out.read_text())
    assert list(found["rows"]) == ["MT1 4", "HandOver 4"] and found["setting"]["machine"] == "cpu"
    for row in found["rows"].values():
        assert min(row["env_steps_per_s"], row["training_steps_per_s"]) > 1
        assert row["stages"]["physics"] > 0.0
    monkeypatch.setattr("tools.bench.gpu._measured", None)
    main([*words, "--out", str(out)])
    with pytest.raises(SystemExit, match="name another file"):
        main([*words, "--steps", "3", "--out", str(out)])
