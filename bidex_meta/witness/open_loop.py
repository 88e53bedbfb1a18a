"""A witness as a policy: its actions in their order, whatever comes of them."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bidex_meta.witness.store import Witness


class OpenLoop:
    """Plays the witness of each row's class from the first step of an episode on; after its end the last action holds.

    It sees nothing. Where it succeeds on tasks that it was not searched on, nothing needs to be seen.

    Args:
        witnesses: By class; of a class that has none it does nothing.
        task_names: Classes of the world's slots.
        task_id: The slot of each row, int64 ``(num_envs,)``.
        actions: Size of the world's actions, which may be padded.
    """

    def __init__(self, witnesses: Mapping[str, Witness], task_names: Sequence[str], task_id: Tensor, actions: int):
        longest = max((len(each.actions) for each in witnesses.values()), default=1)
        self._played = torch.zeros(len(task_names), longest, actions, device=task_id.device)
        for slot, name in enumerate(task_names):
            if name in witnesses:
                held(self._played[slot], torch.from_numpy(witnesses[name].actions))
        self._which, self._step = task_id, torch.zeros_like(task_id)

    def eval_action(self, obs: Tensor) -> Tensor:
        """The next actions ``(num_envs, action)``."""
        action = self._played[self._which, self._step.clamp_max(self._played.shape[1] - 1)]
        self._step += 1
        return action

    def reset(self, env_mask: Tensor) -> None:
        """These rows begin again."""
        self._step[env_mask] = 0


def held(into: Tensor, actions: Tensor) -> None:
    """Puts actions (T, a) into the first columns of a longer sequence, and the last one into the steps after it."""
    into[:, : actions.shape[1]] = actions[torch.arange(len(into)).clamp_max(len(actions) - 1)]
