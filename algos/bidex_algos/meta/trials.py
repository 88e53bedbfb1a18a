"""Trials: a few whole episodes of one task in each environment, played with one memory; episodes begin together.

An environment whose episode is over waits for the others, and its memory does not change. Steps spent waiting are not
recorded, so slot t of a trial holds the t-th step that the memory has seen.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from bidex_algos.advantages import explained_variance, gae, normalise_per_task, task_moments
from bidex_algos.nets.networks import gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.utils import maths
from bidex_meta.world.contract import VectorWorld


def in_chunks(steps: int, chunk: int | None) -> tuple[int, int]:
    """Return the number of slots and the chunk size for a trial of at most ``steps`` steps.

    A slot holds one step, and one slot is added for the last observation. The number of slots is a multiple of the
    chunk size. If ``chunk`` is None, the whole trial is one chunk.
    """
    if chunk is None or chunk >= steps:
        size = steps + 1
    else:
        size = chunk
    return (steps // size + 1) * size, size


class Trials:
    """One trial of N environments, preallocated on the device and overwritten by each :func:`play`.

    The S slots hold the longest possible trial, rounded up to whole chunks. ``limits`` (N,) is the maximum number of
    steps per episode.
    """

    def __init__(self, episodes: int, limits: Tensor, observations: int, actions: int, chunk: int | None):
        self.episodes = episodes
        self.limits = limits
        rows = len(limits)
        longest = int(limits.max())
        slots, _ = in_chunks(episodes * longest, chunk)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(slots, rows, *shape, dtype=dtype, device=limits.device)

        self.longest = longest
        # Per slot: the raw observation before the step (the slot after the last step holds the last observation), the
        # sampled and unclamped action, the reward (0 if physics broke, that is, if the step is not valid), whether the
        # policy saw the reward, whether the episode ended or terminated, and the steps left until the time limit.
        # ``lengths`` (N,) counts the slots that each environment has filled.
        self.obs = zeros(observations)
        self.actions = zeros(actions)
        self.rewards = zeros()
        self.shown, self.valid, self.ended, self.terminated = (zeros(dtype=torch.bool) for _ in range(4))
        self.left = zeros(dtype=torch.int64)
        self.lengths = torch.zeros_like(limits)

    def filled(self, slots: int | None = None) -> Tensor:
        """Return whether each of the first ``slots`` (default: all) slots holds a step, bool (slots, N)."""
        slot = torch.arange(slots or len(self.obs), device=self.lengths.device)
        return slot[:, None] < self.lengths

    def previous(self, slots: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the memory's inputs besides the observation, for the first ``slots`` slots.

        These are the last action (slots, N, a), the last reward, whether the policy saw this reward, and whether an
        episode has just ended, each (slots, N). The slot after the last step of a trial does not count as the start of
        another episode, because its value replaces the rewards that the time limit cut off.
        """
        after = [x[: slots - 1] for x in (self.actions, self.rewards, self.shown & self.valid, self.ended)]
        action, reward, known, done = (torch.cat([torch.zeros_like(x[:1]), x]) for x in after)
        return action, reward, known, done & self.filled(slots)

    def discounts(self, slots: int, gamma: float) -> Tensor:
        """Return the discount factor of the state after each of the first ``slots`` transitions, (slots, N).

        The factor is ``gamma`` for one step. After a termination, all steps that were left until the time limit are
        discounted as well. Otherwise ending an episode early would be rewarded, because the next episode would start
        earlier.
        """
        left = self.left[:slots].masked_fill(~self.terminated[:slots], 0)
        return gamma ** (1.0 + left.float())


class Player(Protocol):
    """Chooses the actions in a trial."""

    def begin(self, shown: Tensor) -> None:
        """Begin an episode in all environments; ``shown`` (N,) marks environments in which the policy sees rewards."""

    def act(self, obs: Tensor, memory: Memory, slot: Tensor) -> tuple[Tensor, Tensor]:
        """Return unclamped actions (N, a) for raw observations (N, d), and the memory's next state (N, memory).

        ``slot`` (N,) is the slot that records the step. For an environment that waits because its episode has ended,
        the next step overwrites this slot.
        """
        ...

    def plays(self) -> Tensor | bool:
        """Return in which environments the policy acts, bool (N,); True for all. Other episodes are not counted."""
        return True

    def earned(self, reward: Tensor, valid: Tensor, slot: Tensor) -> None:
        """Record the step's rewards (N,).

        An environment is not ``valid``, and its reward is 0, if its physics broke or if it waits for the next episode.
        """


