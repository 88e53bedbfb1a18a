"""Gymnasium's own Humanoid-v5 beside the batched one."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.experiments import watching
from bidex_meta.runs import RunFolder
from bidex_meta.worlds.external import HUMANOID
from bidex_meta.worlds.humanoid import NAME, HumanoidWorld


def test_as_gymnasiums() -> None:
    """Equal starts and actions: observations, rewards and falls are equal, to single precision."""
    rows, steps = 3, 40
    world = HumanoidWorld(rows, autoreset_mode="DISABLED", threads=1)
    obs, _ = world.reset(seed=1)
    start = world.state_dict()["engine"]
    actions = 2 * torch.rand(steps, rows, 17, generator=torch.Generator().manual_seed(0)) - 1
    made = [world.step(action) for action in actions]
    lengths = made[-1][-1]["running"]["l"].tolist()
    assert made[-1][2].all() and min(lengths) > 5  # all have fallen
    for row, length in enumerate(lengths):
        env = gymnasium.make("Humanoid-v5").unwrapped
        env.reset(seed=0)
        env.set_state(start["qpos"][row].numpy(), start["qvel"][row].numpy())
        assert np.array_equal(env._get_obs().astype(np.float32), obs[row].numpy())
        for step, (after, reward, terminated, _, _) in enumerate(made[:length], 1):
            theirs, gained, fell, _, _ = env.step(actions[step - 1, row].numpy() * np.float32(0.4))
            assert np.array_equal(theirs.astype(np.float32), after[row].numpy())
            assert np.isclose(gained, reward[row].item(), rtol=1e-6)
            assert fell == terminated[row].item() == (step == length)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_run_on_it(algo: str, tmp_path: Path) -> None:
    """In any case of the name, with the appendix's numbers for it; evaluated without references."""
    flags = ["--task", "gymnasium/humanoid-v5", "--algo", algo, "--num-envs", "4", "--steps", "140", "--threads", "1"]
    flags += ["--device", "cpu", "--logger", "none", "--learner.hidden", "8", "--episodes", "2"]
    assert main(["run", *flags, "--run-dir", str(tmp_path / "run")]) == 0
    folder = RunFolder.open(tmp_path / "run")
    assert folder.config().task == HUMANOID and folder.config().learner["gamma"] == 0.99
    result = folder.evaluation().results["Humanoid-v5"]
    assert result.score is None and result.success == 0.0


def test_an_evaluation_while_training_is_of_ten_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[np.ndarray] = []
    monkeypatch.setattr(watching, "_metrics", lambda result: seen.append(result.classes[NAME].returns) or {})
    flags = ["--task", HUMANOID, "--algo", "ppo", "--num-envs", "4", "--steps", "8", "--learner.rollout-steps", "2"]
    flags += ["--threads", "1", "--device", "cpu", "--logger", "none", "--learner.hidden", "8", "--no-evaluate"]
    assert main(["run", *flags, "--evaluate-every", "1", "--run-dir", str(tmp_path / "run")]) == 0
    assert len(seen) == 1 and len(set(seen[0].tolist())) == 10, "ten starts, not one ten times"
