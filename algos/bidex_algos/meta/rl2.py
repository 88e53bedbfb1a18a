"""RL²: learning to learn by a memory (Duan et al. 2016, Wang et al. 2016), trained by PPO; see docs/learners/rl2.md.

An iteration plays one trial, a few episodes of one task with one memory, in every environment, makes ``epochs`` passes
over it in mini-batches of chunks, and starts the next without memory. The first only measures statistics.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bidex_algos.learner import Learner, as_numbers
from bidex_algos.meta.trials import Batch, TrialConfig, Trials, make_batch, of_task, play
from bidex_algos.nets.architecture import network_bytes
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import Memory, RecurrentNet, RecurrentPolicy
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, PPOConfig, mini_batches, policy_loss
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.agents import Timestep
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, own_seed, rank, sum_gradients, world_size
from bidex_meta.train.learner import AutoresetMode, Parts, State
from bidex_meta.utils.validation import Finite, Positive, check_rising
from bidex_meta.world.contract import PooledWorld


@dataclass(frozen=True)
class RL2Config(PPOConfig, TrialConfig):
    """Everything that can be set about RL²; the defaults are the preset ``laptop``."""

    learning_rate_range: tuple[Positive, Positive] = (1e-5, 3e-3)  # Bounds of the adaptive step size.
    entropy_weight: Finite = 0.0  # Factor of the entropy bonus.
    max_grad_norm: Positive = 1.0  # Gradients longer than this are shortened to it, actor and critic apart.
    normalise_observations: bool = True  # Give observations zero mean and unit variance by running statistics.
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
    # The appendix has no table for RL²: what ProMP's (48) has too is from there, but for its 8 steps a rollout; memory,
    # ten episodes a trial and 250 steps of backpropagation are of RL² in Meta-World's baselines (metaworld-algorithms).
    "paper": RL2Config(
        hidden=(2048, 1024, 512), memory=256, value_heads=False, init_std=1.0, episodes_per_trial=10, gamma=0.9,
        lam=0.95, chunk=250, num_minibatches=1, epochs=3, clip=0.2, learning_rate=3e-4, desired_kl=0.016,
        critic_learning_rate=None, entropy_weight=0.0, max_grad_norm=1.0, normalise_observations=False,
    ),
    # Discount and KL are MT-PPO's. With 0.97, so that what an episode finds out is paid in the next, and a KL of 0.02
    # the egg of ML1-wide was carried and not thrown after 5 M steps (docs/results/ml1.md).
    "laptop": RL2Config(),
}  # fmt: skip


class RL2Agent:
    """An adapting agent (``bidex_meta.agents``) of a policy with a memory; ``seed`` is of what it explores with.

    Episodes that adapt write the memory, each environment its own; evaluation episodes play on a copy, each after the
    same shots. No weight changes.
    """

    def __init__(self, policy: RecurrentPolicy, seed: int = 0):
        self.policy = policy
        self.device = policy.log_std.device
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.init()

    def assign(self, task_of_row: Tensor | None) -> None:
        """Nothing: each environment learns from its own episodes, rows of one task do not share what they learn."""

    def init(self) -> None:
        """Every memory is as at the start of a trial."""
        self._learned: Memory | None = None
        self._playing: Memory | None = None
        self._next_state: Tensor | None = None
        self._wait(0)

    def reset(self, env_mask: Tensor) -> None:
        """An episode begins where ``env_mask`` (N,): the memory learns of it, and forgets what was only evaluated."""
        learned = self._memory(self._learned, len(env_mask))
        self._over = ~env_mask
        self._learned = replace(learned, done=learned.done | (env_mask & self._begun))
        self._playing = self._memory(self._playing, len(env_mask)).replaced(env_mask, self._learned)

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Sampled actions (N, a) in [-1, 1] for raw observations (N, d), and the Gaussian they are from."""
        self._learned = self._memory(self._learned, len(obs))
        mean, self._next_state = self.policy.step(obs, self._learned)
        std = self.policy.log_std.detach().exp().expand_as(mean)
        noise = torch.randn(mean.shape, generator=self.noise, device=mean.device)
        return (mean + std * noise).clamp(-1.0, 1.0), {"mean": mean, "std": std}

    def step(self, timestep: Timestep) -> None:
        """Remembers one transition of every environment but those whose episode is over: they wait for ``reset``."""
        if self._learned is None or self._next_state is None:
            return
        valid, ended = timestep.valid, timestep.terminated | timestep.truncated
        # Meta-World's evaluation names no valid rows: all are.
        known = torch.ones_like(ended) if valid is None else valid
        moved = torch.ones_like(ended) if valid is None else ~self._over
        after = Memory(self._next_state, timestep.action, timestep.reward.masked_fill(~known, 0.0), known, ended)
        self._learned = self._learned.replaced(moved, after)
        self._begun, self._over = self._begun | moved, (self._over & ~moved) | ended
        self._next_state = None

    def adapt(self) -> None:
        """Nothing: the memory has learned along the way."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Mean actions (N, a) in [-1, 1] for raw observations (N, d).

        The memory goes on within the episode, shown that rewards are not known, as in training (``blind_share``).
        """
        memory = self._memory(self._playing, len(obs))
        mean, state = self.policy.step(obs, memory)
        action, no = mean.clamp(-1.0, 1.0), torch.zeros_like(memory.done)
        self._playing = Memory(state, action, torch.zeros_like(memory.reward), no, no)
        return action

    def _memory(self, memory: Memory | None, rows: int) -> Memory:
        if memory is not None and len(memory.state) == rows:
            return memory
        if self._learned is None or len(self._learned.state) != rows:
            self._wait(rows)
        return self.policy.fresh_memory(rows)

    def _wait(self, rows: int) -> None:
        self._begun = torch.zeros(rows, dtype=torch.bool, device=self.device)
        self._over = ~self._begun


class RL2(Learner):
    """RL² (Duan et al. 2016, arXiv 1611.02779): a policy with a memory that adapts to a task while it plays it."""

    name, remedy = "rl2", "lower learning_rate"
    config_type, presets = RL2Config, PRESETS
    world: PooledWorld
    config: RL2Config
    policy: RecurrentPolicy
    per_process = ("generator", "episodes")
    adapts = independent_adaptation = True
    going_on = ("trials_played", *Learner.going_on)

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
        # Classes with fewer rows than tasks: their pools and numbers of rows. Each trial takes as many tasks as that.
        rows = torch.bincount(world.task_id, minlength=world.num_tasks).tolist()
        each = zip(world.task_names, world.pools, rows, strict=True)
        self.pools = {name: (torch.tensor(pool), count) for name, pool, count in each if count < len(pool)}

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
        (low, high), measured = (math.log(std) for std in cfg.std_range), list[Tensor]()
        # The same number of parts in every process, whatever the number of its chunks.
        weights = b.weights.unflatten(0, (-1, b.size)).sum(1)[b.chunk, b.row]  # of each chunk (S,)
        batches = mini_batches(weights, cfg.epochs, cfg.num_minibatches, self.generator, Tensor.tensor_split)
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
        shared = {"critic": self.critic, "return_stats": self.return_stats, **self.adams.parts()}
        return shared | {"generator": self.generator, "episodes": [self.episodes, self.firsts, self.lasts]}
