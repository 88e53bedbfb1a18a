"""MT-PPO: proximal policy optimisation (Schulman et al. 2017) on all tasks of a world at once.

One policy reads the task's one-hot in its observation. The steps of the paper's algorithm 1 are numbered from
``OnPolicy._iterate``, which all on-policy learners share, to ``MTPPO._descend``. ``docs/learners/mtppo.md`` lists and
explains the differences from Bi-DexHands' MTPPO.
"""

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from bidex_algos.balancing import Balancing, balance_of
from bidex_algos.nets.networks import autocast
from bidex_algos.onpolicy.base import Batch, OnPolicy, OnPolicyConfig
from bidex_algos.onpolicy.demonstrations import Demonstrations
from bidex_algos.onpolicy.lessons import Lessons
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, PolicyLoss, PPOConfig, mini_batches, policy_loss
from bidex_algos.rollout import check_samples
from bidex_meta.training.distributed import sum_gradients, world_size
from bidex_meta.training.learner import NO_SOURCES, Capability, Parts, Sources, State
from bidex_meta.utils.validation import Count, Whole
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.graphs import GraphCache, cuda_graphs

_VALUE_LOSS_WEIGHT = 2.0  # Adam cancels this factor, so it matters only for the clipping of the critic's gradients
_MAX_GRAD_NORM = 1.0  # gradients are clipped to this norm, separately for actor and critic


@dataclass(frozen=True)
class MTPPOConfig(PPOConfig, OnPolicyConfig):
    """All options of MT-PPO; the defaults are the preset ``laptop``."""

    gradient_surgery: Balancing = "none"
    """Combination of the tasks' policy gradients. none: sum. pcgrad: sum, after removing from each gradient what points
    against another task's gradient (Yu et al. 2020). cagrad: sum, changed in favour of the task that it would improve
    least (Liu et al. 2021). famo: sum, weighted so that all losses fall at the same rate (Liu et al. 2023)."""
    demonstration_batch: Count = 256  # With --demonstrations: demonstrated transitions per mini-batch and process.
    demonstration_cloning: Whole = 0  # With --demonstrations: steps of behaviour cloning before the training.
    teacher_updates: Whole = 20
    """With --teacher: DAgger updates per PPO update while a taught class never succeeds, fewer later; 0: none."""
    critic_first: Whole = 0
    """Number of first environment steps in which only the critic learns. Use this for a policy that begins with a skill
    (cloned, or from --start-from), because updates with an untrained critic would spoil the skill."""


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
            self._graphs = GraphCache(dict, lambda _: None, cuda_graphs(self.device))
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
