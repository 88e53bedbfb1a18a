"""A rollout of transitions of all environments, and the loop that collects it; shared by the on-policy learners."""

from collections.abc import Callable

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_sum
from bidex_meta.utils import maths
from bidex_meta.world.contract import Info, VectorWorld


class EpisodeStatistics:
    """Decaying sums of return, length and success over about the last ``window`` finished episodes of each task.

    Each process has its own sums. Few episodes end in one rollout, and often none of a task with long episodes, so the
    sums cover several rollouts. ``task_id`` is the task of each environment, int64 (N,).
    """

    def __init__(self, task_id: Tensor, task_names: list[str], window: float = 100.0):
        self.task_id = task_id
        self.task_names = task_names
        self.window = window
        # The rows are return, length, success and count.
        self.sums = torch.zeros(4, len(task_names), device=task_id.device)

    def update(self, info: Info) -> None:
        """Add the episodes that ended in this step according to ``info["episode_mask"]``."""
        episode = info["running"]
        ended = info["episode_mask"]
        values = torch.stack([episode["r"].float(), episode["l"].float(), episode["success"].float(), ended.float()])
        new = torch.zeros_like(self.sums).index_add_(1, self.task_id, values.masked_fill(~ended, 0.0))
        self.sums = self.sums * (1.0 - 1.0 / self.window) ** new[3] + new

    def metrics(self) -> dict[str, float]:
        """Return the means of each task that has finished an episode, over all processes.

        Means over tasks are added once every task has finished an episode; earlier means would only cover tasks with
        short episodes.
        """
        returns, lengths, successes, counts = all_sum(self.sums).tolist()
        seen = [i for i, count in enumerate(counts) if count > 0]
        out: dict[str, float] = {}
        for i in seen:
            out[f"Train/return/{self.task_names[i]}"] = returns[i] / counts[i]
            out[f"Train/success/{self.task_names[i]}"] = successes[i] / counts[i]
        if len(seen) == len(self.task_names):
            out["Train/mean_return"] = sum(returns[i] / counts[i] for i in seen) / len(seen)
            out["Train/success_rate"] = sum(successes[i] / counts[i] for i in seen) / len(seen)
            out["Train/mean_episode_length"] = sum(lengths[i] / counts[i] for i in seen) / len(seen)
        return out

    def state_dict(self) -> dict[str, Tensor]:
        """Return a copy of the sums, for a checkpoint."""
        return {"sums": self.sums.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.sums.copy_(state["sums"])


Sampler = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Maps raw observations (N, d) to a sampled action and the mean action, both (N, a) and not clamped."""

FinalValue = Callable[[Tensor, Tensor], Tensor]
"""Maps raw observations (n, d) and task ids (n,) to values in units of reward: (n,) or, if several, (n, critics)."""


class Rollout:
    """Transitions of T steps in N environments, preallocated and overwritten by each :func:`collect_rollout`."""

    def __init__(
        self, steps: int, num_envs: int, observations: int, actions: int, device: torch.device, critics: int = 1
    ):
        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*shape, dtype=dtype, device=device)

        self.steps = steps
        self.obs = zeros(steps, num_envs, observations)  # raw, before each step
        self.actions = zeros(steps, num_envs, actions)  # sampled, not clamped
        self.means = zeros(steps, num_envs, actions)  # mean actions of the sampling policy
        self.rewards = zeros(steps, num_envs)  # 0 if not valid
        self.terminated = zeros(steps, num_envs, dtype=torch.bool)  # the episode came to a true end
        self.ended = zeros(steps, num_envs, dtype=torch.bool)  # terminated, truncated or not valid
        self.valid = zeros(steps, num_envs, dtype=torch.bool)  # False if physics broke: the transition is ignored
        # These are values of the last observations of episodes cut by a time limit, otherwise 0; with several critics
        # one value each.
        self.final_values = zeros(steps, num_envs, *([critics] if critics > 1 else []))
        self.last_obs = zeros(num_envs, observations)  # raw observations after the last step


@torch.no_grad()
def collect_rollout(
    world: VectorWorld, rollout: Rollout, obs: Tensor, sample: Sampler, final_value: FinalValue,
    episodes: EpisodeStatistics
) -> Tensor:  # fmt: skip
    """Fill ``rollout`` from ``world``, starting at observations ``obs``; return the observations to continue from."""
    for t in range(rollout.steps):
        action, mean = sample(obs)
        rollout.obs[t] = obs
        rollout.actions[t] = action
        rollout.means[t] = mean
        obs, reward, terminated, truncated, info = world.step(action)
        valid = ~info["unstable"]
        rollout.rewards[t] = reward.masked_fill(~valid, 0.0)
        rollout.terminated[t] = terminated
        rollout.ended[t] = terminated | truncated | ~valid
        rollout.valid[t] = valid
        cut = truncated & ~terminated & valid
        values = rollout.final_values[t].zero_()
        final_obs = info["final_obs"]
        if not maths.may_look(cut.device):
            # A forward pass of all environments is cheaper than waiting for the indices of the cut rows.
            there = cut.view(-1, *[1] * (values.dim() - 1))
            values.copy_(torch.where(there, final_value(final_obs, world.task_id), 0.0))
        elif len(rows := cut.nonzero().squeeze(-1)):
            values[rows] = final_value(final_obs[rows], world.task_id[rows])
        episodes.update(info)
    rollout.last_obs.copy_(obs)
    return obs


def check_autoreset(world: VectorWorld, learner: str, expected: str) -> None:
    """Raise BidexError if the world's autoreset mode is not ``expected``, or the default precision is not single."""
    maths.check_precision()
    name = world.metadata["autoreset_mode"].name
    if name != expected:
        raise BidexError(
            f"{learner}: needs a world in autoreset mode {expected}, but this one is in {name}. Make it with "
            f'autoreset_mode="{expected}".'
        )


def check_samples(name: str, rollout_steps: int, num_envs: int, num_minibatches: int) -> None:
    """Raise BidexError if a rollout has fewer samples than mini-batches."""
    samples = rollout_steps * num_envs
    if samples < num_minibatches:
        raise BidexError(
            f"{name}: {num_minibatches} mini-batches need as many samples, but {num_envs} environments x "
            f"{rollout_steps} steps give {samples}. Raise num_envs or lower num_minibatches."
        )
