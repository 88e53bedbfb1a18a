"""MT-PPO: proximal policy optimisation (Schulman et al. 2017) on all tasks of a world at once.

One policy reads the task's one-hot in its observation. The steps of the paper's algorithm 1 are numbered from
``OnPolicy._iterate``, which all on-policy learners share, to ``MTPPO._descend``. ``docs/learners/mtppo.md`` lists and
explains the differences from Bi-DexHands' MTPPO.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from bidex_algos import advantages as estimates
from bidex_algos.balancing import Balancing, balance_of
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import Architecture, check_networks, network_bytes, network_of
from bidex_algos.nets.networks import Activation, Autocast, Layers, autocast, gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy, of_head
from bidex_algos.onpolicy.demonstrations import Demonstrations
from bidex_algos.onpolicy.lessons import Lessons
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, PolicyLoss, mini_batches, policy_loss
from bidex_algos.rollout import EpisodeStatistics, Rollout, check_samples, collect
from bidex_meta.training.distributed import all_sum, sum_gradients, world_size
from bidex_meta.training.learner import NO_SOURCES, Capability, LearnerConfig, Parts, Sources, State
from bidex_meta.utils.validation import Count, Fraction, Positive, Whole, Widths, check_rising
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.graphs import GraphCache, cuda_graph

_VALUE_HORIZON = 100.0  # iterations over which old returns fade from the statistics that define the critic's units
_VALUE_LOSS_WEIGHT = 2.0  # Adam cancels this factor, so it matters only for the clipping of the critic's gradients
_MAX_GRAD_NORM = 1.0  # gradients are clipped to this norm, separately for actor and critic


@dataclass(frozen=True)
class OnPolicyConfig(LearnerConfig):
    """Options of networks, rollouts and statistics; the defaults are the preset ``laptop``."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: the same trunk with policy_heads and value_heads. towers: tasks
    share only the first layer. separate: tasks share no layer. soft_modules, paco, moore, transformer: other trunks,
    each with or without heads. All except shared need an MT suite, whose observations show the task."""
    hidden: Layers = (256, 256, 128)  # Widths of the hidden layers, the same for actor and critic.
    activation: Activation = "elu"  # Non-linearity of the hidden layers.
    policy_heads: bool = False  # Give the actor an output layer per task; the world must show the task's one-hot.
    value_heads: bool = True  # Give the critic one output per task instead of one for all.
    point_widths: Widths = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), if the world shows a point cloud."""
    init_std: Positive = 0.8  # Initial standard deviation of the actions.
    std_range: tuple[Positive, Positive] = (0.05, 1.5)  # Bounds of the standard deviation of the actions.
    rollout_steps: Count = 8  # Steps in every environment between two updates.
    gamma: Fraction = 0.93  # Discount factor per step.
    lam: Fraction = 0.95  # Lambda of generalised advantage estimation.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot is not changed."""
    autocast: Autocast = "auto"  # Use bfloat16 in hidden layers; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_networks(self)
        check_rising(self, self.algo, "std_range")

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        return 4 * num_envs * width * self.rollout_steps + network_bytes(self.hidden, width, 2)


@dataclass(frozen=True)
class MTPPOConfig(OnPolicyConfig):
    """All options of MT-PPO; the defaults are the preset ``laptop``."""

    num_minibatches: Count = 4  # Mini-batches per epoch; each holds shuffled samples of all environments.
    epochs: Count = 4  # Passes over the rollout per update.
    clip: Positive = 0.2  # Distance of the likelihood ratio from 1 at which the objective is clipped.
    learning_rate: Positive = 3e-4  # Adam's initial step size.
    desired_kl: Positive = 0.03
    """Desired KL of the sampling policy from the current policy. The step size is divided by 1.5 if the KL is above
    twice this value, and multiplied by 1.5 if the KL is below half of it."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 1e-2)  # Bounds of the adaptive step size.
    critic_learning_rate: Positive | None = 1e-3  # Fixed step size for the critic; None: the same as the actor's.
    gradient_surgery: Balancing = "none"
    """Combination of the tasks' policy gradients. none: sum. pcgrad: sum, after removing from each gradient what points
    against another task's gradient (Yu et al. 2020). cagrad: sum, turned towards the task whose loss it would lower
    least (Liu et al. 2021). famo: sum, weighted so that all losses fall at the same rate (Liu et al. 2023)."""
    demonstration_batch: Count = 256  # With --demonstrations: demonstrated transitions per mini-batch and process.
    demonstration_cloning: Whole = 0  # With --demonstrations: steps of behaviour cloning before the training.
    teacher_updates: Whole = 20
    """With --teacher: DAgger updates per PPO update while a taught class never succeeds, fewer later; 0: none."""
    critic_first: Whole = 0
    """Number of first environment steps in which only the critic learns. Use this for a policy that begins with a skill
    (cloned, or from --start-from), because updates with an untrained critic would spoil the skill."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "learning_rate_range")


