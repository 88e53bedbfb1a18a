"""`bidex-meta run` of several agents, and what follows a run: its checkpoint knows its partition."""

import json
from pathlib import Path

import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.policies import load_policy
from bidex_meta.runs import RunFolder
from bidex_meta.world.agent_views import agent_views
from tests.world.play import suite_world

SMALL = ["--num-envs", "4", "--steps", "40", "--episodes", "1", "--device", "cpu", "--threads", "1", "--no-evaluate"]
FILE = """
[agents]
palms = ["left/palm", "right/palm"]
right = ["right/first", "right/middle", "right/ring", "right/little", "right/thumb"]
left = ["left/first", "left/middle", "left/ring", "left/little", "left/thumb"]
"""


def test_a_run_a_resume_and_its_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, run = tmp_path / "team.toml", tmp_path / "run"
    file.write_text(FILE)
    words = ["run", "--suite", "MT4", "--algo", "mappo", "--agents", str(file), "--learner.hidden", "8"]
    assert main([*words, "--run-dir", str(run), *SMALL]) == 0
    config = json.loads((run / "config.json").read_text())
    assert config["learner"]["agents"].startswith("palms=left/palm+right/palm;right=right/first+")
    file.unlink()
    assert main(["run", "--resume", str(run), "--steps", "80"]) == 0
    assert main(["evaluate", str(run), "--episodes", "1"]) == 0
    policy, steps = load_policy(RunFolder.open(run), "cpu")
    assert steps >= 80
    world = suite_world("MT4", 4)
    obs, _ = world.reset(seed=0)
    palms, right, left = agent_views(world.observation_groups, 52, config["learner"]["agents"])
    other = obs.clone()
    other[:, sorted(set(left.columns) - set(right.columns))] += 1.0
    before, after = policy.eval_action(obs), policy.eval_action(other)
    assert torch.equal(before[:, list(right.actions)], after[:, list(right.actions)])
    for view in (palms, left):
        assert not torch.equal(before[:, list(view.actions)], after[:, list(view.actions)])
    capsys.readouterr()
    assert main(["run", "--resume", str(run), "--agents", "hands"]) == 2
    assert "a resumed run keeps its config" in capsys.readouterr().err
    assert main([*words[:5], "--agents", "right=right/palm", "--run-dir", str(tmp_path / "bad"), *SMALL]) == 2
    assert "belongs to no agent" in capsys.readouterr().err and not (tmp_path / "bad").exists()


def test_presets_are_the_tables() -> None:
    happo, mappo = (learner_kind(algo).presets["paper"] for algo in ("happo", "mappo"))
    for config in (happo, mappo):
        assert (config.hidden, config.rollout_steps, config.epochs) == ((1024, 1024, 512), 8, 5)
        assert (config.num_minibatches, config.clip, config.gamma, config.lam) == (1, 0.2, 0.96, 0.95)
        assert config.popart
        assert (config.huber_delta, config.entropy_weight, config.value_clip) == (10.0, 0.0, 0.2)
    assert (happo.learning_rate, happo.max_grad_norm, happo.init_std) == (1e-4, 1.0, 1.0)
    assert (mappo.learning_rate, mappo.max_grad_norm, mappo.adam_eps) == (5e-4, 10.0, 5e-4)
    lift = learner_kind("happo", "LiftUnderarm").presets["paper"]
    assert (lift.rollout_steps, lift.epochs, lift.learning_rate) == (20, 10, 1e-4)
    assert learner_kind("mappo", "LiftUnderarm").presets["paper"].rollout_steps == 20
