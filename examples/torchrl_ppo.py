"""PPO from TorchRL's parts on one task class.

pip install "bidex-meta[torchrl]", then: python examples/torchrl_ppo.py --task CatchUnderarm --steps 500000
"""

import torch
import tyro
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from bidex_meta import make_task_world
from bidex_meta.clients.torchrl_env import TorchRLEnv


def network(inputs: int, outputs: int) -> MLP:
    """Three hidden layers, as the other examples have them."""
    return MLP(in_features=inputs, out_features=outputs, num_cells=[256, 256, 128], activation_class=nn.ELU)


def main(task: str = "CatchUnderarm", steps: int = 500_000, num_envs: int = 256, seed: int = 0) -> list[float]:
    """Trains, and prints the return and success of the episodes that ended in each tenth iteration.

    Args:
        task: A task class (`bidex-meta list tasks`).
        steps: Environment steps.
        num_envs: Rows of the world.
        seed: Of everything.

    Returns:
        Mean reward of a step in each iteration.
    """
    torch.manual_seed(seed)
    env, rollout = TorchRLEnv(make_task_world(task, num_envs=num_envs, seed=seed)), 16
    inputs, outputs = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    extractor = nn.Sequential(network(inputs, 2 * outputs), NormalParamExtractor("biased_softplus_0.8"))
    actor = ProbabilisticActor(
        TensorDictModule(extractor, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    ).to(env.device)
    critic = ValueOperator(network(inputs, 1), in_keys=["observation"]).to(env.device)
    advantage = GAE(gamma=0.93, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False, normalize_advantage=False)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
    frames = rollout * num_envs
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=max(1, steps // frames) * frames,
        auto_register_policy_transforms=False,
    )
    rewards = []
    for iteration, data in enumerate(collector):
        for _ in range(4):
            with torch.no_grad():
                advantage(data)
            flat = data.reshape(-1)
            for part in flat[torch.randperm(len(flat), device=flat.device)].split(len(flat) // 4):
                losses = loss(part)
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
        rewards.append(float(data["next", "reward"].mean()))
        ended = data["next", "episode"][data["next", "done"].squeeze(-1)]
        if iteration % 10 == 0 and len(ended):
            returns, success = float(ended["r"].mean()), 100 * float(ended["success"].float().mean())
            print(f"{(iteration + 1) * frames} steps: return {returns:.2f}, success {success:.0f} %")
    collector.shutdown()
    return rewards


if __name__ == "__main__":
    tyro.cli(main)
