"""DAgger: the student acts, its teachers label the states that it visits, and it learns to imitate these labels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.learner import Learner, as_numbers, decayed
from bidex_algos.nets.architecture import NetworkConfig, network_bytes
from bidex_algos.nets.networks import Activation, Autocast, Layers
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy
from bidex_algos.onpolicy.lessons import Lessons
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import NO_SOURCES, Capability, Parts, Sources, State
from bidex_meta.utils.validation import Count, NonNegative, Positive, Whole
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class DAggerConfig(NetworkConfig):
    """All options of DAgger; the defaults are the preset ``laptop``."""

    hidden: Layers = (512, 512)  # Widths of the hidden layers.
    activation: Activation = "elu"  # Activation function of the hidden layers.
    init_std: Positive = 0.2
    """Standard deviation of the actions for learners that start from this policy. DAgger itself acts with the mean."""
    rollout_steps: Count = 8  # Steps in every environment before each series of updates.
    updates_per_iteration: Count = 50  # Updates after each rollout.
    batch_size: Count = 1024  # Labelled observations per update, split evenly over the classes with a teacher.
    samples: Count = 1_500_000  # Labelled observations that each process keeps; the oldest are overwritten first.
    learning_rate: Positive = 5e-4  # Adam's step size.
    decay_steps: Whole = 0
    """Environment steps over which the step size falls linearly to a twentieth of learning_rate; 0: it is constant."""
    max_grad_norm: Positive = 1.0  # Gradients are clipped to this norm.
    teacher_steps: Whole = 500_000
    """Environment steps over which the share of episodes in which the teacher acts falls from 1 to 0. Teacher or
    student is drawn for each episode. 0: the student acts in all episodes."""
    noise_std: NonNegative = 0.0  # Standard deviation of the noise that is added to all actions.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot is not changed."""
    normalise_per_task: bool = False  # Use separate statistics for each task; the world must show the task's one-hot.
    autocast: Autocast = "auto"  # Use bfloat16 in hidden layers; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        return self.samples * width + network_bytes(self.hidden, width, 1)  # width counts two observations

    def bytes_stored(self, num_envs: int, width: int) -> int:
        """Estimate the bytes of all labelled observations in float16, with ``width`` numbers each."""
        return 2 * self.samples * width


PRESETS: dict[str, DAggerConfig] = {"laptop": DAggerConfig()}


class DAgger(Learner):
    """Data set aggregation (Ross et al. 2011, arXiv 1011.0686) with policies and scripts as teachers.

    A scripted teacher must see an episode from its start. With such teachers a resumed run therefore begins new
    episodes and is not bitwise equal to an uninterrupted run.
    """

    name = "dagger"
    remedy = "lower learning_rate"
    config_type = DAggerConfig
    presets = PRESETS
    capabilities = frozenset({Capability.TAUGHT, Capability.DISCOUNTS_BY_CLASS})
    per_process = ("generator", "episodes", "data", "obs", "teacher_plays")
    going_on = ("obs", "teacher_plays", *Learner.going_on)
    config: DAggerConfig
    policy: GaussianPolicy
    policy_of = staticmethod(gaussian_policy)

    def __init__(self, world: VectorWorld, config: DAggerConfig, seed: int, sources: Sources = NO_SOURCES):
        sources.check(self.name, "teachers", needed="teachers")
        super().__init__(world, config, seed)
        self.low_precision = self.policy.low_precision
        self.obs = None
        self.teacher_plays = torch.zeros(world.num_envs, dtype=torch.bool, device=self.device)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)
        assert sources.teachers is not None
        self.lessons = Lessons(
            world, self.policy, sources.teachers, config.rollout_steps, config.learning_rate, config.max_grad_norm,
            config.samples, config.batch_size
        )  # fmt: skip

    def _iterate(self) -> dict[str, float]:
        share = self._teachers_share()
        unstable = torch.zeros((), dtype=torch.int64, device=self.device)
        with self._collecting():
            if self.obs is None:
                self._begin_all(self._first_observations(), share)
            for _ in range(self.config.rollout_steps):
                unstable += self._step(share)
        self.lessons.take_moments(self.config.rollout_steps)
        cfg = self.config
        self.lessons.adam.param_groups[0]["lr"] = decayed(cfg.learning_rate, self.env_steps, cfg.decay_steps)
        losses = self.lessons.learn(cfg.updates_per_iteration, self.generator)
        self.env_steps += self.config.rollout_steps * self.world.num_envs * world_size()
        return self.episodes.metrics() | as_numbers({"Train/unstable": all_sum(unstable), **losses}) | self._played()

    def _teachers_share(self) -> float:
        """Return the probability that the teacher acts in an episode that begins now."""
        steps = self.config.teacher_steps
        if steps:
            return max(0.0, 1.0 - self.env_steps / steps)
        return 0.0

    def _begin_all(self, obs: Tensor, share: float) -> None:
        everyone = torch.ones_like(self.teacher_plays)
        self.obs = obs
        self._begin(everyone, share)

    def _begin(self, ended: Tensor, share: float) -> None:
        """Begin new episodes in the environments that the mask ``ended`` (N,) marks.

        Draw for each of these episodes whether the teacher acts in it, with probability ``share``, and reset the
        teachers.
        """
        drawn = torch.rand(ended.shape, generator=self.generator, device=self.device) < share
        self.teacher_plays = torch.where(ended, drawn & self.lessons.teachers.known, self.teacher_plays)
        self.lessons.teachers.reset(ended)

    @torch.no_grad()
    def _step(self, share: float) -> Tensor:
        assert self.obs is not None
        labels = self.lessons.label(self.obs)
        actions = torch.where(self.teacher_plays[:, None], labels, self.policy.eval_action(self.obs))
        if self.config.noise_std:
            noise = torch.randn(actions.shape, generator=self.generator, device=self.device)
            actions = actions + self.config.noise_std * noise
        self.obs, _, terminated, truncated, info = self.world.step(actions)
        self.episodes.update({**info, "episode_mask": info["episode_mask"] & ~self.teacher_plays})
        self._begin(terminated | truncated, share)
        self.policy.observations.update(self.obs)
        return info["unstable"].sum()

    def _played(self) -> dict[str, float]:
        share = self.teacher_plays.float().mean()
        return {"Policy/teacher_share": float(all_sum(share) / world_size())}

    def _parts(self) -> Parts:
        statistics = {"label_stats": self.lessons.label_stats, "episodes": self.episodes}
        return {"adam": self.lessons.adam, **statistics, "generator": self.generator}

    def _check_size(self, state: State) -> None:
        if state["obs"] is not None:
            shapes = tuple(state["obs"].shape), (self.world.num_envs, self.shape.observations)
            self._expect("(num_envs, observations) = ", *shapes)

    def state_dict(self) -> State:
        """Return the base class's state and, in addition, a copy of the data set.

        The data set makes this copy itself. If the base class saved the data set, it would make a second copy, and two
        copies may not fit in memory.
        """
        return super().state_dict() | {"data": self.lessons.data.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if the world's or data set's size differs."""
        super().load_state_dict(state)
        self.lessons.data.load_state_dict(state["data"])
        if self.obs is not None and self.lessons.teachers.follow:
            obs, _ = self.world.reset()  # teachers have not seen the first part of a running episode
            self._begin_all(obs, self._teachers_share())
