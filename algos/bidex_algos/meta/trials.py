"""Trials: a few whole episodes of one task in each row, played with one memory; shared by learners that remember.

Rows' episodes differ in length, and all rows start the next one together: a row whose episode is over waits, its memory
untouched. Waiting is not recorded, so that the transitions of a row follow each other without gaps: slot t holds what
the memory saw at its t-th step.
"""

import torch
from torch import Tensor

from bidex_algos.experience.episodes import EpisodeStatistics
from bidex_algos.experience.rollout import may_look
from bidex_algos.nets.recurrent import Memory, RecurrentPolicy
from bidex_meta.world.contract import VectorWorld


def in_chunks(steps: int, chunk: int | None) -> tuple[int, int]:
    """How a trial is cut.

    Args:
        steps: Steps of the longest trial.
        chunk: Steps of a chunk; None, or no fewer than ``steps``: one chunk, without padding.

    Returns:
        Number of slots, among them one for the last observation, and slots of a chunk, which they are a multiple of.
    """
    size = steps + 1 if chunk is None or chunk >= steps else chunk
    return (steps // size + 1) * size, size


class Trials:
    """One trial of N rows, preallocated on the device and overwritten by each :func:`play`.

    Attributes:
        obs: Raw observations before each step; in the slot after a row's last step, what that step led to; (S, N, d).
        actions: Sampled actions, not clamped, (S, N, a).
        rewards: 0 where not valid, (S, N).
        shown: Whether the policy was shown the reward, bool (S, N).
        valid: False where physics broke: such a transition teaches nothing, bool (S, N).
        ended: Whether it ended an episode, bool (S, N).
        terminated: Whether it ended an episode truly, not by a time limit, bool (S, N).
        left: Steps that the time limit would still have allowed, int64 (S, N).
        lengths: Slots that each row has filled, int64 (N,); what lies beyond is void.
        limits: Most steps of an episode of each row, int64 (N,).

    Args:
        episodes: Episodes in a trial.
        limits: See above.
        observations: Width of the observation.
        actions: Number of actions.
        chunk: Steps of a chunk. There are slots for as many whole chunks as the longest trial needs.
    """

    def __init__(self, episodes: int, limits: Tensor, observations: int, actions: int, chunk: int | None):
        self.episodes, self.limits = episodes, limits
        rows, longest = len(limits), int(limits.max())
        slots, _ = in_chunks(episodes * longest, chunk)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(slots, rows, *shape, dtype=dtype, device=limits.device)

        self.longest = longest
        self.obs, self.actions, self.rewards = zeros(observations), zeros(actions), zeros()
        self.shown, self.valid, self.ended, self.terminated = (zeros(dtype=torch.bool) for _ in range(4))
        self.left = zeros(dtype=torch.int64)
        self.lengths = torch.zeros_like(limits)

    def filled(self, slots: int | None = None) -> Tensor:
        """Which of the first ``slots`` (default: all) slots hold a step, bool (slots, N)."""
        slot = torch.arange(slots or len(self.obs), device=self.lengths.device)
        return slot[:, None] < self.lengths

    def last(self, slots: int) -> Tensor:
        """Which of the first ``slots`` slots hold the last step of a trial, bool (slots, N)."""
        slot = torch.arange(slots, device=self.lengths.device)
        return slot[:, None] == self.lengths - 1

    def previous(self, slots: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the memory was fed beside the observation: last action, last reward, whether it was shown, end.

        Returns:
            Of the first ``slots`` slots: (slots, N, a), then (slots, N) each. The slot after the last step counts as a
            step of the same episode: its value is what the time limit cut off.
        """
        after = [x[: slots - 1] for x in (self.actions, self.rewards, self.shown & self.valid, self.ended)]
        action, reward, known, done = (torch.cat([torch.zeros_like(x[:1]), x]) for x in after)
        return action, reward, known, done & self.filled(slots)

    def discounts(self, slots: int, gamma: float) -> Tensor:
        """Discount of what follows each of the first ``slots`` transitions, (slots, N): gamma within an episode.

        At a time limit the next episode follows at the next step. After a true end the row counts as standing still,
        unrewarded, until its time limit: else a policy that earns little would end its episode to begin anew.
        """
        left = self.left[:slots].masked_fill(~self.terminated[:slots], 0)
        return gamma ** (1.0 + left.float())


@torch.no_grad()
def play(
    world: VectorWorld,
    policy: RecurrentPolicy,
    trials: Trials,
    obs: Tensor,
    blind_share: float,
    generator: torch.Generator,
    statistics: list[list[EpisodeStatistics]],
) -> None:
    """Fills ``trials`` from ``world``, a world in mode DISABLED that has just been reset.

    Args:
        world: The world.
        policy: The policy, which starts without memory.
        trials: Where transitions go.
        obs: What the reset gave, (N, d).
        blind_share: Share of the episodes whose rewards the policy is not shown.
        generator: Of the sampled actions and the blind episodes.
        statistics: For each episode of the trial, who counts it.
    """
    rows, device = torch.arange(world.num_envs, device=world.device), world.device
    memory = policy.fresh_memory(world.num_envs)
    trials.lengths.zero_()
    std = policy.log_std.exp()
    for episode in range(trials.episodes):
        if episode > 0:
            obs, _ = world.reset()
        shown = torch.rand(world.num_envs, generator=generator, device=device) >= blind_share
        playing = torch.ones(world.num_envs, dtype=torch.bool, device=device)
        success, whole = ~playing, playing.clone()
        elapsed, earned = torch.zeros_like(rows), torch.zeros(world.num_envs, device=device)
        for _ in range(trials.longest):
            mean, state = policy.step(obs, memory)
            # Not clamped: the world does that, and the density must be that of what was drawn.
            action = mean + std * torch.randn(mean.shape, generator=generator, device=device)
            next_obs, reward, terminated, truncated, info = world.step(action)
            valid = ~info["unstable"]
            reward = reward.masked_fill(~(valid & playing), 0.0)
            elapsed = elapsed + playing
            left = trials.limits - elapsed
            ended = terminated | truncated | ~valid | (left <= 0)

            # A waiting row writes into its next slot, and so leaves there the observation that its last step led to.
            at = trials.lengths
            trials.obs[at, rows], trials.actions[at, rows], trials.rewards[at, rows] = obs, action, reward
            trials.shown[at, rows], trials.valid[at, rows], trials.ended[at, rows] = shown, valid, ended
            trials.terminated[at, rows], trials.left[at, rows] = terminated, left
            trials.lengths += playing

            memory = memory.replaced(playing, Memory(state, action, reward, shown & valid, ended))
            obs = torch.where(playing[:, None], next_obs, obs)
            earned, whole = earned + reward, whole & (valid | ~playing)
            success = success | (info["success"] & playing)
            playing = playing & ~ended
            if may_look(device) and not playing.any():
                break
        found = {"r": earned, "l": elapsed, "success": success}
        for each in statistics[episode]:
            each.update({"so_far": found, "counted": whole})
    trials.obs[trials.lengths, rows] = obs
