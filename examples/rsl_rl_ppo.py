"""rsl-rl's PPO on one task class or suite.

pip install "bidex-meta[rsl-rl]", then: python examples/rsl_rl_ppo.py --task CatchUnderarm --steps 500000
"""

import torch
import tyro
from rsl_rl.runners import OnPolicyRunner

from bidex_meta import Benchmark, make_task_world
from bidex_meta.clients.rsl_rl_env import RslRlVecEnv

NETWORK = {"class_name": "MLPModel", "hidden_dims": [256, 256, 128], "activation": "elu", "obs_normalization": True}


def config(rollout: int, seed: int) -> dict:
    """Return the configuration of rsl-rl's runner; `obs_groups` maps its networks to the groups of the environment."""
    return {
        "seed": seed,
        "num_steps_per_env": rollout,
        "save_interval": 1000,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "actor": NETWORK | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.8}},
        "critic": dict(NETWORK),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "gamma": 0.93,
            "learning_rate": 3e-4,
            "entropy_coef": 0.0,
        },
    }


def main(
    task: str = "CatchUnderarm",
    suite: str = "",
    steps: int = 500_000,
    num_envs: int = 256,
    seed: int = 0,
    log_dir: str | None = None,
) -> OnPolicyRunner:
    """Trains; with a log folder it prints and keeps what rsl-rl logs.

    Args:
        task: A task class (`bidex-meta list tasks`).
        suite: A multi-task suite in its place, e.g. MT4.
        steps: Environment steps.
        num_envs: Rows of the world.
        seed: Of everything.
        log_dir: Where TensorBoard files and checkpoints go.
    """
    torch.manual_seed(seed)
    world = (
        Benchmark(suite, seed=seed).make_world(num_envs=num_envs)
        if suite
        else make_task_world(task, num_envs=num_envs, seed=seed)
    )
    rollout = 16
    env = RslRlVecEnv(world, cfg={"world": suite or task})
    runner = OnPolicyRunner(env, config(rollout, seed), log_dir=log_dir, device=str(world.device))
    runner.learn(max(1, steps // (rollout * num_envs)))
    return runner


if __name__ == "__main__":
    tyro.cli(main)