class Sampling(Player):
    """Samples actions from the policy's Gaussian."""

    def __init__(self, policy: RecurrentPolicy, generator: torch.Generator):
        self._policy = policy
        self._generator = generator

    def begin(self, shown: Tensor) -> None:
        """Do nothing: sampling does not depend on the episode."""

    def act(self, obs: Tensor, memory: Memory, slot: Tensor) -> tuple[Tensor, Tensor]:
        """Sample actions without clamping: the world clamps, but the density must be that of the sampled action."""
        mean, state = self._policy.step(obs, memory)
        noise = torch.randn(mean.shape, generator=self._generator, device=mean.device)
        return mean + self._policy.log_std.exp() * noise, state

    def earned(self, reward: Tensor, valid: Tensor, slot: Tensor) -> None:
        """Do nothing: sampling does not depend on the rewards."""


@torch.no_grad()
def play(
    world: VectorWorld, policy: RecurrentPolicy, player: Player, trials: Trials, obs: Tensor, blind_share: float,
    generator: torch.Generator, statistics: list[list[EpisodeStatistics]]
) -> None:  # fmt: skip
    """Fill ``trials`` from ``world``, a world in mode DISABLED that has just been reset to ``obs`` (N, d).

    In a fraction ``blind_share`` of the episodes, the policy does not see rewards. ``statistics`` has one list of
    counters for each episode of a trial; the counters are updated when that episode ends.
    """
    rows = torch.arange(world.num_envs, device=world.device)
    device = world.device
    memory = policy.fresh_memory(world.num_envs)
    trials.lengths.zero_()
    for episode in range(trials.episodes):
        if episode > 0:
            obs, _ = world.reset()
        shown = torch.rand(world.num_envs, generator=generator, device=device) >= blind_share
        player.begin(shown)
        playing = torch.ones(world.num_envs, dtype=torch.bool, device=device)
        success = ~playing
        whole = playing.clone()
        elapsed = torch.zeros_like(rows)
        earned = torch.zeros(world.num_envs, device=device)
        for _ in range(trials.longest):
            action, state = player.act(obs, memory, trials.lengths)
            next_obs, reward, terminated, truncated, info = world.step(action)
            valid = ~info["unstable"]
            reward = reward.masked_fill(~(valid & playing), 0.0)
            player.earned(reward, valid & playing, trials.lengths)
            elapsed = elapsed + playing
            left = trials.limits - elapsed
            ended = terminated | truncated | ~valid | (left <= 0)
            # An environment that waits writes into its next slot, which thus holds the observation after its last step.
            at = trials.lengths
            trials.obs[at, rows] = obs
            trials.actions[at, rows] = action
            trials.rewards[at, rows] = reward
            trials.shown[at, rows] = shown
            trials.valid[at, rows] = valid
            trials.ended[at, rows] = ended
            trials.terminated[at, rows] = terminated
            trials.left[at, rows] = left
            trials.lengths += playing
            memory = memory.replaced(playing, Memory(state, action, reward, shown & valid, ended))
            obs = torch.where(playing[:, None], next_obs, obs)
            earned = earned + reward
            whole = whole & (valid | ~playing)
            success = torch.where(playing, info["running"]["success"], success)
            playing = playing & ~ended
            if maths.may_look(device) and not playing.any():
                break
        found = {"r": earned, "l": elapsed, "success": success}
        for each in statistics[episode]:
            each.update({"running": found, "episode_mask": whole & player.plays()})
    trials.obs[trials.lengths, rows] = obs


