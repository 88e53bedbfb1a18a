"""PPO in one file, after CleanRL's manner: nothing but torch and Gymnasium's vector interface.

python examples/ppo_one_file.py --env-id bidex-meta/CatchUnderarm-v1 --total-steps 500000
"""

import time
from dataclasses import dataclass
from itertools import pairwise

import gymnasium
import torch
import tyro
from torch import Tensor, nn

import bidex_meta  # noqa: F401  (registers the ids)


@dataclass
class Args:
    """What can be set."""

    env_id: str = "bidex-meta/CatchUnderarm-v1"
    """A task class or a multi-task suite, e.g. bidex-meta/MT4-v1."""
    total_steps: int = 500_000
    """Environment steps."""
    num_envs: int = 256
    """Rows of the world."""
    num_steps: int = 16
    """Steps of a row between two updates."""
    epochs: int = 4
    """Passes over a rollout."""
    minibatches: int = 4
    """Parts of a rollout in each pass."""
    learning_rate: float = 3e-4
    """Adam's step size."""
    gamma: float = 0.93
    """Discount per step."""
    gae_lambda: float = 0.95
    """Trace decay of the advantage."""
    clip: float = 0.2
    """How far the likelihood ratio may leave 1."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    seed: int = 0
    """Of everything."""


class RunningNormaliser(nn.Module):
    """Zero mean and unit variance by what was seen so far."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        for name, value in (("mean", torch.zeros(size)), ("variance", torch.ones(size)), ("count", torch.tensor(1e-4))):
            self.register_buffer(name, value)

    @torch.no_grad()
    def update(self, batch: Tensor) -> None:
        """Update the statistics with observations (n, d)."""
        total = self.count + len(batch)
        delta = batch.mean(0) - self.mean
        spread = self.variance * self.count + batch.var(0, correction=0) * len(batch)
        self.variance = (spread + delta**2 * self.count * len(batch) / total) / total
        self.mean, self.count = self.mean + delta * len(batch) / total, total

    def forward(self, obs: Tensor) -> Tensor:
        """Observations (..., d), normalised."""
        return ((obs - self.mean) / (self.variance + 1e-8).sqrt()).clamp(-10, 10)


class Agent(nn.Module):
    """A Gaussian actor with a standard deviation of its own, and a critic."""

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.normalise = RunningNormaliser(observations)
        self.actor, self.critic = self._network(observations, actions), self._network(observations, 1)
        nn.init.orthogonal_(self.actor[-1].weight, 0.01)
        self.log_std = nn.Parameter(torch.full((actions,), -0.22))

    @staticmethod
    def _network(inputs: int, outputs: int) -> nn.Sequential:
        sizes = (inputs, 256, 256, 128)
        hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ELU())]
        return nn.Sequential(*hidden, nn.Linear(sizes[-1], outputs))

    def value(self, obs: Tensor) -> Tensor:
        """Values (n,) of observations (n, d)."""
        return self.critic(self.normalise(obs)).squeeze(-1)

    def policy(self, obs: Tensor) -> torch.distributions.Independent:
        """Return the distribution of actions."""
        normal = torch.distributions.Normal(self.actor(self.normalise(obs)), self.log_std.exp())
        return torch.distributions.Independent(normal, 1)


def advantages(rewards: Tensor, values: Tensor, next_values: Tensor, ended: Tensor, args: Args) -> Tensor:
    """Generalised advantages (t, n). ``next_values`` are 0 after a true end, and of the last observation at a cut."""
    found, running = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + args.gamma * next_values[t] - values[t]
        running = delta + args.gamma * args.gae_lambda * (~ended[t]) * running
        found[t] = running
    return found


def main(args: Args) -> list[float]:
    """Trains; returns the episodes' returns in the order in which they ended."""
    torch.manual_seed(args.seed)
    # Rows do not end together. Shortened first episodes do not count in info["_episode"].
    envs = gymnasium.make_vec(args.env_id, num_envs=args.num_envs, seed=args.seed, stagger=True)
    device = envs.unwrapped.device
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0]).to(device)
    optimiser = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    shape = (args.num_steps, args.num_envs)
    obs_buffer = torch.zeros(*shape, *envs.single_observation_space.shape, device=device)
    action_buffer = torch.zeros(*shape, *envs.single_action_space.shape, device=device)
    log_probs, rewards, values, next_values = (torch.zeros(shape, device=device) for _ in range(4))
    ends = torch.zeros(shape, dtype=torch.bool, device=device)
    valid = torch.zeros(shape, dtype=torch.bool, device=device)
    obs, _ = envs.reset(seed=args.seed)
    agent.normalise.update(obs)
    returns: list[float] = []
    successes: list[float] = []
    started, iterations = time.perf_counter(), max(1, args.total_steps // (args.num_steps * args.num_envs))

    for iteration in range(1, iterations + 1):
        for t in range(args.num_steps):
            with torch.no_grad():
                policy = agent.policy(obs)
                action = policy.sample()
                obs_buffer[t], action_buffer[t], log_probs[t] = obs, action, policy.log_prob(action)
                values[t] = agent.value(obs)
                obs, rewards[t], terminated, truncated, info = envs.step(action)
                # final_obs is the observation after the step; if an episode ended, obs belongs to the next episode.
                next_values[t] = agent.value(info["final_obs"]) * ~terminated
            ends[t], valid[t] = terminated | truncated, ~info["unstable"]
            if "episode" in info:
                over = info["_episode"]
                returns += info["episode"]["r"][over].tolist()
                successes += info["episode"]["success"][over].float().tolist()

        gained = advantages(rewards, values, next_values, ends, args)
        keep = valid.flatten()  # the transition into broken physics is ignored
        batch = [x.flatten(0, 1)[keep] for x in (obs_buffer, action_buffer, log_probs, gained, gained + values)]
        for _ in range(args.epochs):
            for part in torch.randperm(len(batch[0]), device=device).chunk(args.minibatches):
                seen, taken, old, gain, target = (x[part] for x in batch)
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                ratio = (agent.policy(seen).log_prob(taken) - old).exp()
                clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
                loss = -torch.min(gain * ratio, gain * clipped).mean() + (agent.value(seen) - target).pow(2).mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimiser.step()
        agent.normalise.update(obs_buffer.flatten(0, 1))

        if returns and (iteration % 10 == 0 or iteration == iterations):
            steps = iteration * args.num_steps * args.num_envs
            recent, good = returns[-100:], successes[-100:]
            print(
                f"{steps} steps, {steps / (time.perf_counter() - started):.0f} a second: "
                f"return {sum(recent) / len(recent):.2f}, success {100 * sum(good) / len(good):.0f} %"
            )
    envs.close()
    return returns


if __name__ == "__main__":
    main(tyro.cli(Args))
