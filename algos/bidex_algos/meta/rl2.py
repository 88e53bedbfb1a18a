"""RL²: meta-learning with a memory (Duan et al. 2016, Wang et al. 2016), trained by PPO; see docs/learners/rl2.md.

An iteration plays one trial in every environment: a few episodes of one task with one memory. The learner makes
``epochs`` passes over the trial in mini-batches of chunks, which are sequences of ``chunk`` steps. The next trial
starts with an empty memory. The first trial is only used to measure statistics. The paper has no pseudo-code; comments
name its sections 2.2 (formulation, figure 1), 2.3 (policy) and 2.4 (optimisation).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.learner import as_numbers
from bidex_algos.meta.config import USUAL_STEPS
from bidex_algos.meta.trial_learner import TrialLearner
from bidex_algos.meta.trials import Batch, Sampling, Trials, make_batch, of_task
from bidex_algos.nets.architecture import network_bytes
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import Activation
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import RecurrentNet, RecurrentPolicy
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, OptionalRateConfig, mini_batches, policy_loss
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_sum, sum_gradients, world_size
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Count, Finite, Fraction, Positive, Widths, check_rising
from bidex_meta.world.contract import PooledWorld


@dataclass(frozen=True)
class RL2Config(OptionalRateConfig):
    """All options of RL²; the defaults are the preset ``laptop``."""

    hidden: Widths = (256, 128)  # Widths of the layers before the memory, the same for actor and critic.
    activation: Activation = "elu"  # Non-linearity of the layers before the memory.
    memory: Count = 128  # Size of an environment's memory (the state of a GRU); actor and critic have one each.
    value_heads: bool = True  # Give the critic one output per task class instead of one for all.
    init_std: Positive = 0.8  # Initial standard deviation of the actions.
    std_range: tuple[Positive, Positive] = (0.05, 1.5)  # Bounds of the standard deviation of the actions.
    episodes_per_trial: Count = 3  # Episodes that share one memory: the adaptation episodes, and one more.
    max_adapt_steps: Count | None = None  # Steps after which an episode of a trial is cut; None: whole episodes.
    blind_share: Fraction = 0.0
    """Share of the episodes in which the policy does not see rewards, as in a meta-test with hidden rewards."""
    reward_unit: Positive = 0.01
    """The policy reads a reward as asinh(reward / reward_unit), normalised by running statistics."""
    gamma: Fraction = 0.93  # Discount per step; a return continues into the later episodes of the trial.
    lam: Fraction = 0.95  # Trace decay of the advantage estimate.
    chunk: Count | None = None
    """Number of steps over which gradients flow back through the memory; None: all steps of the trial."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 3e-3)  # Bounds of the adaptive step size.
    entropy_weight: Finite = 0.0  # Factor of the entropy bonus.
    max_grad_norm: Positive = 1.0  # Gradients are clipped to this norm, separately for actor and critic.
    normalise_observations: bool = True  # Give observations zero mean and unit variance by running statistics.
    value_horizon: Positive = 100.0
    """Number of iterations over which old returns fade from the statistics that normalise the critic's targets."""

    @property
    def trial_steps(self) -> int:
        """Return the maximum number of steps of a trial.

        If a trial consists of whole episodes, this is an estimate until the learner knows the world's time limits.
        """
        return self.episodes_per_trial * (self.max_adapt_steps or USUAL_STEPS)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "std_range")

    def check_environments(self, num_envs: int, tasks: Mapping[str, int]) -> None:
        """Raise BidexError if there are fewer environments than mini-batches."""
        if num_envs < self.num_minibatches:
            raise BidexError(
                f"{self.algo}: {self.num_minibatches} mini-batches need as many environments, got {num_envs}. Raise "
                "num_envs or lower num_minibatches."
            )

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        memory = 4 * 4 * 2 * 3 * self.memory * (self.memory + self.hidden[-1])
        return 4 * num_envs * width * self.trial_steps + network_bytes(self.hidden, width, 2) + memory


