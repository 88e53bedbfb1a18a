"""The examples, as written, for a few iterations; the notebooks with smaller settings."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import nbformat
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from nbclient import NotebookClient

from bidex_meta import Benchmark
from bidex_meta.agents import Timestep
from bidex_meta.clients.trial_env import TrialWorld
from bidex_meta.errors import BidexError

EXAMPLES = Path(__file__).parents[2] / "examples"
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "sb3_ppo": ("stable_baselines3", {"steps": 512, "num_envs": 16}),
    "sb3_recurrent_ppo": (
        "sb3_contrib", {"suite": "ML1-wide", "steps": 128, "num_envs": 8, "rollout": 16, "rollouts": 1}
    ),
    "rsl_rl_ppo": ("rsl_rl", {"steps": 512, "num_envs": 16}),
    "skrl_ppo": ("skrl", {"steps": 512, "num_envs": 16, "log": False}),
    "torchrl_ppo": ("torchrl", {"steps": 512, "num_envs": 16}),
    "optuna_search": ("optuna", {"suite": "MT1", "steps": 512, "trials": 1}),
}  # fmt: skip
NOTEBOOKS = {
    "quickstart": {
        "STEPS = 400_000": "STEPS = 2100",
        "num_envs=1024": 'num_envs=8, learner={"hidden": [8], "epochs": 1, "num_minibatches": 1}',
        "--steps 240": "--steps 4",
    },
    "meta_rl": {"TASKS = 20": "TASKS = 2", "num_envs=50": "num_envs=1"},
}
"""Per notebook: its settings and the smaller ones of the test."""
MOST_STORED = 400_000  # bytes of a notebook with its outputs


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_run_here() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*RUNS, "ppo_one_file"}
    assert {path.stem for path in EXAMPLES.glob("*.ipynb")} == NOTEBOOKS.keys()


@pytest.mark.parametrize("name", RUNS)
def test_example(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package, flags = RUNS[name]
    monkeypatch.chdir(tmp_path)
    pytest.importorskip(package, reason=f"needs the extra of {package}")
    assert example(name).main(**flags) is not None


def test_a_search_that_goes_on_tries_other_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("optuna")
    module = example("optuna_search")
    monkeypatch.setattr(module, "train", lambda config, run_dir: run_dir)
    monkeypatch.setattr(module, "evaluate", lambda run, save: SimpleNamespace(success=0.5))
    for _ in range(2):
        study = module.main(trials=2, out=tmp_path)
    assert len({trial.params["learning_rate"] for trial in study.trials}) == 4
    assert len(module.main(steps=1000, trials=1, out=tmp_path).trials) == 1, "another study, in a folder of its own"


def test_rsl_rl_example_logs_a_suite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rsl_rl")
    example("rsl_rl_ppo").main(suite="MT4", steps=1024, num_envs=16, log_dir=str(tmp_path))
    shown = capsys.readouterr().out
    assert "Metrics/success_rate" in shown and "Episode_Termination/time_out" in shown


def test_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    """Its returns are those that the world tells."""
    module = example("ppo_one_file")
    returns = module.main(module.Args(total_steps=2048, num_envs=16, env_id="bidex-meta/MT4-v1"))
    assert len(returns) > 5 and f"return {sum(returns[-100:]) / len(returns[-100:]):.2f}" in capsys.readouterr().out


class Watching:
    """Stands for a policy of sb3-contrib: counts its steps in its memory, and acts by what it sees."""

    action_space = Box(-1.0, 1.0, (52,), np.float32)

    def predict(self, seen: np.ndarray, memory: Any, begins: np.ndarray, deterministic: bool) -> tuple[np.ndarray, Any]:
        self.seen = seen
        if memory is None:
            memory = (np.zeros((1, len(seen), 1)),)
        steps = memory[0] * ~begins[:, None] + 1
        return np.clip(seen[:, :52], -1.0, 1.0), (steps,)


def test_a_recurrent_policy_sees_in_the_meta_test_what_it_saw_in_training() -> None:
    pytest.importorskip("sb3_contrib")
    policy = Watching()
    agent = example("sb3_recurrent_ppo").RecurrentAgent(policy)
    made = Benchmark("ML1-CatchUnderarm-v2").make_world("train", 3, "cpu", threads=1, episodes_per_task=2)
    world = TrialWorld(made)
    obs, _ = world.reset(seed=0)
    agent.reset(torch.ones(3, dtype=torch.bool))
    waits = torch.tensor([True, True, False])
    steps = 0
    ended = torch.zeros(3, dtype=torch.bool)
    while not ended[2]:
        action = agent.act(obs[:, : made.observation_size])
        assert np.array_equal(policy.seen[:2], obs[:2].numpy())
        new, reward, *_ = world.step(action)
        ended = new[:, -1] > 0
        agent.observe(Timestep(obs, action, reward, torch.zeros(3, dtype=torch.bool), ended, {}, new, waits))
        obs = new
        steps += 1
    assert agent.memory[0].flatten().tolist() == [steps, steps, 0.0], "a waiting environment keeps an empty memory"


def shown(cell: nbformat.NotebookNode) -> list[list[str]]:
    """The kinds of a cell's pictures and tables; how much it prints depends on the machine."""
    return [sorted(output.data) for output in cell.outputs if output.output_type != "stream"]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = EXAMPLES / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert path.stat().st_size < MOST_STORED
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "stored outputs are of one run"
    for setting, smaller in NOTEBOOKS[name].items():
        (cell,) = (cell for cell in code if setting in cell.source)
        cell.source = cell.source.replace(setting, smaller)
    stored = [shown(cell) for cell in code]
    packages = (str(EXAMPLES.parent), str(EXAMPLES.parent / "algos"), os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("PATH", os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # tests share the cores
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, packages)))
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert [shown(cell) for cell in code] == stored


