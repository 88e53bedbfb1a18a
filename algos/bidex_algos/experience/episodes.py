"""Return, length and success of recent episodes, per task."""

from typing import Any

import torch
from torch import Tensor

from bidex_meta.train.distributed import all_sum


class EpisodeStatistics:
    """Fading sums over about the last ``window`` finished episodes of each task.

    A rollout is shorter than an episode, so the episodes that happen to end in one are few and, for a slow task, often
    none: an average over one rollout would jump.

    Args:
        task_id: Task of each row, int64 (N,).
        task_names: Names of the tasks.
        window: Number of episodes, in each process, after which an old one counts 1/e.
    """

    def __init__(self, task_id: Tensor, task_names: list[str], window: float = 100.0):
        self.task_id = task_id
        self.task_names = task_names
        self.window = window
        # Rows: return, length, success, count.
        self.sums = torch.zeros(4, len(task_names), device=task_id.device)

    def update(self, info: dict[str, Any]) -> None:
        """Takes in the episodes that ``info["counted"]`` says ended in this step."""
        episode, ended = info["so_far"], info["counted"]
        values = torch.stack([episode["r"].float(), episode["l"].float(), episode["success"].float(), ended.float()])
        new = torch.zeros_like(self.sums).index_add_(1, self.task_id, values.masked_fill(~ended, 0.0))
        self.sums = self.sums * (1.0 - 1.0 / self.window) ** new[3] + new

    def metrics(self) -> dict[str, float]:
        """Means per task, and means over the tasks that have finished an episode; a task without one is left out.

        The episodes of all processes count.
        """
        returns, lengths, successes, counts = all_sum(self.sums).tolist()
        seen = [i for i, count in enumerate(counts) if count > 0]
        out: dict[str, float] = {}
        for i in seen:
            out[f"Train/return/{self.task_names[i]}"] = returns[i] / counts[i]
            out[f"Train/success/{self.task_names[i]}"] = successes[i] / counts[i]
        if seen:
            out["Train/mean_return"] = sum(returns[i] / counts[i] for i in seen) / len(seen)
            out["Train/success_rate"] = sum(successes[i] / counts[i] for i in seen) / len(seen)
            out["Train/mean_episode_length"] = sum(lengths[i] / counts[i] for i in seen) / len(seen)
        return out

    def state_dict(self) -> dict[str, Tensor]:
        """The sums."""
        return {"sums": self.sums.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.sums.copy_(state["sums"])
