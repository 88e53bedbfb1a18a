"""MT-PPO: proximal policy optimisation (Schulman et al. 2017) on all tasks of a world at once.

One policy reads the task's one-hot in its observation. ``docs/learners/mtppo.md`` lists and explains the differences
from Bi-DexHands' MTPPO.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bidex_algos.balancing import Balance, Balancing, Famo, GradientBalance, conflict_averse, project_conflicting
from bidex_algos.nets.architecture import Options
from bidex_algos.nets.networks import autocast
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.onpolicy.base import TABLE_47, Batch, OnPolicy, OnPolicyConfig, check_samples
from bidex_algos.onpolicy.lessons import Lessons
from bidex_algos.onpolicy.ppo import NAMES, AdaptiveAdams, PolicyLoss, PPOConfig, policy_loss
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_sum, own_seed, sum_gradients, world_size
from bidex_meta.training.learner import NO_SOURCES, Capability, Parts, Sources, State
from bidex_meta.utils.validation import BelowOne, Count, Finite, NonNegative, Positive, Whole
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.graphs import GraphCache, cuda_graph


@dataclass(frozen=True)
class MTPPOConfig(PPOConfig, OnPolicyConfig):
    """All options of MT-PPO; the defaults are the preset ``laptop``."""

    value_loss_weight: Finite = 2.0  # Factor of the value loss. Adam undoes it; it matters only beside max_grad_norm.
    entropy_weight: Finite = 0.0  # Factor of the entropy bonus.
    max_grad_norm: Positive = 1.0  # Gradients longer than this are shortened to it.
    clip_apart: bool = True
    """Shorten the gradients of actor and critic apart, so that a large value error leaves the policy's step alone."""
    gradient_surgery: Balancing = "none"
    """What becomes of the tasks' policy gradients. pcgrad: each loses what points against another task's (Yu et al.
    2020). cagrad: their sum is turned towards the task that it serves worst (Liu et al. 2021). famo: losses are weighed
    so that all fall at one rate (Liu et al. 2023)."""
    cagrad_radius: BelowOne = 0.4  # How far cagrad's direction may leave the mean gradient, in its lengths; 0: not.
    famo_rate: Positive = 0.025  # Adam's step size of famo's weights.
    famo_decay: NonNegative = 0.01  # By which these weights are drawn back to even ones.
    demonstration_weight: NonNegative = 0.1
    """With --demonstrations: weight at the start of the policy's distance from them; 0: they count nothing."""
    demonstration_half_life: Positive = 500_000.0  # Environment steps in which that weight falls to half.
    demonstration_batch: Count = 256  # Transitions of them in each mini-batch, of each process.
    demonstration_cloning: Whole = 0  # Steps of so many of them in which the policy is cloned before it plays.
    teacher_updates: Whole = 20
    """With --teacher: DAgger's updates after each of PPO's, while a taught class never succeeds; 0: none."""
    teacher_success: Positive = 0.8
    """Success of a class's last 100 episodes from which its teacher counts nothing; up to there its weight falls in a
    line, and it rises again where success falls."""
    teacher_learning_rate: Positive = 5e-4  # Adam's step size in these updates.
    teacher_batch: Count = 1024  # Labelled observations of such an update, split evenly over the taught classes.
    teacher_samples: Count = 500_000  # Labelled observations that each process keeps; the oldest go first.
    critic_first: Whole = 0
    """Environment steps at the start in which the critic alone learns: for a policy that begins with a skill (cloned,
    or of --start-from), which a critic that knows nothing would spoil."""


PRESETS: dict[str, MTPPOConfig] = {
    # Table 47 of the Bi-DexHands appendix; the value loss weight is their loader's default.
    "paper": MTPPOConfig(
        **TABLE_47, epochs=5, clip=0.2, learning_rate=3e-4, desired_kl=0.016, critic_learning_rate=None,
        value_loss_weight=2.0, entropy_weight=0.0,
    ),
    "laptop": MTPPOConfig(),
    # Version 2 of the suites (docs/results/adaptation.md): the goal must be held at the end of longer episodes.
    "v2": MTPPOConfig(gamma=0.96),
    # For Meta-World's multi-task suites: discount, trace and clip are from its authors' MTPPO (metaworld-algorithms).
    # Networks are small, and rollouts have 100 steps instead of 10,000. With 250 steps (ELU, 8 mini-batches) success on
    # MT3 was 24 % after 150 k steps instead of 42 %.
    "metaworld": MTPPOConfig(
        hidden=(256, 256, 128), activation="tanh", init_std=0.8, rollout_steps=100, num_minibatches=4, epochs=5,
        clip=0.2, gamma=0.99, lam=0.97, learning_rate=5e-4, desired_kl=0.02, std_range=(0.1, 1.5),
    ),
}  # fmt: skip

