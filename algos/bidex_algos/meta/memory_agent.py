"""The agent of a policy that adapts through its memory of a trial (RL², in-context learning)."""

from dataclasses import replace

import torch
from torch import Tensor

from bidex_algos.nets.recurrent import Memory, RecurrentPolicy
from bidex_meta.agents import Timestep


class MemoryAgent:
    """An adapting agent (``bidex_meta.agents``) of a policy with a memory; ``seed`` seeds its exploration.

    Adaptation episodes write the memory of their environment. Each evaluation episode starts from a copy of this
    memory, so all evaluation episodes follow the same adaptation episodes. No weight changes.
    """

    def __init__(self, policy: RecurrentPolicy, seed: int = 0):
        self.policy = policy
        self.device = policy.log_std.device
        self.noise = torch.Generator(self.device).manual_seed(seed)
        self.init()

    def assign(self, task_of_row: Tensor | None) -> None:
        """Do nothing: each environment learns from its own episodes; environments of one task share no memory."""

    def init(self) -> None:
        """Reset every memory to its state at the start of a trial."""
        self._learned: Memory | None = None
        self._playing: Memory | None = None
        self._next_state: Tensor | None = None
        self._wait(0)

    def reset(self, env_mask: Tensor) -> None:
        """Begin new episodes in the environments that ``env_mask`` (N,) marks.

        The memory of each of these environments is marked: the previous episode has ended. The next evaluation episode
        starts from a new copy of this memory.
        """
        learned = self._memory(self._learned, len(env_mask))
        self._over = ~env_mask
        self._learned = replace(learned, done=learned.done | (env_mask & self._begun))
        self._playing = self._memory(self._playing, len(env_mask)).replaced(env_mask, self._learned)

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return sampled actions (N, a) in [-1, 1] for raw observations (N, d), and mean and std of the Gaussian."""
        self._learned = self._memory(self._learned, len(obs))
        self._drawn = self.policy.drawn(self._drawn, len(obs), self.noise)
        mean, self._next_state = self.policy.step(obs, self._learned, self._drawn)
        std = self.policy.log_std.detach().exp().expand_as(mean)
        noise = torch.randn(mean.shape, generator=self.noise, device=mean.device)
        return (mean + std * noise).clamp(-1.0, 1.0), {"mean": mean, "std": std}

    def step(self, timestep: Timestep) -> None:
        """Store one transition of every environment, except environments that wait for ``reset`` after an episode."""
        if self._learned is None or self._next_state is None:
            return
        valid = timestep.valid_mask
        ended = timestep.terminated | timestep.truncated
        moved = valid | ~self._over  # a caller may reset some environments while others play on
        after = Memory(self._next_state, timestep.action, timestep.reward.masked_fill(~valid, 0.0), valid, ended)
        self._learned = self._learned.replaced(moved, after)
        self._begun = self._begun | moved
        self._over = (self._over & ~moved) | ended
        self._next_state = None

    def adapt(self) -> None:
        """Do nothing: the memory has already learned in :meth:`step`."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return mean actions (N, a) in [-1, 1] for raw observations (N, d).

        The memory continues within the episode. The reward in its input is marked as unknown, as in training
        (``blind_share``), unless :meth:`observe` has passed the reward of the last step.
        """
        memory = self._memory(self._playing, len(obs))
        mean, state = self.policy.step(obs, memory)
        action = mean.clamp(-1.0, 1.0)
        no = torch.zeros_like(memory.done)
        self._playing = Memory(state, action, torch.zeros_like(memory.reward), no, no)
        return action

    def observe(self, timestep: Timestep) -> None:
        """Write the reward of the last step into the memory of each evaluation episode."""
        if self._playing is None:
            return
        known = timestep.valid_mask
        reward = timestep.reward.masked_fill(~known, 0.0)
        self._playing = replace(self._playing, reward=reward, known=known)

    def _memory(self, memory: Memory | None, rows: int) -> Memory:
        if memory is not None and len(memory.state) == rows:
            return memory
        if self._learned is None or len(self._learned.state) != rows:
            self._wait(rows)
        return self.policy.fresh_memory(rows)

    def _wait(self, rows: int) -> None:
        self._drawn: Tensor | None = None
        self._begun = torch.zeros(rows, dtype=torch.bool, device=self.device)
        self._over = ~self._begun
