"""``bidex-meta bench world``: both speeds, their ratio, and that both sides do the same physics."""

import json

import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.experiments.world_speed import paired_steps
from tests.world.play import suite_world

FEW = ["--num-envs", "8", "--steps", "2", "--repeats", "3", "--threads", "1"]


def test_bench_world_prints_both_speeds_and_their_ratio(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "world", "--suite", "MT1", *FEW, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["suite", "num_envs", "threads", "env_steps_per_s", "engine_steps_per_s", "ratio", "groups"]
    assert (found["suite"], found["num_envs"], found["threads"], found["groups"]) == ("MT1", 8, 1, [8])
    for name in ("env_steps_per_s", "engine_steps_per_s"):
        assert 10 < found[name] < 1e6
    assert 0.05 < found["ratio"] < 20.0
    assert main(["bench", "world", *FEW]) == 0
    shown = capsys.readouterr().out
    assert "ratio" in shown and "MT4" in shown


def test_the_bare_engines_do_the_physics_of_the_world() -> None:
    full, bare = suite_world("MT4", 12), suite_world("MT4", 12)
    full.reset(seed=0)
    bare.reset(seed=0)
    number = full.episodes.number
    times = paired_steps(full, bare, 60, torch.Generator().manual_seed(0))
    assert (full.episodes.number > number).any()  # resets are followed
    assert min(times) > 0.0
    for a, b in zip(full.parts, bare.parts, strict=True):
        mine, its = a.group.engine.state_dict(), b.group.engine.state_dict()
        for name in ("qpos", "qvel", "ctrl", "xfrc_applied"):
            begun = (full._action == 0).all(dim=1)[a.group.env_ids]  # a row just begun has not been stepped by either
            assert torch.equal(mine[name], its[name]) or begun.any(), name
            assert torch.equal(mine[name][~begun], its[name][~begun]), name