SUITE = """
name = "Two"
version = 2
kind = "multi-task"
description = "Observations of two sizes"
observation = "plain"
task_id = "class"
reward = "v2"
variation = "wide"
success = "at-end"
starts = "jittered"
base = "moving"
tasks_per_class = 2
classes = [{ name = "TwoCatchUnderarm" }, { name = "HandOver" }]
"""


def test_envhub_offers_what_lerobot_calls(tmp_path: Path) -> None:
    """As `rollout` and `eval_policy` of LeRobot 0.6.1 use an environment."""
    (tmp_path / "two.toml").write_text(SUITE)
    module = example("envhub/env")
    envs = module.make_env(n_envs=2, use_async_envs=True, cfg=SimpleNamespace(task=str(tmp_path / "two.toml")))
    assert list(envs) == ["Two"] and list(envs["Two"]) == [0, 1]
    other, env = envs["Two"].values()
    assert env.single_observation_space == other.single_observation_space
    assert env.num_envs == 2 and env.unwrapped.metadata["render_fps"] == 60
    obs, _ = env.reset(seed=[5, 6], options={"lerobot_new_rollout": True})
    whole, _ = env.env.reset(seed=5)
    assert env.observation_space.contains(obs)
    assert obs["agent_pos"].shape == (2, 398) and np.array_equal(obs["agent_pos"], whole[:, :398])
    assert np.array_equal(obs["environment_state"][:, : whole.shape[1] - 398], whole[:, 398:])
    assert env.get_attr("task") == ("HandOver-v2",) * 2
    assert all("palm to the left one" in text for text in env.call("task_description"))
    with pytest.raises(AttributeError):
        env.get_attr("_max_episode_length")
    ended = np.zeros(2, dtype=bool)
    successes = []
    for _ in range(env.call("_max_episode_steps")[0]):
        obs, reward, terminated, truncated, info = env.step(np.zeros((2, 52), dtype=np.float32))
        ended |= terminated | truncated
        assert env.observation_space.contains(obs) and reward.shape == (2,)
        if "final_info" in info:
            successes += info["final_info"]["is_success"].tolist()
            assert info["final_info"]["is_success"].tolist() == info["final_info"]["episode"]["success"].tolist()
        if ended.all():
            break
    assert ended.all() and set(successes) <= {True, False}
    for each in (env, other):
        each.close()


def test_envhub_plays_the_tasks_of_the_suite() -> None:
    benchmark = Benchmark("MT1-Switch-choice2")
    (env,) = example("envhub/env").make_env(n_envs=2, cfg=SimpleNamespace(task=benchmark.name))[benchmark.name].values()
    (pool,) = env.world.pools
    assert np.array_equal(pool, np.stack([task.variation for task in benchmark.train_tasks]))


def test_envhub_refuses_a_suite_that_hides_its_goals() -> None:
    with pytest.raises(BidexError, match=r"shows its goals.*got ML4-v2"):
        example("envhub/env").make_env(cfg=SimpleNamespace(task="ML4-v2"))