PRESETS: dict[str, RL2Config] = {
    # The appendix has no table for RL². Values that ProMP's table (48) also has are from that table, except its 8 steps
    # per rollout. Memory, ten episodes per trial and 250 steps of backpropagation are from RL² in Meta-World's
    # baselines (metaworld-algorithms).
    "paper": RL2Config(
        hidden=(2048, 1024, 512), memory=256, value_heads=False, init_std=1.0, episodes_per_trial=10, gamma=0.9,
        lam=0.95, chunk=250, num_minibatches=1, epochs=3, clip=0.2, learning_rate=3e-4, desired_kl=0.016,
        critic_learning_rate=None, entropy_weight=0.0, max_grad_norm=1.0, normalise_observations=False,
    ),
    # Discount and KL are MT-PPO's. We also tried a discount of 0.97, which rewards exploration through the next
    # episode, with a KL of 0.02: after 5 M steps the policy carried the egg of ML1-wide and did not throw it
    # (docs/results/ml1.md).
    "laptop": RL2Config(),
    # This preset is for version 2 of the suites (docs/results/ladder.md), with 16 environments per class. The discount
    # covers a whole episode of 250 steps; low noise lets the policy hold still; the reward of a step is at most 1.
    # Chunks of half an episode, three epochs and the narrow encoder together halved the time of an update.
    "v2": RL2Config(
        gamma=0.99, init_std=0.3, reward_unit=0.3, chunk=125, hidden=(128, 128), num_minibatches=4, epochs=3,
    ),
    # This is v2 for 4,096 to 8,192 environments per class on a GPU. The values follow from the rules below and were
    # never tried. Discount, noise, unit of rewards and chunk do not depend on the number of environments.
    "gpu": RL2Config(
        gamma=0.99, init_std=0.3, reward_unit=0.3, chunk=125,
        hidden=(256, 128),  # as in laptop; v2 is narrower only because an update on a CPU takes long
        num_minibatches=16,  # with v2's 4 a trial of 3 million steps would have 12 Adam steps
        epochs=5,  # 80 Adam steps per trial, 7 times v2's: there are fewer trials in a budget, and the KL bounds each
        learning_rate=1e-3,  # 3e-4 times the root of the ratio of batches would be 2.4e-3; the KL adapts the rest
        value_horizon=10.0,  # ten iterations suffice: each has 256 times the returns of an iteration of v2
    ),
}  # fmt: skip


