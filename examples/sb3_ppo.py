"""stable-baselines3's PPO on one task class.

pip install "bidex-meta[sb3]", then: python examples/sb3_ppo.py --task CatchUnderarm --steps 500000
"""

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO

from bidex_meta import make_task_world
from bidex_meta.clients.sb3_env import SB3VecEnv


def main(task: str = "CatchUnderarm", steps: int = 500_000, num_envs: int = 256, seed: int = 0) -> PPO:
    """Trains and prints the recent episodes' return and success.

    Args:
        task: A task class (`bidex-meta list tasks`).
        steps: Environment steps.
        num_envs: Rows of the world.
        seed: Of everything.
    """
    env = SB3VecEnv(make_task_world(task, num_envs=num_envs, seed=seed), stagger=True)  # SB3 counts only whole episodes
    rollout = 16
    learner = PPO(
        "MlpPolicy",
        env,
        n_steps=rollout,
        batch_size=num_envs * rollout // 4,
        n_epochs=4,
        gamma=0.93,
        policy_kwargs={"net_arch": [256, 256, 128], "activation_fn": torch.nn.ELU, "log_std_init": -0.22},
        seed=seed,
        device="cpu",
        verbose=1,
    )
    learner.learn(steps, log_interval=20)
    if learner.ep_info_buffer:
        mean = np.mean([episode["r"] for episode in learner.ep_info_buffer])
        print(f"{task}: return {mean:.2f}, success {100 * np.mean(learner.ep_success_buffer):.0f} % of recent episodes")
    return learner


if __name__ == "__main__":
    tyro.cli(main)
