"""The examples, as written, for a few iterations."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "sb3_ppo": ("stable_baselines3", {"steps": 512, "num_envs": 16}),
    "rsl_rl_ppo": ("rsl_rl", {"steps": 512, "num_envs": 16}),
    "skrl_ppo": ("skrl", {"steps": 512, "num_envs": 16, "log": False}),
    "torchrl_ppo": ("torchrl", {"steps": 512, "num_envs": 16}),
    "optuna_search": ("optuna", {"suite": "MT1", "steps": 512, "trials": 1}),
}


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_run_here() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*RUNS, "ppo_one_file"}


@pytest.mark.parametrize("name", RUNS)
def test_example(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package, flags = RUNS[name]
    monkeypatch.chdir(tmp_path)
    pytest.importorskip(package, reason=f"needs the extra of {package}")
    assert example(name).main(**flags) is not None


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
