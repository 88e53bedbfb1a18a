"""A learner from outside the repository: found, trained, resumed and evaluated by its ``package.module:Class``."""

import json
from pathlib import Path

import pytest

from bidex_meta.cli import main

MODULE = '''
"""Random search: keeps the constant action whose last rollout paid best."""

from dataclasses import asdict, dataclass

import torch


@dataclass(frozen=True)
class Config:
    rollout_steps: int = 4
    """Steps between two changes."""


PRESETS = {"plain": Config(), "long": Config(8)}


class Constant:
    def __init__(self, action):
        self.action = action

    def eval_action(self, obs):
        return self.action.expand(len(obs), -1)

    def reset(self, env_mask):
        pass


class RandomSearch:
    def __init__(self, world, config, seed):
        self.world, self.config = world, config
        self.generator = torch.Generator().manual_seed(seed)
        self.best, self.paid, self.env_steps = torch.zeros(world.single_action_space.shape[0]), -float("inf"), 0
        world.reset(seed=seed)

    def iterate(self):
        tried = (self.best + 0.3 * torch.randn(self.best.shape, generator=self.generator)).clamp(-1, 1)
        steps = [self.world.step(tried.expand(self.world.num_envs, -1)) for _ in range(self.config.rollout_steps)]
        paid = float(sum(reward.mean() for _, reward, *_ in steps))
        if paid > self.paid:
            self.best, self.paid = tried, paid
        self.env_steps += self.world.num_envs * len(steps)
        return {"Train/paid": paid}

    def policy_state_dict(self):
        return {"config": asdict(self.config), "action": self.best}

    @classmethod
    def load_policy(cls, state, device="cpu"):
        return Constant(state["action"].to(device))

    def state_dict(self):
        state = {"policy": self.policy_state_dict(), "paid": self.paid, "env_steps": self.env_steps}
        return {**state, "generator": self.generator.get_state()}

    def load_state_dict(self, state):
        self.best, self.paid, self.env_steps = state["policy"]["action"], state["paid"], state["env_steps"]
        self.generator.set_state(state["generator"])
'''
ALGO = "scratch_package.search:RandomSearch"
RUN = ["run", "--task", "HandOver", "--num-envs", "4", "--threads", "1", "--algo", ALGO]


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    package = tmp_path / "scratch_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "search.py").write_text(MODULE)
    (package / "empty.py").write_text("class NoLearner: ...\nPRESETS = {}\n")
    (package / "half.py").write_text(MODULE.replace("def iterate", "def other"))
    init = "def __init__(self, world, config, seed):"
    (package / "raises.py").write_text(MODULE.replace(init, f"{init}\n        raise RuntimeError('no luck')"))
    (package / "arguments.py").write_text(MODULE.replace(init, "def __init__(self, world):"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and taken away again, unlike what the command adds
    return tmp_path


def test_a_learner_of_the_working_folder_trains_resumes_and_is_evaluated(
    scratch: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, "--steps", "64", "--learner.rollout-steps", "2", "--no-evaluate"]) == 0
    (folder,) = (scratch / "runs" / "HandOver" / "RandomSearch").iterdir()
    config = json.loads((folder / "config.json").read_text())
    assert (config["algo"], config["preset"], config["learner"]) == (ALGO, "plain", {"rollout_steps": 2})
    assert main(["run", "--resume", str(folder), "--steps", "128", "--no-evaluate"]) == 0
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["step"] == 128 and "Train/paid" in rows[-1]
    capsys.readouterr()
    assert main(["evaluate", str(folder), "--episodes", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 128


@pytest.mark.parametrize(
    "algo, told",
    [
        ("scratch_package.nowhere:Learner", "no scratch_package.nowhere"),
        ("scratch_package.search:Another", "a class Another"),
        ("scratch_package.empty:NoLearner", "expected presets"),
        ("scratch_package.half:RandomSearch", "to have iterate"),
        ("scratch_package.raises:RandomSearch", "RuntimeError: no luck ("),
        ("scratch_package.arguments:RandomSearch", "takes 2 positional arguments but 4 were given"),
    ],
)
def test_what_is_no_learner_is_told_in_one_line(
    scratch: Path, capsys: pytest.CaptureFixture[str], algo: str, told: str
) -> None:
    assert main([*RUN[:-1], algo, "--steps", "64"]) == 2
    error = capsys.readouterr().err
    assert told in error.splitlines()[-1] and error.count("\n") == error.count("bidex-meta: ") + 2 * (
        "environments on" in error
    )
    assert not (scratch / "runs").exists()