class RL2(TrialLearner):
    """RL² (Duan et al. 2016, arXiv 1611.02779): a policy with a memory, by which it adapts to a task while it acts."""

    name = "rl2"
    remedy = "lower learning_rate"
    config_type = RL2Config
    presets = PRESETS
    config: RL2Config
    # An update needs whole trials. With 64 environments, a door took 2.3 times the steps to reach the same success.
    environments_per_class = 16

    def __init__(self, world: PooledWorld, config: RL2Config, seed: int):
        super().__init__(world, config, seed)
        heads = world.num_tasks if config.value_heads else 1
        self.critic = self._make_critic(heads).to(self.device)
        self.adams = AdaptiveAdams(
            self.policy.parameters(), self.critic.parameters(), config.learning_rate, config.learning_rate_range,
            config.followed_kl, config.critic_learning_rate, self.device
        )  # fmt: skip
        limits = self.limits
        shape = self.shape
        self.trials = Trials(config.episodes_per_trial, limits, shape.observations, shape.actions, config.chunk)
        steps = config.episodes_per_trial * float(limits.float().mean()) * world.num_envs * world_size()
        horizon = config.value_horizon * steps / world.num_tasks
        self.return_stats = RunningStats((world.num_tasks,), max_count=horizon).to(self.device)

    def _iterate(self) -> dict[str, float]:
        # Section 2.2: play a trial, several episodes of one task. The memory passes from episode to episode and is
        # empty at the start of the next trial.
        self._play(self.trials, Sampling(self.policy, self.generator), self.config.blind_share)
        filled = self.trials.filled()
        valid = self.trials.valid & filled
        seen = self.trials.obs[filled], self.trials.rewards[valid]
        if self.trials_played == 0:
            # The first trial only updates statistics. Statistics of the initial states alone, in which nothing moves,
            # amplified noise so much that the policy had to unlearn most of what it learned from this trial.
            self.policy.update_statistics(*seen)
            losses = {}
            explained = self._prepare()[1]
        else:
            # Section 2.2: the objective is the discounted reward of the whole trial, not of an episode; see make_batch.
            batch, explained = self._prepare()
            # Section 2.4: optimise the recurrent policy. The paper uses TRPO; this is PPO.
            losses = self._update(batch)
            self.policy.update_statistics(*seen)
        self._count(self.trials)
        return self._metrics(losses, explained, filled & ~valid)

    def _prepare(self) -> tuple[Batch, Tensor]:
        return make_batch(self.trials, self.policy, self.critic, self.return_stats, self.world.task_id, self.config)

    def _update(self, b: Batch) -> dict[str, Tensor]:
        cfg = self.config
        policy = self.policy
        old_log_std = policy.log_std.detach().clone()
        low, high = (math.log(std) for std in cfg.std_range)
        measured = list[Tensor]()
        # Every process makes the same number of parts, independent of the number of its chunks.
        weights = b.weights.unflatten(0, (-1, b.size)).sum(1)[b.chunk, b.row]  # weights of each chunk (S,)
        batches = mini_batches(weights, cfg.epochs, cfg.num_minibatches, self.generator, Tensor.tensor_split)
        for first, index, count in batches:
            # PPO's step on a mini-batch of chunks: gradients of policy and critic, then a step of Adam, whose size
            # follows the KL (element 2) of the mini-batch. The first mini-batch's KL is 0.
            measured.append(self._gradients(b, index, count, old_log_std))
            self.adams.descend(None if first else measured[-1][2], cfg.max_grad_norm)
            with torch.no_grad():
                policy.log_std.clamp_(low, high)
        return {**dict(zip(NAMES, torch.stack(measured).mean(0), strict=True)), "Policy/lr": self.adams.rate}

    def _gradients(self, b: Batch, chosen: Tensor, count: Tensor, old_log_std: Tensor) -> Tensor:
        policy = self.policy
        means, out = self._outputs(b, chosen)
        weights = b.take(b.weights, chosen) / count
        values = of_task(out, self.world.task_id[b.row[chosen]])
        targets = b.take(b.targets, chosen)
        value = (weights * (values - targets).square()).sum()
        loss = policy_loss(
            b.take(b.actions, chosen), means, policy.log_std, b.take(b.old_means, chosen), old_log_std,
            b.take(b.old_log_probs, chosen), b.take(b.advantages, chosen), weights=weights, clip=self.config.clip
        )  # fmt: skip
        self.adams.zero_grad()
        (loss.surrogate + value - self.config.entropy_weight * loss.entropy).backward()
        return sum_gradients([*policy.parameters(), *self.critic.parameters()], torch.stack(loss.numbers(value)))

    def _outputs(self, b: Batch, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (C, B, a) and values (C, B, heads) in B chunks of C steps.

        ``chosen``, int64 (B,), are the indices of these chunks among all chunks of the trial that hold a step.
        """
        chunk = b.chunk[chosen]
        row = b.row[chosen]
        # Section 2.3: each step reads the observation, the last action, the last reward and the end of an episode.
        x = self.policy.see(b.take(b.obs, chosen), *(b.take(p, chosen) for p in b.previous))
        # Section 2.4: the baseline has a GRU too. Gradients flow through the steps of a chunk, not into its first
        # memory, which was computed before the update.
        means, _ = self.policy.actor(x, b.actor_states[chunk, row])
        values, _ = self.critic(x, b.critic_states[chunk, row])
        return means, values

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor, broken: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum(broken.sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        return self._episodes_metrics() | as_numbers(tensors)

    def _make_critic(self, heads: int) -> nn.Module:
        """Return a network that maps inputs (T, B, inputs) and a memory to values (T, B, heads) and the next memory."""
        config = self.config
        return RecurrentNet(
            self.policy.inputs, config.hidden, config.memory, heads, 0.01, self.initial, config.activation,
            config.trial_steps
        )  # fmt: skip

    @classmethod
    def _make_policy(
        cls, config: RL2Config, shape: Shape, init: torch.Generator, device: torch.device
    ) -> RecurrentPolicy:
        def actor(inputs: Inputs) -> RecurrentNet:
            return cls._make_actor(config, inputs, shape.actions, init)

        return RecurrentPolicy(
            cls._inputs(config, shape), shape.actions, config.memory, config.init_std, config.reward_unit,
            config.normalise_observations, actor
        ).to(device)  # fmt: skip

    @classmethod
    def _make_actor(cls, config: Any, inputs: Inputs, actions: int, init: torch.Generator) -> RecurrentNet:
        return RecurrentNet(
            inputs, config.hidden, config.memory, actions, 0.01, init, config.activation, config.trial_steps
        )

    def _parts(self) -> Parts:
        shared = {"critic": self.critic, "return_stats": self.return_stats, **self.adams.parts()}
        return shared | {"generator": self.generator, "episodes": [self.episodes, self.firsts, self.lasts]}