PRESETS: dict[str, MTPPOConfig] = {
    # These values are from Table 47 of the Bi-DexHands appendix.
    "paper": MTPPOConfig(
        hidden=(2048, 1024, 512), value_heads=False, init_std=0.8, rollout_steps=8, num_minibatches=4, gamma=0.96,
        lam=0.95, normalise_observations=False, epochs=5, clip=0.2, learning_rate=3e-4, desired_kl=0.016,
        critic_learning_rate=None,
    ),
    "laptop": MTPPOConfig(),
    # This preset is for version 2 of the suites (docs/results/ladder.md). The discount covers a whole episode of 250
    # steps; low noise lets the policy hold still, as success requires.
    "v2": MTPPOConfig(gamma=0.99, init_std=0.3),
    # This preset is for Meta-World's multi-task suites. Discount, trace and clip are from its authors' MTPPO
    # (metaworld-algorithms). Networks are small, and rollouts have 100 steps instead of 10,000. With 250 steps (ELU, 8
    # mini-batches) success on MT3 was 24 % after 150 k steps instead of 42 %.
    "metaworld": MTPPOConfig(
        activation="tanh", rollout_steps=100, epochs=5, gamma=0.99, lam=0.97, learning_rate=5e-4, desired_kl=0.02,
        std_range=(0.1, 1.5),
    ),
}  # fmt: skip


@dataclass
class Batch:
    """A rollout prepared for the update, with steps and rows flattened into B samples."""

    obs: Tensor  # normalised observations (B, d), in the precision of the hidden layers
    task_id: Tensor  # task of each sample (B,)
    actions: Tensor  # sampled actions (B, a)
    old_means: Tensor  # means of the sampling policy (B, a)
    old_log_probs: Tensor  # log-density of the actions under the sampling policy (B,)
    advantages: Tensor  # normalised advantages (B,); with several critics (B, critics)
    targets: Tensor  # the critic's targets: normalised returns (B,); with several critics (B, critics)
    weights: Tensor  # 0 if physics broke in the transition, otherwise 1 (B,)

    def select(self, index: Tensor) -> "Batch":
        """Return the samples of this batch at ``index``."""
        return Batch(**{name: value.index_select(0, index) for name, value in vars(self).items()})