# Table 42, column "Other Tasks". Other values are from Table 47.
_SINGLE = replace(PRESETS["paper"], hidden=(1024, 1024, 512), gamma=0.96)
# Table 50. Other values are from Table 47 (``paper``) or those for hands (``laptop``, with narrower layers).
_TABLE_50: Options = {
    "rollout_steps": 32, "epochs": 5, "num_minibatches": 4, "clip": 0.1, "learning_rate": 3e-4, "gamma": 0.99,
    "lam": 0.95, "init_std": 1.0, "desired_kl": 0.01, "max_grad_norm": 1.0, "entropy_weight": 0.0,
}  # fmt: skip
SINGLE_TASK_PRESETS = PRESETS | {"paper": _SINGLE}
TASK_PRESETS: dict[str, dict[str, MTPPOConfig]] = {
    # Table 42's own columns.
    "LiftUnderarm": {"paper": replace(_SINGLE, rollout_steps=20, epochs=10)},
    "StackBlock": {"paper": replace(_SINGLE, num_minibatches=8, epochs=2, gamma=0.9)},
    "gymnasium/Humanoid-v5": {
        "paper": replace(PRESETS["paper"], hidden=(1024, 1024, 1024), **_TABLE_50),
        "laptop": replace(PRESETS["laptop"], hidden=(256, 256, 256), **_TABLE_50),
    },
}


# The first few episodes say little: up to this number, the missing episodes count as failures.
_EPISODES = 20.0

_DEMONSTRATED = 0xDE30  # tells their draws apart from the learner's, which are the same with and without


class Demonstrations:
    """Transitions to be imitated in addition to reinforcement; some tasks may have none.

    The loss gets a term of behaviour cloning that fades, as in DAPG (Rajeswaran et al. 2018, arXiv 1709.10087, equation
    6). Normalised advantages replace DAPG's weighting by the largest advantage.
    """

    def __init__(self, data: Joined, config: MTPPOConfig, seed: int, device: torch.device):
        self._config = config
        self.fingerprint = data.fingerprint()
        self._obs = data.observations.index_select(0, data.at).to(device)
        self._actions = data.actions.to(device)
        counts = torch.bincount(data.task)
        self._of_task = torch.argsort(data.task, stable=True).to(device)
        self._first = (counts.cumsum(0) - counts)[counts > 0].to(device)
        self._count = counts[counts > 0].to(device)
        self.generator = torch.Generator(device).manual_seed(own_seed(seed) ^ _DEMONSTRATED)

    def weight(self, env_steps: int) -> float:
        """Return the weight of the term after ``env_steps``: it is halved every ``demonstration_half_life``."""
        return self._config.demonstration_weight * 0.5 ** (env_steps / self._config.demonstration_half_life)

    def draw(self) -> tuple[Tensor, Tensor]:
        """Draw raw observations (B, d) and actions (B, a), on average equally often for each task that has some."""
        size = (self._config.demonstration_batch,)
        device = self._obs.device
        task = torch.randint(len(self._count), size, generator=self.generator, device=device)
        # The remainder of so large a number favours no entry by more than 1 in 2^40 / transitions.
        place = torch.randint(2**40, size, generator=self.generator, device=device) % self._count[task]
        chosen = self._of_task[self._first[task] + place]
        return self._obs[chosen], self._actions[chosen]

    def loss(self, policy: GaussianPolicy) -> Tensor:
        """Return the mean of (a - mean)^2 / (2 std^2), summed over actions.

        Standard deviations get no gradient, because only rewards move them.
        """
        raw, actions = self.draw()
        obs = policy.observations(raw)
        with autocast(raw.device, policy.low_precision):
            means = policy.actor(obs)
        return imitation(actions, means.float(), policy.actor.log_std_of(obs).detach())

    def clone(self, policy: GaussianPolicy) -> None:
        """Clone the behaviour before the first rollout: update statistics of observations, then train only the mean."""
        policy.observations.update(self._obs)
        weights = list(policy.actor.parameters())
        adam = torch.optim.Adam(weights, lr=1e-3)
        for _ in range(self._config.demonstration_cloning):
            adam.zero_grad()
            loss = self.loss(policy) / world_size()
            loss.backward()
            sum_gradients(weights, loss.detach()[None])
            adam.step()


