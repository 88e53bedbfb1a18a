"""RL²: learning to learn by a memory (Duan et al. 2016, Wang et al. 2016), trained by PPO; see docs/learners/rl2.md.

An iteration plays one trial, a few episodes of one task with one memory, in every environment, makes ``epochs`` passes
over it in shuffled mini-batches of chunks, and starts the next without memory. The first only measures statistics.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.learner import Learner, as_numbers
from bidex_algos.meta.rl2_agent import RL2Agent
from bidex_algos.meta.trials import Batch, TrialConfig, Trials, make_batch, of_task, play
from bidex_algos.nets.architecture import network_bytes
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import RecurrentNet, RecurrentPolicy
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, PPOConfig, mini_batches, policy_loss
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, own_seed, rank, sum_gradients, world_size
from bidex_meta.train.learner import AutoresetMode, Parts, State
from bidex_meta.utils.validation import Finite, Positive, check_rising
from bidex_meta.world.contract import PooledWorld


@dataclass(frozen=True)
class RL2Config(PPOConfig, TrialConfig):
    """Everything that can be set about RL²; the defaults are the preset ``laptop``."""

    learning_rate_range: tuple[Positive, Positive] = (1e-5, 3e-3)
    """Bounds of the adaptive step size."""
    entropy_weight: Finite = 0.0
    """Factor of the entropy bonus."""
    max_grad_norm: Positive = 1.0
    """Gradients longer than this are shortened to it, actor and critic apart."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics."""
    value_horizon: Positive = 100.0
    """Iterations after which returns fade from the statistics that the critic's targets are normalised by."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "std_range")

    @property
    def trial_steps(self) -> int:
        """Most steps of a trial."""
        return self.episodes_per_trial * self.max_adapt_steps

    def bytes_held(self, num_envs: int, width: int) -> int:
        """As in the base."""
        memory = 4 * 4 * 2 * 3 * self.memory * (self.memory + self.hidden[-1])
        return 4 * num_envs * width * self.trial_steps + network_bytes(self.hidden, width, 2) + memory


PRESETS: dict[str, RL2Config] = {
    # The appendix has no table for RL². Layers, epochs, mini-batches, clip, gradient norm, step size, discount, trace,
    # starting noise and KL are Table 48's, ProMP's: its outer loop is PPO too. Its 8 steps a rollout have no
    # counterpart, since a trial is made of whole episodes. Memory, ten episodes a trial and 250 steps of
    # backpropagation are those of RL² in Meta-World's baselines (metaworld-algorithms).
    "paper": RL2Config(
        hidden=(2048, 1024, 512), memory=256, value_heads=False, init_std=1.0, episodes_per_trial=10, gamma=0.9,
        lam=0.95, chunk=250, num_minibatches=1, epochs=3, clip=0.2, learning_rate=3e-4, desired_kl=0.016,
        critic_learning_rate=None, entropy_weight=0.0, max_grad_norm=1.0, normalise_observations=False,
    ),
    # Discount and KL are MT-PPO's. With 0.97, so that what an episode finds out is paid in the next, and a KL of 0.02
    # the egg of ML1-wide was carried and not thrown after 5 M steps (docs/results/ml1.md).
    "laptop": RL2Config(),
}  # fmt: skip


class RL2(Learner):
    """RL² (Duan et al. 2016, arXiv 1611.02779): a policy with a memory that adapts to a task while it plays it."""

    name, remedy = "rl2", "lower learning_rate"
    config_type, presets = RL2Config, PRESETS
    world: PooledWorld
    config: RL2Config
    policy: RecurrentPolicy
    per_process = ("generator", "episodes")
    adapts = independent_adaptation = True

    def __init__(self, world: PooledWorld, config: RL2Config, seed: int):
        super().__init__(world, config, seed)
        if world.num_envs < config.num_minibatches:
            raise BidexError(
                f"rl2: {config.num_minibatches} mini-batches need as many environments, got {world.num_envs}. Raise "
                "num_envs or lower num_minibatches."
            )
        self.agent = RL2Agent(self.policy, own_seed(seed))
        heads = world.num_tasks if config.value_heads else 1
        self.critic = RecurrentNet(
            self.policy.inputs, config.hidden, config.memory, heads, 0.01, self.initial, config.activation,
            config.trial_steps
        ).to(self.device)  # fmt: skip
        self.adams = AdaptiveAdams(self.policy.parameters(), self.critic.parameters(), config, self.device)

        limits = world.max_episode_steps.clamp_max(config.max_adapt_steps)
        d, a = self.shape.observations, self.shape.actions
        self.trials, self.trials_played = Trials(config.episodes_per_trial, limits, d, a, config.chunk), 0
        steps = config.episodes_per_trial * float(limits.float().mean()) * world.num_envs * world_size()
        horizon = config.value_horizon * steps / world.num_tasks
        self.return_stats = RunningStats((world.num_tasks,), max_count=horizon).to(self.device)
        self.episodes, self.firsts, self.lasts = (EpisodeStatistics(world.task_id, world.task_names) for _ in range(3))
        # The tasks that the world was made with: of them each trial takes as many as there are rows.
        self.pools = _larger_pools(world)

    @classmethod
    def autoreset_mode(cls, config: RL2Config) -> AutoresetMode:
        """Episodes of a trial begin together."""
        return "DISABLED"

    def _iterate(self) -> dict[str, float]:
        counts = [[self.episodes] for _ in range(self.config.episodes_per_trial)]
        counts[0].append(self.firsts)
        counts[-1].append(self.lasts)
        with self._collecting():
            obs = self._begin()
            play(self.world, self.policy, self.trials, obs, self.config.blind_share, self.generator, counts)

        filled = self.trials.filled()
        valid = self.trials.valid & filled
        seen = self.trials.obs[filled], self.trials.rewards[valid]
        if self.trials_played == 0:
            # The first trial only measures. Statistics of the starts alone, where nothing moves, made the policy see
            # so much noise that it would have to unlearn most of what it learned from it.
            self.policy.update_statistics(*seen)
            losses, explained = {}, self._prepare()[1]
        else:
            batch, explained = self._prepare()
            losses = self._update(batch)
            self.policy.update_statistics(*seen)
        self.env_steps += int(all_sum(filled.sum()))
        self.trials_played += 1
        return self._metrics(losses, explained, filled & ~valid)

    def _begin(self) -> Tensor:
        if self.pools:
            trial = self.trials_played * world_size() + rank()
            # By turns: all tasks of a class come equally often.
            turned = {name: pool.roll(-trial * rows, 0).numpy() for name, (pool, rows) in self.pools.items()}
            self.world.set_tasks(turned)
        return self._first_observations() if self.trials_played == 0 else self.world.reset()[0]

    def _prepare(self) -> tuple[Batch, Tensor]:
        return make_batch(self.trials, self.policy, self.critic, self.return_stats, self.world.task_id, self.config)

    def _update(self, b: Batch) -> dict[str, Tensor]:
        cfg, policy = self.config, self.policy
        old_log_std = policy.log_std.detach().clone()
        low, high = (math.log(std) for std in cfg.std_range)
        measured: list[Tensor] = []
        # The same number of parts in every process, whatever the number of its chunks.
        batches = mini_batches(b.chunk_weights(), cfg.epochs, cfg.num_minibatches, self.generator, Tensor.tensor_split)
        for first, index, count in batches:
            measured.append(self._gradients(b, index, count, old_log_std))
            self.adams.descend(None if first else measured[-1][2], cfg.max_grad_norm)
            with torch.no_grad():
                policy.log_std.clamp_(low, high)
        return {**dict(zip(NAMES, torch.stack(measured).mean(0), strict=True)), "Policy/lr": self.adams.rate}

    def _gradients(self, b: Batch, chosen: Tensor, count: Tensor, old_log_std: Tensor) -> Tensor:
        policy, chunk, row = self.policy, b.chunk[chosen], b.row[chosen]
        x = policy.see(b.take(b.obs, chosen), *(b.take(p, chosen) for p in b.previous))
        means, _ = policy.actor(x, b.actor_states[chunk, row])
        out, _ = self.critic(x, b.critic_states[chunk, row])
        weights = b.take(b.weights, chosen) / count
        values, targets = of_task(out, self.world.task_id[row]), b.take(b.targets, chosen)
        value = (weights * (values - targets).square()).sum()
        loss = policy_loss(
            b.take(b.actions, chosen), means, policy.log_std, b.take(b.old_means, chosen), old_log_std,
            b.take(b.old_log_probs, chosen), b.take(b.advantages, chosen), weights=weights, clip=self.config.clip
        )  # fmt: skip
        self.adams.zero_grad()
        (loss.surrogate + value - self.config.entropy_weight * loss.entropy).backward()
        return sum_gradients([*policy.parameters(), *self.critic.parameters()], torch.stack(loss.numbers(value)))

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor, broken: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum(broken.sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        metrics = self.episodes.metrics() | as_numbers(tensors)
        for which, statistics in (("first", self.firsts), ("last", self.lasts)):
            found = statistics.metrics()
            if found:
                metrics[f"Train/return_{which}_episode"] = found["Train/mean_return"]
                metrics[f"Train/success_{which}_episode"] = found["Train/success_rate"]
        return metrics

    @classmethod
    def _make_policy(
        cls, config: RL2Config, shape: Shape, init: torch.Generator, device: torch.device
    ) -> RecurrentPolicy:
        return RecurrentPolicy(
            cls._inputs(config, shape), shape.actions, config.hidden, config.memory, config.init_std,
            config.reward_unit, config.normalise_observations, init, config.activation, config.trial_steps
        ).to(device)  # fmt: skip

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> RL2Agent:
        """The agent of a checkpoint, for a world of any number of environments; see ``Learner.load_policy``."""
        return RL2Agent(super().load_policy(state, device))

    def _parts(self) -> Parts:
        return {
            "critic": self.critic,
            "return_stats": self.return_stats,
            **self.adams.parts(),
            "generator": self.generator,
            "episodes": [self.episodes, self.firsts, self.lasts],
        }

    def _place(self) -> State:
        return {"trials_played": self.trials_played, **super()._place()}

    def _go_on_from(self, state: State) -> None:
        super()._go_on_from(state)
        self.trials_played = int(state["trials_played"])


def _larger_pools(world: PooledWorld) -> dict[str, tuple[Tensor, int]]:
    """Pool of tasks (n, ...) and number of rows of each class that has fewer environments than tasks."""
    pools = {}
    for i, (name, pool) in enumerate(zip(world.task_names, world.pools, strict=True)):
        rows = int((world.task_id == i).sum())
        if rows < len(pool):
            pools[name] = (torch.tensor(pool), rows)
    return pools
