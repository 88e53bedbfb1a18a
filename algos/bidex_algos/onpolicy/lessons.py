"""Teachers' labels and updates that imitate these labels; used by DAgger, and by PPO in addition to its own updates."""

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

SUCCESS = 0.8  # success rate over a class's last 100 episodes at which PPO stops learning from the class's teacher
# The first few episodes say little: if there are fewer than this number, the missing episodes count as failures.
_EPISODES = 20.0


def needs(episodes: EpisodeStatistics) -> Tensor:
    """Return how much each class needs its teacher, (num_tasks,).

    The need falls from 1 for a class without any success to 0 at a success rate of ``SUCCESS``.
    """
    _, _, successes, counts = all_sum(episodes.sums)
    return (1.0 - successes / counts.clamp_min(_EPISODES) / SUCCESS).clamp_min(0.0)


class Lessons:
    """Labelled observations of a world, and an optimiser of the mean of ``policy``; standard deviations do not change.

    The squared error of each entry of an action is divided by the variance of this entry among the labels of the class;
    all classes have equal weight. The newest ``samples`` labels of each process are kept, and at least ``least_steps``
    labels of each environment. An update uses ``batch_size`` labels, split evenly over the classes with a teacher. The
    default values are for PPO.
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
        """Label raw observations (N, d) with the teachers' actions, store both, and return the labels (N, a)."""
        labels = self.teachers.eval_action(obs)
        self.data.add(obs, labels)
        return labels

    @torch.no_grad()
    def take_moments(self, steps: int) -> None:
        """Add the labels of the newest ``steps`` vector steps to the statistics of their classes."""
        mean, var, count = self.label_stats.mean.new_zeros(3, *self.label_stats.mean.shape)
        for task, labels in zip(self.data.tasks.tolist(), self.data.of_last(steps), strict=True):
            var[task], mean[task] = torch.var_mean(labels.double(), dim=0, correction=0)
            count[task] = len(labels)
        self.label_stats.merge(*pool_moments(mean, var, count))

    def learn(self, updates: int, generator: torch.Generator, weights: Tensor | None = None) -> dict[str, Tensor]:
        """Take ``updates`` gradient steps on the mean of the losses of the K classes with a teacher.

        The losses are multiplied by ``weights`` (K,), if given. Returns the unweighted losses to be logged.
        """
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
        """Take steps as in :meth:`learn`, with losses weighted by the classes' :func:`needs`.

        The number of steps is ``updates`` times the largest need, so all of them are taken if a class never succeeds.
        """
        tasks = self.data.tasks
        need = needs(episodes)
        most = need[tasks].max()
        steps = round(updates * float(most))
        losses = {}
        if steps:
            losses = self.learn(steps, generator, need[tasks] / most)
        return losses | {f"Policy/teacher_weight/{self.world.task_names[task]}": need[task] for task in tasks.tolist()}

    def _descend(self, of_class: Tensor, weights: Tensor | None) -> Tensor:
        """Take one step on the classes' losses (K,), summed over processes; return the summed losses, unweighted."""
        parameters = list(self.policy.actor.mean.parameters())
        self.adam.zero_grad()
        (of_class if weights is None else weights * of_class).mean().backward()
        of_class = sum_gradients(parameters, of_class.detach())
        nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        self.adam.step()
        return of_class