def imitation(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Return half the mean squared distance, in standard deviations, of actions (B, a) from means (B, a): a scalar."""
    return 0.5 * ((actions - means) / log_std.exp()).square().sum(-1).mean()


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
        self.adams = AdaptiveAdams(self.policy.actor.parameters(), self.critic.parameters(), config, self.device)
        balances: dict[Balancing, Callable[[], Balance | None]] = {
            "none": lambda: None,  # the losses are summed
            "pcgrad": lambda: GradientBalance(project_conflicting),
            "cagrad": lambda: GradientBalance(partial(conflict_averse, radius=config.cagrad_radius)),
            "famo": lambda: Famo(world.num_tasks, config.famo_rate, config.famo_decay, self.device),
        }
        self.balance = balances[config.gradient_surgery]()
        alone = self.device.type == "cuda" and self.balance is None and world_size() == 1
        if alone:
            self._graphs = GraphCache(dict, lambda _: None, cuda_graph)
        else:
            self._graphs = None
        if sources.demonstrations is not None:
            self._graphs = None  # the weight of demonstrations is no tensor
            self.demonstrations = Demonstrations(sources.demonstrations, config, seed, self.device)
            self.per_process = (*self.per_process, "demonstrated")
        if sources.teachers is not None:
            self.lessons = Lessons(world, self.policy, config.teacher_learning_rate, config.max_grad_norm)
            self.lessons.begin(sources.teachers, config.teacher_samples, config.rollout_steps, config.teacher_batch)
            self.per_process = (*self.per_process, "data")
            self.rollout.ended[-1] = True  # episodes begin with the first step, for teachers too

    def start_from(self, policy: State) -> None:
        """Start as in the base class, with standard deviations clamped to ``std_range``.

        An adaptive step size starts at its minimum, because a KL is known only after a step: the first update of a
        policy trained by DAgger had a KL of 187 with a step size of 3e-4.
        """
        super().start_from(policy)
        self._forget_graphs()
        self._bound_std()
        if self.config.adaptive_learning_rate:
            self.adams.rate.fill_(self.adams.bounds[0])

    @torch.no_grad()
    def _bound_std(self) -> None:
        low, high = (math.log(std) for std in self.config.std_range)
        self.policy.actor.log_std.clamp_(low, high)

    def _forget_graphs(self) -> None:
        if self._graphs is not None:
            self._graphs.forget()

    def _iterate(self) -> dict[str, float]:
        if self.demonstrations is not None and self.config.demonstration_cloning and not self.env_steps:
            self.demonstrations.clone(self.policy)
        self.policy.observations.settled = self._critic_alone()
        return super()._iterate()

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        if self.lessons is not None and self.lessons.data is not None:
            step = self.lessons.data.added % self.config.rollout_steps
            self.lessons.teachers.reset(self.rollout.ended[step - 1])
            self.lessons.label(obs)
        return super()._sample(obs)

    def _imitated(self) -> float:
        if self.demonstrations is None:
            return 0.0
        return self.demonstrations.weight(self.env_steps)

    def _critic_alone(self) -> bool:
        return self.env_steps < self.config.critic_first

    def _optimisers(self) -> Parts:
        return self.adams.parts() | (self.balance.parts() if self.balance is not None else {})

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        cfg = self.config
        actor = self.policy.actor
        critic_alone = self._critic_alone()
        old_log_std = actor.log_std.detach().clone()
        measured = list[Tensor]()
        for first, index, count in self._mini_batches(batch.weights, cfg.epochs, cfg.num_minibatches):
            inputs = *vars(batch.select(index)).values(), count, old_log_std
            work = partial(self._descend, first, critic_alone)
            if self._graphs is None:
                measured.append(work(*inputs))
            else:
                name = f"{len(index)} samples, first {first}, critic alone {critic_alone}"
                measured.append(self._graphs.run(name, work, *inputs).clone())
        names = [*NAMES, *([] if self.balance is None else [self.balance.tag])]
        names += ["Loss/demonstrations"] * bool(self._imitated())
        means = torch.stack(measured).mean(0)
        reported = {**dict(zip(names, means, strict=True)), "Policy/lr": self.adams.rate}
        if self.demonstrations is not None:
            reported["Policy/demonstration_weight"] = means.new_tensor(self._imitated())
        return reported | ({} if self.lessons is None else self._take(self.lessons))

    def _descend(self, first: bool, critic_alone: bool, *inputs: Tensor) -> Tensor:
        """Take one step on a mini-batch's fields, the sum of its weights and the old log standard deviations."""
        *batch, count, old_log_std = inputs
        part = Batch(*batch)
        numbers = self._gradients(part, count, old_log_std)
        cfg = self.config
        self.adams.descend(None if first else numbers[2], cfg.max_grad_norm, cfg.clip_apart, critic_alone)
        self._bound_std()
        if self.balance is not None:
            with torch.no_grad():
                self.balance.learn(lambda: self._above_least(part, count, old_log_std))
        return numbers

    def _take(self, lessons: Lessons) -> dict[str, Tensor]:
        """Learn from teachers in proportion to the failure of each class; do nothing while only the critic learns."""
        assert lessons.data is not None
        lessons.take_moments(self.config.rollout_steps)
        tasks = lessons.data.tasks
        needs = self._needs()
        most = needs[tasks].max()
        if self._critic_alone():
            updates = 0
        else:
            updates = round(self.config.teacher_updates * float(most))
        if updates:
            losses = lessons.learn(updates, self.generator, needs[tasks] / most)
        else:
            losses = {}
        weights = {f"Policy/teacher_weight/{self.world.task_names[task]}": needs[task] for task in tasks.tolist()}
        return losses | weights

    def _needs(self) -> Tensor:
        """Return each class's relative distance from ``teacher_success``, from 1 to 0: (num_tasks,)."""
        _, _, successes, counts = all_sum(self.episodes.sums)
        return (1.0 - successes / counts.clamp_min(_EPISODES) / self.config.teacher_success).clamp_min(0.0)

    def _gradients(self, b: Batch, count: Tensor, old_log_std: Tensor) -> Tensor:
        cfg = self.config
        actor = self.policy.actor
        loss = self._loss(b, count, old_log_std)
        value = (b.weights / count * (self._critic(b.obs, b.task_id) - b.targets).square()).sum()
        rest = cfg.value_loss_weight * value - cfg.entropy_weight * loss.entropy
        numbers = loss.numbers(value)
        imitated = None
        if self.demonstrations is not None and (weight := self._imitated()):
            imitated = self.demonstrations.loss(self.policy) / world_size()
            rest = rest + weight * imitated
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
        return sum_gradients([*actor.parameters(), *self.critic.parameters()], torch.stack(numbers))

    def _loss(self, b: Batch, count: Tensor, old_log_std: Tensor) -> PolicyLoss:
        actor = self.policy.actor
        with autocast(self.device, self.low_precision):
            means = actor(b.obs)
        return policy_loss(
            b.actions, means, actor.log_std_of(b.obs), b.old_means, actor.log_std_of(b.obs, old_log_std),
            b.old_log_probs, b.advantages, weights=b.weights / count, clip=self.config.clip
        )  # fmt: skip

    def _least(self, b: Batch, count: Tensor) -> Tensor:
        """Return the minimum of each sample's surrogate loss (B,): no ratio earns more than the clip allows."""
        return -b.weights / count * (b.advantages + self.config.clip * b.advantages.abs())

    def _above_least(self, b: Batch, count: Tensor, old_log_std: Tensor) -> Tensor:
        loss = self._loss(b, count, old_log_std)
        return self._per_task(-loss.earned - self._least(b, count), b.task_id)

    def _parts(self) -> Parts:
        own = self.demonstrations
        lessons = self.lessons
        if lessons is None:
            parts = {}
        else:
            parts = {"teacher_adam": lessons.adam, "label_stats": lessons.label_stats}
        return super()._parts() | parts | ({} if own is None else {"demonstrated": own.generator})

    def _place(self) -> State:
        own = self.demonstrations
        return super()._place() | ({} if own is None else {"demonstrations": own.fingerprint})

    def state_dict(self) -> State:
        """Return the state as in the base class; the labels copy themselves, because two copies at once may not fit."""
        if self.lessons is None:
            data = None
        else:
            data = self.lessons.data
        return super().state_dict() | ({} if data is None else {"data": data.state_dict()})

    def load_state_dict(self, state: State) -> None:
        """Restore the state as in the base class; begin new episodes if teachers follow an episode from its start."""
        super().load_state_dict(state)
        self._forget_graphs()
        if self.lessons is None or self.lessons.data is None:
            return
        self.lessons.data.load_state_dict(state["data"])
        if self.obs is not None and self.lessons.teachers.follow:
            self.obs, _ = self.world.reset()
            self.rollout.ended[-1] = True

    def _check_size(self, state: State) -> None:
        super()._check_size(state)
        stored = state.get("demonstrations")
        own = self.demonstrations
        if own is not None and stored is not None and stored != own.fingerprint:
            raise BidexError(
                f"{self.name}: the checkpoint's demonstrations are others ({stored['transitions']:,.0f} transitions, "
                f"here {own.fingerprint['transitions']:,.0f}). Resume with the run's own data set."
            )

    def _per_task(self, x: Tensor, task_id: Tensor) -> Tensor:
        return x.new_zeros(self.world.num_tasks).index_add(0, task_id, x)


class PPO(MTPPO):
    """Multi-task PPO (Schulman et al. 2017, arXiv 1707.06347) on a batched world.

    The class is MT-PPO with the presets of a single task (the appendix's B.1).
    """

    presets = SINGLE_TASK_PRESETS
    task_presets = TASK_PRESETS
