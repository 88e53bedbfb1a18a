"""Teachers' labels and the updates that imitate them: all of DAgger's learning, and an addition to PPO's."""

import math

import torch
from torch import Tensor, nn

from bidex_algos.labelled import Labelled
from bidex_algos.nets.networks import autocast
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.training.distributed import all_sum, pool_moments, sum_gradients, world_size
from bidex_meta.witness.teachers import Teachers
from bidex_meta.world.contract import VectorWorld

# Added to the standard deviation of an action among a class's labels, so that an action that a teacher hardly moves
# does not outweigh all others. It is 1.5 % of an action's range, or about 0.02 rad of a finger joint.
_FLOOR = 0.03

SUCCESS = 0.8  # success in a class's last 100 episodes from which its teacher's labels have no weight
# The first few episodes say little, so up to this number the missing episodes count as failures.
_EPISODES = 20.0


def needs(episodes: EpisodeStatistics) -> Tensor:
    """Return each class's relative distance from ``SUCCESS``, from 1 to 0: (num_tasks,)."""
    _, _, successes, counts = all_sum(episodes.sums)
    return (1.0 - successes / counts.clamp_min(_EPISODES) / SUCCESS).clamp_min(0.0)


class Lessons:
    """Labelled observations of a world, and an optimiser of the mean of ``policy``; standard deviations do not change.

    The error of an action is measured in units of its variance among the labels of its class; all classes have equal
    weight. The newest ``samples`` labels of each process are kept, and at least ``least_steps`` of each environment.
    An update takes ``batch_size`` of them, split evenly over the taught classes. The defaults are those beside PPO.
    """

    def __init__(
        self, world: VectorWorld, policy: GaussianPolicy, teachers: Teachers, least_steps: int,
        learning_rate: float = 5e-4, max_grad_norm: float = 1.0, samples: int = 500_000, batch_size: int = 1024
    ):  # fmt: skip
        self.world = world
        self.policy = policy
        self.max_grad_norm = max_grad_norm
        self.adam = torch.optim.Adam(policy.actor.mean.parameters(), lr=learning_rate, fused=True)
        (actions,) = world.single_action_space.shape
        (observations,) = world.single_observation_space.shape
        self.label_stats = RunningStats((world.num_tasks, actions)).to(world.device)
        rows = teachers.known.nonzero().squeeze(1)
        steps = max(least_steps, samples // len(rows))
        self.teachers = teachers
        self.data = Labelled(steps, rows, world.task_id[rows], observations, actions)
        self.batch_per_task = math.ceil(batch_size / len(self.data.tasks))

    @torch.no_grad()
    def label(self, obs: Tensor) -> Tensor:
        """Label raw observations (N, d) of a step and store the labels: actions (N, a)."""
        labels = self.teachers.eval_action(obs)
        self.data.add(obs, labels)
        return labels

    @torch.no_grad()
    def take_moments(self, steps: int) -> None:
        """Add the labels of the last steps to the statistics of their classes."""
        mean, var, count = self.label_stats.mean.new_zeros(3, *self.label_stats.mean.shape)
        for task, labels in zip(self.data.tasks.tolist(), self.data.of_last(steps), strict=True):
            var[task], mean[task] = torch.var_mean(labels.double(), dim=0, correction=0)
            count[task] = len(labels)
        self.label_stats.merge(*pool_moments(mean, var, count))

    def learn(self, updates: int, generator: torch.Generator, weights: Tensor | None = None) -> dict[str, Tensor]:
        """Take ``updates`` steps down the mean of the classes' losses, weighted (K,); return the unweighted losses."""
        data = self.data
        device = generator.device
        tasks = data.tasks.repeat_interleave(self.batch_per_task)
        unit = self.label_stats.std(_FLOOR).float()[tasks]
        losses = list[Tensor]()
        for places in data.draw(updates, self.batch_per_task, generator):
            obs, labels = data.take(places)
            obs = self.policy.observations(obs)
            with autocast(device, self.policy.low_precision):
                means = self.policy.actor(obs)
            of_class = ((means - labels) / unit).square().mean(1).view(len(data.tasks), -1).mean(1)
            losses.append(self._descend(of_class / world_size(), weights))
        of_class = torch.stack(losses).mean(0)
        names = [f"Loss/imitation/{self.world.task_names[task]}" for task in data.tasks.tolist()]
        return {"Loss/imitation": of_class.mean(), **dict(zip(names, of_class, strict=True))}

    def learn_by_need(
        self, updates: int, generator: torch.Generator, episodes: EpisodeStatistics
    ) -> dict[str, Tensor]:  # fmt: skip
        """Take up to ``updates`` steps, weighted by the classes' :func:`needs`: all where a class never succeeds."""
        tasks = self.data.tasks
        need = needs(episodes)
        most = need[tasks].max()
        steps = round(updates * float(most))
        losses = {}
        if steps:
            losses = self.learn(steps, generator, need[tasks] / most)
        return losses | {f"Policy/teacher_weight/{self.world.task_names[task]}": need[task] for task in tasks.tolist()}

    def _descend(self, of_class: Tensor, weights: Tensor | None) -> Tensor:
        """Take a step on the losses summed over processes; return the classes' losses (K,)."""
        parameters = list(self.policy.actor.mean.parameters())
        self.adam.zero_grad()
        (of_class if weights is None else weights * of_class).mean().backward()
        of_class = sum_gradients(parameters, of_class.detach())
        nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        self.adam.step()
        return of_class
