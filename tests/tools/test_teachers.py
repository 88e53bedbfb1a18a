"""``tools.teachers``: success of a suite's teachers on own and unseen tasks, and with noisy actions."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.suite_files import load_suite
from tools import teachers


def test_noise_has_its_standard_deviation_within_the_bounds_of_actions() -> None:
    zero = ZeroAgent(gymnasium.spaces.Box(-1.0, 1.0, (64, 52), np.float32))
    obs = torch.zeros(64, 3)
    agent = teachers.Noisy(zero, 0.05)
    first, second = (agent.eval_action(obs) for _ in range(2))
    assert first.std().item() == pytest.approx(0.05, rel=0.05)
    assert not torch.equal(first, second)
    assert teachers.Noisy(zero, 9.0).eval_action(obs).abs().max() == 1.0


def test_teachers_play_own_and_unseen_tasks_and_with_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = load_suite("MT1-v2").file.read_text().replace("CatchUnderarm", "Switch").replace("= 50", "= 3")
    suite = tmp_path / "own.toml"
    suite.write_text(text)
    monkeypatch.setattr(teachers, "NOISE", 5.0)  # so much that nothing succeeds
    teachers.teachers(suite=str(suite), threads=1, out=tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["noise"] == 5.0
    assert found["classes"] == {"Switch": {"teacher": "scripts", "own": 1.0, "unseen": 1.0, "noise": 0.0}}
