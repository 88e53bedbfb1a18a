"""A trial cut into chunks, which gradients flow back through: the batch of a learner that remembers."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.experience.advantages import explained_variance, gae, normalise_per_task, task_moments
from bidex_algos.meta.rl2_config import RL2Config
from bidex_algos.meta.trials import Trials, in_chunks
from bidex_algos.nets.networks import gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import RecurrentNet, RecurrentPolicy


@dataclass
class Batch:
    """A trial made ready for the update: T slots (a multiple of the chunk C) of N rows, and its S chunks."""

    obs: Tensor
    """Raw observations (T, N, d)."""
    actions: Tensor
    """Sampled actions (T, N, a)."""
    previous: tuple[Tensor, Tensor, Tensor, Tensor]
    """What the memory is fed beside the observation; see ``Trials.previous``."""
    old_means: Tensor
    """Means of the sampling policy (T, N, a)."""
    old_log_probs: Tensor
    """Log-density of the actions under it (T, N)."""
    advantages: Tensor
    """Normalised advantages (T, N)."""
    targets: Tensor
    """What the critic shall predict, in its own units (T, N)."""
    weights: Tensor
    """1, or 0 for slots that teach nothing (T, N)."""
    actor_states: Tensor
    """The actor's memory before each chunk (T / C, N, memory)."""
    critic_states: Tensor
    """The critic's (T / C, N, memory)."""
    chunk: Tensor
    """Number of each chunk that holds a step, int64 (S,)."""
    row: Tensor
    """Its row, int64 (S,)."""

    @property
    def size(self) -> int:
        """Steps of a chunk, C."""
        return len(self.weights) // len(self.actor_states)

    def chunk_weights(self) -> Tensor:
        """Sum of the weights of each chunk (S,)."""
        return self.weights.unflatten(0, (-1, self.size)).sum(1)[self.chunk, self.row]

    def take(self, x: Tensor, chosen: Tensor) -> Tensor:
        """The chosen chunks, int64 (B,), of a tensor (T, N, ...): (C, B, ...)."""
        chunks = x.unflatten(0, (-1, self.size)).transpose(1, 2)
        return chunks[self.chunk[chosen], self.row[chosen]].transpose(0, 1)


def of_task(outputs: Tensor, task_id: Tensor) -> Tensor:
    """A critic's outputs (T, B, heads) as one value (T, B): the only one, or that of each row's task (B,)."""
    if outputs.shape[-1] == 1:
        return outputs.squeeze(-1)
    return outputs.gather(2, task_id.expand(len(outputs), -1)[..., None]).squeeze(-1)


@torch.no_grad()
def make_batch(
    t: Trials,
    policy: RecurrentPolicy,
    critic: RecurrentNet,
    return_stats: RunningStats,
    task_id: Tensor,
    config: RL2Config,
) -> tuple[Batch, Tensor]:
    """Passes a trial through the networks, chunk by chunk from empty memories, and estimates advantages.

    Args:
        t: The trial.
        policy: The policy that played it.
        critic: Sees what the policy sees; speaks in units of its task's running mean and deviation of returns.
        return_stats: These (num_tasks,); they take in the trial's returns.
        task_id: Task of each row, int64 (N,).
        config: Chunk, discount and trace.

    Returns:
        The batch and the explained variance per task (num_tasks,).
    """
    num_tasks = len(return_stats.mean)
    # The only wait for the device: how many steps the longest trial has.
    slots, size = in_chunks(int(t.lengths.max()), config.chunk)
    previous = t.previous(slots)
    means, values = [], []
    actor_states, critic_states = [], []
    actor_state = critic_state = policy.fresh_memory(len(task_id)).state
    for begin in range(0, slots, size):
        part = slice(begin, begin + size)
        x = policy.see(t.obs[part], *(p[part] for p in previous))
        actor_states.append(actor_state)
        critic_states.append(critic_state)
        mean, actor_state = policy.actor(x, actor_state)
        value, critic_state = critic(x, critic_state)
        means.append(mean)
        values.append(of_task(value, task_id))
    old_means = torch.cat(means)

    values = return_stats.restore(torch.cat(values), task_id)
    filled, last = t.filled(slots), t.last(slots)
    valid = t.valid[:slots] & filled
    # What follows the trial's last slot is never asked for.
    next_values = torch.cat([values[1:], values[-1:]])
    # The end of an episode is none of the trial: the next one follows, and the memory with it.
    advantages = gae(
        t.rewards[:slots],
        values,
        next_values,
        terminated=t.terminated[:slots] & last,
        ended=last,
        gamma=t.discounts(slots, config.gamma),
        lam=config.lam,
        valid=valid,
    )
    returns = advantages + values
    explained = explained_variance(values, returns, task_id, num_tasks, valid)
    return_stats.merge(*task_moments(returns, task_id, num_tasks, valid))
    actions = t.actions[:slots]
    chunk, row = filled[::size].nonzero(as_tuple=True)
    batch = Batch(
        obs=t.obs[:slots],
        actions=actions,
        previous=previous,
        old_means=old_means,
        old_log_probs=gaussian_log_prob(actions, old_means, policy.log_std),
        advantages=normalise_per_task(advantages, task_id, num_tasks, valid),
        targets=return_stats.normalise(returns, task_id),
        weights=valid.float(),
        actor_states=torch.stack(actor_states),
        critic_states=torch.stack(critic_states),
        chunk=chunk,
        row=row,
    )
    return batch, explained