@dataclass
class Batch:
    """A trial of N environments, prepared for the update.

    Each environment has T slots, which are divided into chunks of C slots. S chunks hold at least one step.
    """

    obs: Tensor  # raw observations (T, N, d)
    actions: Tensor  # sampled actions (T, N, a)
    # These are the memory's inputs besides the observation; see Trials.previous.
    previous: tuple[Tensor, Tensor, Tensor, Tensor]
    old_means: Tensor  # means of the sampling policy (T, N, a)
    old_log_probs: Tensor  # log-density of the actions under the sampling policy (T, N)
    advantages: Tensor  # normalised advantages (T, N)
    targets: Tensor  # the critic's targets: normalised returns (T, N)
    weights: Tensor  # 1, or 0 for slots that teach nothing (T, N)
    actor_states: Tensor  # the actor's memory before each chunk (T / C, N, memory)
    critic_states: Tensor  # the critic's memory before each chunk (T / C, N, memory)
    chunk: Tensor  # position in time, 0 to T / C - 1, of each chunk that holds a step, int64 (S,)
    row: Tensor  # row of each chunk that holds a step, int64 (S,)

    @property
    def size(self) -> int:
        """Return C, the number of steps per chunk."""
        return len(self.weights) // len(self.actor_states)

    def take(self, x: Tensor, chosen: Tensor) -> Tensor:
        """Select B chunks of C steps from a tensor ``x`` (T, N, ...), and return them as (C, B, ...).

        ``chosen``, int64 (B,), are the indices of these chunks among the S chunks that hold a step.
        """
        chunks = x.unflatten(0, (-1, self.size)).transpose(1, 2)
        return chunks[self.chunk[chosen], self.row[chosen]].transpose(0, 1)


def of_task(outputs: Tensor, task_id: Tensor) -> Tensor:
    """Select values (T, B) from a critic's outputs (T, B, heads).

    With several heads, ``task_id`` (B,) selects the head of each column.
    """
    if outputs.shape[-1] == 1:
        return outputs.squeeze(-1)
    return outputs.gather(2, task_id.expand(len(outputs), -1)[..., None]).squeeze(-1)


class Discounting(Protocol):
    """The options that define how a trial is cut into chunks and how its rewards are discounted."""

    @property
    def chunk(self) -> int | None:
        """Return the number of steps over which gradients flow back through the memory; None means the whole trial."""
        ...

    @property
    def gamma(self) -> float:
        """Return the discount per step."""
        ...

    @property
    def lam(self) -> float:
        """Return the trace decay of the advantage estimate."""
        ...


@torch.no_grad()
def make_batch(
    t: Trials, policy: RecurrentPolicy, critic: nn.Module, return_stats: RunningStats, task_id: Tensor,
    config: Discounting
) -> tuple[Batch, Tensor]:  # fmt: skip
    """Pass a trial through the networks, chunk by chunk, starting with empty memories, and estimate advantages.

    Also returns the explained variance per task (num_tasks,). ``return_stats`` is updated with the trial's returns.
    """
    num_tasks = len(return_stats.mean)
    # This is the only host sync: it reads the number of steps of the longest trial.
    slots, size = in_chunks(int(t.lengths.max()), config.chunk)
    previous = t.previous(slots)
    means = []
    values = []
    actor_states = []
    critic_states = []
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
    filled = t.filled(slots)
    last = torch.arange(slots, device=task_id.device)[:, None] == t.lengths - 1
    valid = t.valid[:slots] & filled
    # The value after the trial's last slot is never used.
    next_values = torch.cat([values[1:], values[-1:]])
    # RL² maximises the discounted reward of the whole trial (Duan et al. 2016, section 2.2). The end of an episode
    # therefore does not end the trial: the next episode continues with the same memory.
    advantages = gae(
        t.rewards[:slots], values, next_values, terminated=t.terminated[:slots] & last, ended=last,
        gamma=t.discounts(slots, config.gamma), lam=config.lam, valid=valid
    )  # fmt: skip
    returns = advantages + values
    explained = explained_variance(values, returns, task_id, num_tasks, valid)
    return_stats.merge(*task_moments(returns, task_id, num_tasks, valid))
    actions = t.actions[:slots]
    chunk, row = filled[::size].nonzero(as_tuple=True)
    batch = Batch(
        obs=t.obs[:slots], actions=actions, previous=previous, old_means=old_means,
        old_log_probs=gaussian_log_prob(actions, old_means, policy.log_std),
        advantages=normalise_per_task(advantages, task_id, num_tasks, valid),
        targets=return_stats.normalise(returns, task_id), weights=valid.float(), actor_states=torch.stack(actor_states),
        critic_states=torch.stack(critic_states), chunk=chunk, row=row
    )  # fmt: skip
    return batch, explained
