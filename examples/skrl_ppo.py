"""skrl's PPO on one task class.

pip install "bidex-meta[skrl]", then: python examples/skrl_ppo.py --task CatchUnderarm --steps 500000
"""

import tyro
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

from bidex_meta import make_task_world
from bidex_meta.clients.skrl_env import SkrlEnv


def main(
    task: str = "CatchUnderarm",
    steps: int = 500_000,
    num_envs: int = 256,
    seed: int = 0,
    log_dir: str = "runs/skrl",
    log: bool = True,
) -> PPO:
    """Trains; `tensorboard --logdir runs/skrl` shows return, length and success of episodes.

    Args:
        task: A task class (`bidex-meta list tasks`).
        steps: Environment steps.
        num_envs: Rows of the world.
        seed: Of everything.
        log_dir: Where TensorBoard files go.
        log: Whether any are written.
    """
    set_seed(seed)
    env = SkrlEnv(make_task_world(task, num_envs=num_envs, seed=seed, autoreset_mode="NEXT_STEP"))
    rollout = 16
    spaces = {
        "observation_space": env.observation_space,
        "state_space": env.state_space,
        "action_space": env.action_space,
        "device": env.device,
    }
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [256, 256, 128], "activations": "elu"}]
    models = {
        "policy": gaussian_model(**spaces, initial_log_std=-0.22, network=network, output="ACTIONS"),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }
    learning = PPO_CFG(
        rollouts=rollout,
        learning_epochs=4,
        mini_batches=4,
        discount_factor=0.93,
        learning_rate=3e-4,
        time_limit_bootstrap=True,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": env.observation_space, "device": env.device},
        experiment={"directory": log_dir, "write_interval": 100 if log else 0, "checkpoint_interval": 0},
    )
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=rollout, num_envs=num_envs, device=env.device),
        cfg=learning,
        observation_space=env.observation_space,
        state_space=env.state_space,
        action_space=env.action_space,
        device=env.device,
    )
    timesteps = max(rollout, steps // num_envs)
    settings = {"timesteps": timesteps, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=settings).train()
    env.close()
    return agent


if __name__ == "__main__":
    tyro.cli(main)
