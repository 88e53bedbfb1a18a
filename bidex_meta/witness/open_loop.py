"""Actions known ahead as a policy: in their order, whatever comes of them."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bidex_meta.witness.store import Witness


class Played:
    """Plays a sequence in each row from the first step of an episode on; after its end the last action holds.

    Args:
        sequences: Actions ``(n, steps, action)``.
        which: The sequence of each row, int64 ``(num_envs,)``.
    """

    def __init__(self, sequences: Tensor, which: Tensor):
        self._sequences, self._which, self._step = sequences, which, torch.zeros_like(which)

    def eval_action(self, obs: Tensor) -> Tensor:
        """The next actions ``(num_envs, action)``."""
        action = self._sequences[self._which, self._step.clamp_max(self._sequences.shape[1] - 1)]
        self._step += 1
        return action

    def reset(self, env_mask: Tensor) -> None:
        """These rows begin again."""
        self._step[env_mask] = 0

    def _keep(self, sequence: int, actions: Tensor) -> None:
        """Puts actions (T, a) into the first columns of a sequence, and the last one into the steps after it."""
        into = self._sequences[sequence]
        into[:, : actions.shape[1]] = actions[torch.arange(len(into)).clamp_max(len(actions) - 1)]


class OpenLoop(Played):
    """Plays the witness of each row's class.

    It sees nothing. Where it succeeds on tasks that it was not searched on, nothing needs to be seen.

    Args:
        witnesses: By class; of a class that has none it does nothing.
        task_names: Classes of the world's slots.
        task_id: The slot of each row, int64 ``(num_envs,)``.
        actions: Size of the world's actions, which may be padded.
        noise: Standard deviation of Gaussian noise on them.
        seed: Of the noise.
    """

    def __init__(
        self,
        witnesses: Mapping[str, Witness],
        task_names: Sequence[str],
        task_id: Tensor,
        actions: int,
        noise: float = 0.0,
        seed: int = 0,
    ):
        longest = max((len(each.actions) for each in witnesses.values()), default=1)
        super().__init__(torch.zeros(len(task_names), longest, actions, device=task_id.device), task_id)
        for slot, name in enumerate(task_names):
            if name in witnesses:
                self._keep(slot, torch.from_numpy(witnesses[name].actions))
        self._noise, self._generator = noise, torch.Generator(task_id.device).manual_seed(seed)

    def eval_action(self, obs: Tensor) -> Tensor:
        """The next actions ``(num_envs, action)``."""
        action = super().eval_action(obs)
        if not self._noise:
            return action
        noise = torch.randn(action.shape, generator=self._generator, device=action.device)
        return (action + self._noise * noise).clamp(-1.0, 1.0)
