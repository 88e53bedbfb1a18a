"""``python -m tools.bench``: each of its benches once, as small as it goes."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import metaworld
import numpy as np
import pytest
import torch

from bidex_algos.onpolicy.mtppo import PRESETS
from bidex_meta.metaworld import batched
from tools.bench import field, learner, libraries
from tools.bench import stability as physics
from tools.bench.__main__ import main
from tools.bench.adapt import adapt
from tools.bench.against import HERE
from tools.bench.capacity import capacity
from tools.bench.drift import judge
from tools.bench.launches import launches
from tools.bench.multiagent import multiagent
from tools.bench.points import points
from tools.bench.speed import mixing, scaling
from tools.bench.stability import stability

TINY = replace(PRESETS["laptop"], hidden=(8, 8), rollout_steps=4, num_minibatches=2, epochs=2, autocast="off")


def test_speeds_of_worlds() -> None:
    found = scaling("MT4", num_envs=8, steps=2, repeats=1)
    assert found["speedup"]["1"] == 1.0 and found["env_steps_per_s"].keys() == found["speedup"].keys()
    found = mixing("MT4", num_envs=8, steps=2, repeats=1, threads=1)
    assert found["ratio"] == pytest.approx(found["mixed"] / found["harmonic_mean"], rel=0.01)
    # Two classes with one egg share a batch; HandOver has a longer time step, TwoCatchUnderarm another egg.
    assert [row["group"] for row in found["classes"].values()] == [0, 1, 0, 2]
    found = points("HandOver", num_envs=4, count=32, steps=2, repeats=2, threads=1)
    assert found["points"] == 32 and found["frames_per_s"].keys() == {"points", "state"} and 0 < found["ratio"] < 1.5


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
def test_launches_of_a_control_step() -> None:
    found = launches("CatchUnderarm", num_envs=2)
    *stages, total, iteration = found["table"]
    assert found["substeps"] == 3 and (total["stage"], iteration["stage"]) == ("all", "iteration")
    for name in ("kernels", "fills_and_copies", "allocations"):
        assert total[name] == sum(row[name] for row in stages)
    by_stage = {row["stage"]: row["kernels"] for row in stages}
    assert by_stage["collision"] % 3 == 0 and by_stage["sensor_acc"] == 1, "forces are sensed once a control step"
    assert 5 < iteration["kernels"] < 20 and iteration["allocations"] == 0


@pytest.mark.parametrize(("client", "package"), [("sb3", "stable_baselines3"), ("rsl-rl", "rsl_rl")])
def test_clients(client: str, package: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip(package, reason=f"needs the extra {client}")
    main(f"clients --client {client} --num-envs 4 --steps 8 --repeats 1 --threads 1 --json".split())
    found = json.loads(capsys.readouterr().out)
    for part in (found["rollout"], found["training"]):
        assert part["ratio"] == pytest.approx(part["through_the_adapter"] / part["own_loop"], rel=0.02)


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


def test_learners_beside_other_libraries(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rsl_rl")
    monkeypatch.setattr(learner, "PRESETS", {"laptop": TINY})
    main(["learner", "--num-envs", "16", "--threads", "1", "--json"])
    found = json.loads(capsys.readouterr().out)
    for name in ("defaults", "plain"):
        for side, rate in found[name]["samples_per_s"].items():
            # Seconds are rounded to a tenth of a millisecond.
            assert 64 / rate == pytest.approx(found[name]["seconds"][side], abs=1e-4)


@pytest.mark.filterwarnings("ignore:TF32")  # what flags() says of Intel's GPUs
def test_libraries(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(libraries, "PRESETS", {"laptop": TINY})
    main(["libraries", "--num-envs", "16", "--repeats", "2", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [row["architecture"] for row in found["table"]] == list(libraries.ARCHITECTURES)


def test_adapting_together_gives_what_a_loop_gives() -> None:
    found = adapt(num_tasks=3, rollouts=2, steps=4, repeats=1)
    assert all(found[name]["difference"] < 1e-5 for name in ("point", "hands"))


def test_multiagent_has_each_learner_with_each_partition() -> None:
    found = multiagent("CatchUnderarm", num_envs=4, repeats=1)
    rows = {row["learner"]: row for row in found["table"]}
    assert len(rows) == 9 and rows["mtppo"]["ratio"] == 1.0
    for row in rows.values():
        assert row["steps_per_cpu_s"] == pytest.approx(32 / row["cpu_s"], rel=0.05)


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


def test_a_short_soak(capsys: pytest.CaptureFixture[str]) -> None:
    main(["soak", "--suite", "MT4", "--num-envs", "8", "--threads", "1", "--steps", "400", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["env_steps"], found["num_envs"], found["what"]) == (400, 8, "random actions")
    assert found["verdict"].startswith("holds" if found["holds"] else "does not hold")


def test_growing_memory_and_falling_speed_do_not_hold() -> None:
    flat, growing, noise = np.full(60, 500.0), np.linspace(500.0, 530.0, 60), np.random.default_rng(0)
    for drift, memory, holds in ((0.0, flat, True), (0.0, growing, False), (-0.05, flat, False)):
        speeds = 5000.0 * (1 + drift * np.linspace(-0.5, 0.5, 60) + 0.01 * noise.standard_normal(60))
        table = [
            {"minute": i + 1.0, "env_steps": 1000 * (i + 1), "steps_per_s": 7.0, "steps_per_cpu_s": speed,
             "memory_mb": held, "unstable": 0, "unstable_per_million": 0.0}
            for i, (speed, held) in enumerate(zip(speeds, memory, strict=True))
        ]  # fmt: skip
        assert judge(table, "steps_per_cpu_s")["holds"] == holds
