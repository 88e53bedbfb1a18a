import json
from dataclasses import replace

import pytest
import torch

from bidex_algos.onpolicy.mtppo import PRESETS
from tools.bench import learner as bench
from tools.bench import libraries as compared
from tools.bench.__main__ import main
from tools.bench.adapt import adapt
from tools.bench.multiagent import multiagent

TINY = replace(PRESETS["laptop"], hidden=(8, 8), rollout_steps=4, num_minibatches=2, epochs=2, autocast="off")


def test_bench_learner_prints_both_speeds_and_their_ratio(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rsl_rl")
    before = torch.get_rng_state()
    monkeypatch.setattr(bench, "PRESETS", {"laptop": TINY})
    main(["learner", "--num-envs", "16", "--threads", "1", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert (found["preset"], found["num_envs"], found["threads"]) == ("laptop", 16, 1)
    for name in ("defaults", "plain"):
        row = found[name]
        assert 0.02 < row["ratio"] < 50.0 and 0.02 < row["update_ratio"] < 50.0
        for side, rate in row["samples_per_s"].items():
            # Seconds are rounded to a tenth of a millisecond.
            assert 64 / rate == pytest.approx(row["seconds"][side], abs=1e-4)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.filterwarnings("ignore:TF32")  # what flags() says of Intel's GPUs
def test_bench_libraries_measures_every_architecture_in_turns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    enabled = []
    monkeypatch.setattr(compared, "PRESETS", {"laptop": TINY})
    iterate = bench.Ours.seconds
    monkeypatch.setattr(
        bench.Ours, "seconds", lambda side: (enabled.append(torch.backends.mkldnn.enabled), iterate(side))[1]
    )
    main(["libraries", "--num-envs", "16", "--repeats", "2", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [row["architecture"] for row in found["table"]] == list(compared.ARCHITECTURES)
    assert all(0.01 < row["ratio"] < 100.0 and row["oneDNN"] > 0.0 for row in found["table"])
    assert enabled == [False, True, True, False, False, True] * 4


def test_adapting_together_gives_what_a_loop_gives():
    found = adapt(num_tasks=3, rollouts=2, steps=4, repeats=1)
    for name in ("point", "hands"):
        assert found[name]["difference"] < 1e-5
        assert found[name]["whole"]["ratio"] > 0


def test_bench_multiagent_has_each_learner_with_each_partition() -> None:
    before = torch.get_num_threads()
    found = multiagent("CatchUnderarm", num_envs=4, repeats=1)
    assert torch.get_num_threads() == before
    rows = {row["learner"]: row for row in found["table"]}
    assert len(rows) == 9 and rows["mtppo"]["ratio"] == rows["mtppo"]["least"] == rows["mtppo"]["most"] == 1.0
    for row in rows.values():
        assert 0.0 < row["update_cpu_s"] < row["cpu_s"] < 60.0
        assert row["steps_per_cpu_s"] == pytest.approx(32 / row["cpu_s"], rel=0.05)
        assert row["ratio"] == pytest.approx(rows["mtppo"]["cpu_s"] / row["cpu_s"], rel=0.05)