class OnPolicy(Learner):
    """A Gaussian policy and a critic (``num_critics`` values of a state) that learn from the latest rollout."""

    config: OnPolicyConfig
    policy: GaussianPolicy
    capabilities = frozenset({Capability.DISCOUNTS_BY_CLASS})
    per_process = ("generator", "episodes", "obs")
    going_on = ("obs", *Learner.going_on)
    policy_of = staticmethod(gaussian_policy)
    num_critics = 1

    def __init__(self, world: VectorWorld, config: OnPolicyConfig, seed: int):
        super().__init__(world, config, seed)
        self.low_precision = self.policy.low_precision
        self.obs: Tensor | None = None
        self.critic = self._make_critic(world.num_tasks if config.value_heads else 1).to(self.device)
        horizon = _VALUE_HORIZON * config.rollout_steps * world.num_envs * world_size() / world.num_tasks
        self.return_stats = RunningStats((self.num_critics * world.num_tasks,), max_count=horizon).to(self.device)
        self.gamma = estimates.discounts(world, config.gamma, world.task_id)
        sizes = self.shape.observations, self.shape.actions
        self.rollout = Rollout(config.rollout_steps, world.num_envs, *sizes, self.device, self.num_critics)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    def _make_critic(self, heads: int) -> nn.Module:
        config = self.config
        return network_of(config)(self.inputs, config.hidden, heads, 1.0, self.initial, config.activation)

    @abstractmethod
    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """Learn from a batch; return scalars to be logged."""

    @abstractmethod
    def _optimisers(self) -> Parts:
        """Return the optimisers by their names in a checkpoint."""

    def _iterate(self) -> dict[str, float]:
        # Step 1: collect a rollout with the current policy.
        with self._collecting():
            if self.obs is None:
                self.obs = self._first_observations()
            self.obs = collect(self.world, self.rollout, self.obs, self._sample, self._final_value, self.episodes)
        # Step 2: compute advantages and the critic's targets.
        batch, explained = self._prepare()
        # Steps 3 to 6: learn from them.
        losses = self._update(batch)
        self.policy.observations.update(self.rollout.obs)
        self.env_steps += self.rollout.rewards.numel() * world_size()
        return self._metrics(losses, explained)

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.policy.distribution(obs)
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        # The action is not clamped: the world clamps it, and the density must be of the sampled action.
        return mean + log_std.exp() * noise, mean

    def _final_value(self, obs: Tensor, task_id: Tensor) -> Tensor:
        return self._in_reward_units(self._critic(self.policy.observations(obs), task_id), task_id)

    # The unit of the critic's values is given by its task's running mean and standard deviation of returns.
    def _critic(self, obs: Tensor, task_id: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            out = self.critic(obs)
        if self.config.value_heads:
            return of_head(out, task_id)
        return out.squeeze(1)

    def _element(self, task_id: Tensor) -> Tensor:
        if self.num_critics == 1:
            return task_id
        return task_id[:, None] + self.world.num_tasks * torch.arange(self.num_critics, device=self.device)

    def _in_reward_units(self, values: Tensor, task_id: Tensor) -> Tensor:
        return self.return_stats.restore(values, self._element(task_id))

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        self.return_stats.merge(mean, var, count)

    @torch.no_grad()
    def _prepare(self) -> tuple[Batch, Tensor]:
        """Return the batch, and the share of the returns' variance that the critic explains, (num_tasks,)."""
        r = self.rollout
        num_tasks = self.world.num_tasks
        task_id = self.world.task_id
        flat_task_id = task_id.expand(r.rewards.shape).reshape(-1)
        obs = self.policy.observations(r.obs).flatten(0, 1)
        if self.low_precision:
            obs = obs.bfloat16()  # autocast would make this cast in every mini-batch; the result is the same

        # Several critics give several columns per row; each column is treated as a separate row.
        def each(x: Tensor) -> Tensor:
            return x.repeat_interleave(self.num_critics, 1)

        judged = self._in_reward_units(self._critic(obs, flat_task_id), flat_task_id)
        values = judged.view(len(r.rewards), -1)
        last_values = self._final_value(r.last_obs, task_id).view(-1)
        rewards, terminated, ended, valid = map(each, (r.rewards, r.terminated, r.ended, r.valid))
        element = self._element(task_id).reshape(-1)
        elements = self.num_critics * num_tasks
        next_values = estimates.successor_values(values, last_values, ended, r.final_values.flatten(1))
        gamma = each(self.gamma[None]) if isinstance(self.gamma, Tensor) else self.gamma
        advantages = estimates.gae(rewards, values, next_values, terminated, ended, gamma, self.config.lam, valid)
        returns = advantages + values
        explained = estimates.explained_variance(values, returns, element, elements, valid)
        self._merge_returns(*estimates.task_moments(returns, element, elements, valid))
        advantages = estimates.normalise_per_task(advantages, element, elements, valid)
        actions = r.actions.flatten(0, 1)
        old_means = r.means.flatten(0, 1)
        batch = Batch(
            obs=obs, task_id=flat_task_id, actions=actions, old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.actor.log_std_of(obs)),
            advantages=advantages.reshape(judged.shape),
            targets=self.return_stats.normalise(returns.reshape(judged.shape), self._element(flat_task_id)),
            weights=r.valid.flatten().float()
        )  # fmt: skip
        return batch, explained.view(-1, num_tasks).mean(0)

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.actor.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum((~self.rollout.valid).sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        return self.episodes.metrics() | as_numbers(tensors)

    def _parts(self) -> Parts:
        learned = {"critic": self.critic, "return_stats": self.return_stats, **self._optimisers()}
        return learned | {"generator": self.generator, "episodes": self.episodes}

    def _check_size(self, state: State) -> None:
        if state["obs"] is not None:
            here = tuple(self.rollout.last_obs.shape)
            self._expect("(num_envs, observations) = ", tuple(state["obs"].shape), here)


class MTPPO(OnPolicy):
    """Multi-task PPO (Schulman et al. 2017, arXiv 1707.06347) on a batched world."""

    name = "mtppo"
    remedy = "lower learning_rate"
    config_type = MTPPOConfig
    presets = PRESETS
    capabilities = OnPolicy.capabilities | {Capability.IMITATES}
    config: MTPPOConfig
    demonstrations: Demonstrations | None = None
    lessons: Lessons | None = None

    def __init__(self, world: VectorWorld, config: MTPPOConfig, seed: int, sources: Sources = NO_SOURCES):
        sources.check(self.name, "demonstrations", "teachers")
        check_samples(self.name, config.rollout_steps, world.num_envs, config.num_minibatches)
        super().__init__(world, config, seed)
        self.adams = AdaptiveAdams(
            self.policy.actor.parameters(), self.critic.parameters(), config.learning_rate, config.learning_rate_range,
            config.desired_kl, config.critic_learning_rate, self.device
        )  # fmt: skip
        self.balance = balance_of(config.gradient_surgery, world.num_tasks, self.device)
        self._graphs = None
        # The weight of demonstrations is not a tensor, so an update with demonstrations cannot be recorded.
        alone = self.balance is None and sources.demonstrations is None and world_size() == 1
        if alone and self.device.type == "cuda":
            self._graphs = GraphCache(dict, lambda _: None, cuda_graph)
        if sources.demonstrations is not None:
            self.demonstrations = Demonstrations(sources.demonstrations, config.demonstration_batch, seed, self.device)
            self.per_process = (*self.per_process, "demonstrated")
        if sources.teachers is not None:
            self.lessons = Lessons(world, self.policy, sources.teachers, config.rollout_steps)
            self.per_process = (*self.per_process, "data")
            self.rollout.ended[-1] = True  # episodes of the teachers also begin with the first step

    def _iterate(self) -> dict[str, float]:
        if self.demonstrations is not None and not self.env_steps:
            self.demonstrations.clone(self.policy, self.config.demonstration_cloning)
        self.policy.observations.settled = self.env_steps < self.config.critic_first
        return super()._iterate()

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        if self.lessons is not None:
            step = self.lessons.data.added % self.config.rollout_steps
            self.lessons.teachers.reset(self.rollout.ended[step - 1])
            self.lessons.label(obs)
        return super()._sample(obs)

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        cfg = self.config
        critic_alone = self.env_steps < cfg.critic_first
        old_log_std = self.policy.actor.log_std.detach().clone()
        measured = list[Tensor]()
        # Step 3: several epochs of shuffled mini-batches. On CUDA the steps on them are recorded once and replayed.
        for first, index, count in mini_batches(batch.weights, cfg.epochs, cfg.num_minibatches, self.generator):
            inputs = *vars(batch.select(index)).values(), count, old_log_std
            work = partial(self._descend, first, critic_alone)
            if self._graphs is None:
                measured.append(work(*inputs))
            else:
                name = f"{len(index)} samples, first {first}, critic alone {critic_alone}"
                measured.append(self._graphs.run(name, work, *inputs).clone())
        names = [*NAMES, self.balance.tag] if self.balance is not None else [*NAMES]
        if self.demonstrations is not None:
            names.append("Loss/demonstrations")
        means = torch.stack(measured).mean(0)
        reported = {**dict(zip(names, means, strict=True)), "Policy/lr": self.adams.rate}
        if self.demonstrations is not None:
            reported["Policy/demonstration_weight"] = means.new_tensor(self.demonstrations.weight(self.env_steps))
        # This loss is not in the paper: the teachers' labels keep each class near what the teacher does, in proportion
        # to the policy's failures.
        if self.lessons is not None:
            self.lessons.take_moments(cfg.rollout_steps)
            updates = 0 if critic_alone else cfg.teacher_updates
            reported |= self.lessons.learn_by_need(updates, self.generator, self.episodes)
        return reported

    def _descend(self, first: bool, critic_alone: bool, *inputs: Tensor) -> Tensor:
        """Take one step on a mini-batch, and return the numbers to be logged, summed over processes.

        ``inputs`` are the fields of the mini-batch's :class:`Batch`, the sum of its weights over all processes, and the
        log standard deviations of the sampling policy. ``first`` marks the first mini-batch of an update. If
        ``critic_alone``, only the critic takes a step.
        """
        *fields, count, old_log_std = inputs
        b = Batch(*fields)
        actor = self.policy.actor
        # Step 4: compute the clipped surrogate (equation 7) and the critic's squared error, as means over the
        # mini-batch.
        loss = self._loss(b, count, old_log_std)
        value = (b.weights / count * (self._critic(b.obs, b.task_id) - b.targets).square()).sum()
        rest = _VALUE_LOSS_WEIGHT * value
        numbers = loss.numbers(value)
        imitated = None
        if self.demonstrations is not None:
            imitated = self.demonstrations.loss(self.policy) / world_size()
            rest = rest + self.demonstrations.weight(self.env_steps) * imitated
        # Step 5: compute the gradients and sum them over processes; conflicting gradients of tasks may be balanced.
        self.adams.zero_grad()
        if self.balance is not None:
            losses = self._per_task(-loss.earned, b.task_id)
            least = self._per_task(self._least(b, count), b.task_id)
            numbers.append(self.balance.backward(losses, least, list(actor.parameters())))
            rest.backward()
        else:
            (loss.surrogate + rest).backward()
        if imitated is not None:
            numbers.append(imitated.detach())
        summed = sum_gradients([*actor.parameters(), *self.critic.parameters()], torch.stack(numbers))
        # Step 6: take a step of Adam, whose size follows the KL (element 2) of the mini-batch. The first mini-batch's
        # KL is 0.
        self.adams.descend(None if first else summed[2], _MAX_GRAD_NORM, critic_alone)
        self._bound_std()
        if self.balance is not None:
            self.balance.learn(lambda: self._above_least(b, count, old_log_std))
        return summed

    def _loss(self, b: Batch, count: Tensor, old_log_std: Tensor) -> PolicyLoss:
        actor = self.policy.actor
        with autocast(self.device, self.low_precision):
            means = actor(b.obs)
        return policy_loss(
            b.actions, means, actor.log_std_of(b.obs), b.old_means, actor.log_std_of(b.obs, old_log_std),
            b.old_log_probs, b.advantages, weights=b.weights / count, clip=self.config.clip
        )  # fmt: skip

    def _least(self, b: Batch, count: Tensor) -> Tensor:
        """Return the smallest surrogate loss that each sample can reach (B,), given the clip of the ratio."""
        return -b.weights / count * (b.advantages + self.config.clip * b.advantages.abs())

    def _above_least(self, b: Batch, count: Tensor, old_log_std: Tensor) -> Tensor:
        loss = self._loss(b, count, old_log_std)
        return self._per_task(-loss.earned - self._least(b, count), b.task_id)

    def _per_task(self, x: Tensor, task_id: Tensor) -> Tensor:
        return x.new_zeros(self.world.num_tasks).index_add(0, task_id, x)

    @torch.no_grad()
    def _bound_std(self) -> None:
        low, high = (math.log(std) for std in self.config.std_range)
        self.policy.actor.log_std.clamp_(low, high)

    def start_from(self, policy: State) -> None:
        """Start as in the base class, with standard deviations within ``std_range`` and the smallest step size."""
        super().start_from(policy)
        if self._graphs is not None:
            self._graphs.forget()
        self._bound_std()
        # The KL is known only after a step. After a policy trained by DAgger, the first KL was 187 with a step size of
        # 3e-4.
        self.adams.rate.fill_(self.adams.bounds[0])

    def _optimisers(self) -> Parts:
        return self.adams.parts() | ({} if self.balance is None else self.balance.parts())

    def _parts(self) -> Parts:
        parts = super()._parts()
        if self.lessons is not None:
            parts |= {"teacher_adam": self.lessons.adam, "label_stats": self.lessons.label_stats}
        if self.demonstrations is not None:
            parts |= {"demonstrated": self.demonstrations.generator}
        return parts

    def _place(self) -> State:
        own = self.demonstrations
        return super()._place() | ({} if own is None else {"demonstrations": own.fingerprint})

    def state_dict(self) -> State:
        """Return the base class's state and, if there are teachers, a copy of the labelled data.

        The data set makes this copy itself, because a second copy by the base class may not fit in memory.
        """
        return super().state_dict() | ({} if self.lessons is None else {"data": self.lessons.data.state_dict()})

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`.

        If a teacher must see an episode from its start, begin new episodes.
        """
        super().load_state_dict(state)
        if self._graphs is not None:
            self._graphs.forget()
        if self.lessons is None:
            return
        self.lessons.data.load_state_dict(state["data"])
        if self.obs is not None and self.lessons.teachers.follow:
            self.obs, _ = self.world.reset()
            self.rollout.ended[-1] = True

    def _check_size(self, state: State) -> None:
        super()._check_size(state)
        if self.demonstrations is not None:
            self.demonstrations.check(self.name, state.get("demonstrations"))
