"""DAgger: the student plays, its teachers say what they would do in the states that it comes to, and it learns that."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bidex_algos.imitation.labelled import Labelled
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import NetworkConfig, network_bytes
from bidex_algos.nets.networks import Activation, Autocast, Layers, autocast
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, pool_moments, sum_gradients, world_size
from bidex_meta.train.learner import Parts, State
from bidex_meta.utils.validation import Count, NonNegative, Positive, Whole
from bidex_meta.witness.teachers import Teachers
from bidex_meta.world.contract import VectorWorld

# Added to the deviation of an action of a class's labels: entries that a teacher hardly moves must not outweigh all
# others. It is 1.5 % of an action's range, and of a finger joint about 0.02 rad.
_FLOOR = 0.03


@dataclass(frozen=True)
class DAggerConfig(NetworkConfig):
    """Everything that can be set about DAgger; the defaults are the preset ``laptop``."""

    hidden: Layers = (512, 512)  # Widths of the hidden layers.
    activation: Activation = "elu"  # Non-linearity of the hidden layers.
    init_std: Positive = 0.2
    """Standard deviation of the actions for learners that start from the policy; DAgger plays its mean."""
    rollout_steps: Count = 8  # Steps taken in every environment between two lots of updates.
    updates_per_iteration: Count = 50  # Updates after each rollout.
    batch_size: Count = 1024  # Labelled observations of an update, split evenly over the classes with a teacher.
    samples: Count = 1_500_000  # Labelled observations that each process keeps; the oldest go first.
    learning_rate: Positive = 5e-4  # Adam's step size.
    max_grad_norm: Positive = 1.0  # Gradients longer than this are shortened to it.
    teacher_steps: Whole = 500_000
    """Environment steps over which the share of episodes that the teacher plays falls from 1 to 0. Drawn for each
    episode; 0: the student plays all."""
    noise_std: NonNegative = 0.0  # Standard deviation of noise on the actions that are played.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    normalise_per_task: bool = False  # By statistics of each task apart; the world must show the task's one-hot.
    autocast: Autocast = "auto"  # Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """As in the base."""
        return self.samples * width + network_bytes(self.hidden, width, 1)


PRESETS: dict[str, DAggerConfig] = {"laptop": DAggerConfig()}


class DAgger(Learner):
    """Data set aggregation (Ross et al. 2011, arXiv 1011.0686) from policies and scripts, on a batched world.

    The error of an action counts in units of its variance among the labels of its class, and all classes alike. With
    teachers that follow an episode from its start (scripts) a resumed run begins new episodes: it is no longer equal
    to an unbroken one bit for bit.
    """

    name, remedy = "dagger", "lower learning_rate"
    config_type, presets = DAggerConfig, PRESETS
    taught, discounts_by_class = True, True
    per_process = ("generator", "episodes", "data", "obs", "teacher_plays")
    going_on = ("obs", "teacher_plays", *Learner.going_on)
    config: DAggerConfig
    policy: GaussianPolicy
    policy_of = staticmethod(gaussian_policy)
    teachers: Teachers
    data: Labelled | None = None

    def __init__(self, world: VectorWorld, config: DAggerConfig, seed: int):
        super().__init__(world, config, seed)
        self.low_precision, self.obs = self.policy.low_precision, None
        self.teacher_plays = torch.zeros(world.num_envs, dtype=torch.bool, device=self.device)
        self.adam = torch.optim.Adam(self.policy.actor.mean.parameters(), lr=config.learning_rate, fused=True)
        self.label_stats = RunningStats((world.num_tasks, self.shape.actions)).to(self.device)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    def learn_from_teachers(self, teachers: Teachers) -> None:
        """Takes who labels; before the first iteration and before a checkpoint is loaded."""
        self.teachers = teachers
        rows = teachers.known.nonzero().squeeze(1)
        steps = max(self.config.rollout_steps, self.config.samples // len(rows))
        self.data = Labelled(steps, rows, self.world.task_id[rows], self.shape.observations, self.shape.actions)
        self.batch_per_task = math.ceil(self.config.batch_size / len(self.data.tasks))

    def _iterate(self) -> dict[str, float]:
        if self.data is None:
            raise BidexError(f"{self.name}: has nobody to learn from. Call learn_from_teachers first.")
        share, unstable = self._teachers_share(), torch.zeros((), dtype=torch.int64, device=self.device)
        with self._collecting():
            if self.obs is None:
                self._begin_all(self._first_observations(), share)
            for _ in range(self.config.rollout_steps):
                unstable += self._step(share)
        self._take_moments()
        losses = self._learn(self.data)
        self.env_steps += self.config.rollout_steps * self.world.num_envs * world_size()
        return self.episodes.metrics() | as_numbers({"Train/unstable": all_sum(unstable), **losses}) | self._played()

    def _teachers_share(self) -> float:
        """Of the episodes that begin now: those that the teacher plays."""
        steps = self.config.teacher_steps
        return max(0.0, 1.0 - self.env_steps / steps) if steps else 0.0

    def _begin_all(self, obs: Tensor, share: float) -> None:
        everyone = torch.ones_like(self.teacher_plays)
        self.obs = obs
        self._begin(everyone, share)

    def _begin(self, ended: Tensor, share: float) -> None:
        """New episodes in the rows of a mask (N,): who plays them, and the teachers begin anew."""
        drawn = torch.rand(ended.shape, generator=self.generator, device=self.device) < share
        self.teacher_plays = torch.where(ended, drawn & self.teachers.known, self.teacher_plays)
        self.teachers.reset(ended)

    @torch.no_grad()
    def _step(self, share: float) -> Tensor:
        assert self.obs is not None and self.data is not None
        labels = self.teachers.eval_action(self.obs)
        self.data.add(self.obs, labels)
        actions = torch.where(self.teacher_plays[:, None], labels, self.policy.eval_action(self.obs))
        if self.config.noise_std:
            noise = torch.randn(actions.shape, generator=self.generator, device=self.device)
            actions = actions + self.config.noise_std * noise
        self.obs, _, terminated, truncated, info = self.world.step(actions)
        self._begin(terminated | truncated, share)
        self.policy.observations.update(self.obs)
        self.episodes.update(info)
        return info["unstable"].sum()

    @torch.no_grad()
    def _take_moments(self) -> None:
        """Takes the labels of the rollout into the statistics of their classes."""
        assert self.data is not None
        mean, var, count = torch.zeros(3, *self.label_stats.mean.shape, dtype=torch.float64, device=self.device)
        for task, labels in zip(self.data.tasks.tolist(), self.data.of_last(self.config.rollout_steps), strict=True):
            var[task], mean[task] = torch.var_mean(labels.double(), dim=0, correction=0)
            count[task] = len(labels)
        self.label_stats.merge(*pool_moments(mean, var, count))

    def _learn(self, data: Labelled) -> dict[str, Tensor]:
        tasks, updates = data.tasks.repeat_interleave(self.batch_per_task), self.config.updates_per_iteration
        unit, losses = self.label_stats.std(_FLOOR).float()[tasks], list[Tensor]()
        for places in data.draw(updates, self.batch_per_task, self.generator):
            obs, labels = data.take(places)
            obs = self.policy.observations(obs)
            with autocast(self.device, self.low_precision):
                means = self.policy.actor(obs)
            of_class = ((means - labels) / unit).square().mean(1).view(len(data.tasks), -1).mean(1)
            losses.append(self._descend(of_class / world_size()))
        of_class = torch.stack(losses).mean(0)
        names = [f"Loss/imitation/{self.world.task_names[task]}" for task in data.tasks.tolist()]
        return {"Loss/imitation": of_class.mean(), **dict(zip(names, of_class, strict=True))}

    def _descend(self, of_class: Tensor) -> Tensor:
        """A step down the mean of the classes' losses, summed over processes; these losses (K,)."""
        weights = list(self.policy.actor.mean.parameters())
        self.adam.zero_grad()
        of_class.mean().backward()
        of_class = sum_gradients(weights, of_class.detach())
        nn.utils.clip_grad_norm_(weights, self.config.max_grad_norm)
        self.adam.step()
        return of_class

    def _played(self) -> dict[str, float]:
        share = self.teacher_plays.float().mean()
        return {"Policy/teacher_share": float(all_sum(share) / world_size())}

    def _parts(self) -> Parts:
        statistics = {"label_stats": self.label_stats, "episodes": self.episodes}
        return {"adam": self.adam, **statistics, "generator": self.generator}

    def _check_size(self, state: State) -> None:
        if state["obs"] is not None:
            shapes = tuple(state["obs"].shape), (self.world.num_envs, self.shape.observations)
            self._expect("(num_envs, observations) = ", *shapes)

    def state_dict(self) -> State:
        """As in the base; the data set makes its own copy, since two of it at once may not fit."""
        return super().state_dict() | {"data": self.data and self.data.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restores what :meth:`state_dict` gave; a ``BidexError`` where world or data set had another size."""
        super().load_state_dict(state)
        if self.data is None:
            return
        self.data.load_state_dict(state["data"])
        if self.obs is not None and self.teachers.follow:
            obs, _ = self.world.reset()  # no teacher knows the half of an episode that it has not seen
            self._begin_all(obs, self._teachers_share())
