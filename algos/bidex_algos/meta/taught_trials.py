"""The data set of a student with a memory: trials, what teachers would have done in them, and what the tasks hide.

A ring of trials of all environments on the device, in half precision: 1,024 of ML1-v2, with three episodes of 225
steps, take 0.9 GB.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.meta.trials import Trials
from bidex_meta.errors import BidexError
from bidex_meta.train.learner import State


class Lesson(NamedTuple):
    """Trials to learn from: S slots of B rows, float32."""

    obs: Tensor
    """Raw observations (S, B, d)."""
    previous: tuple[Tensor, Tensor, Tensor, Tensor]
    """What the memory was fed beside them; see ``Trials.previous``."""
    labels: Tensor
    """What the teachers would have done (S, B, a)."""
    goals: Tensor
    """What the tasks hide (B, k)."""
    taught: Tensor
    """Whether a teacher played (B,): what it does tells the goal, which rewards alone shall tell."""
    lengths: Tensor
    """Slots that hold a step (B,)."""


class TaughtTrials:
    """The last ``kept`` trials of N environments.

    ``labels`` (S, N, a), ``goals`` (N, k) and ``taught`` (N,) are filled while ``trials`` is played; then ``keep``
    takes all.
    """

    def __init__(self, trials: Trials, kept: int, goals: int):
        self.trials, self.kept, self.added = trials, kept, 0
        slots, rows, actions = trials.actions.shape
        device = trials.obs.device
        self.labels = torch.zeros(slots, rows, actions, device=device)
        self.goals = torch.zeros(rows, goals, device=device)
        self.taught = torch.zeros(rows, dtype=torch.bool, device=device)

        def empty(*shape: int, dtype: torch.dtype = torch.float16) -> Tensor:
            # Not filled: an operating system gives memory when it is first written, and nothing is read before that.
            return torch.empty(kept, slots, rows, *shape, dtype=dtype, device=device)

        self._ring = {
            "obs": empty(trials.obs.shape[2]), "action": empty(actions), "reward": empty(dtype=torch.float32),
            "known": empty(dtype=torch.bool), "done": empty(dtype=torch.bool), "labels": empty(actions),
            "goals": torch.empty(kept, rows, goals, device=device),
            "taught": torch.empty(kept, rows, dtype=torch.bool, device=device),
            "lengths": torch.empty(kept, rows, dtype=torch.int64, device=device),
        }  # fmt: skip

    @property
    def filled(self) -> int:
        """Trials of each environment that can be drawn from."""
        return min(self.added, self.kept)

    def keep(self) -> None:
        """Takes the trials that were played."""
        t = self.trials
        names = ("action", "reward", "known", "done")
        new = dict(zip(names, t.previous(len(t.obs)), strict=True))
        new |= {"obs": t.obs, "labels": self.labels, "goals": self.goals, "taught": self.taught, "lengths": t.lengths}
        for name, value in new.items():
            self._ring[name][self.added % self.kept] = value
        self.added += 1

    def take(self, trial: Tensor, row: Tensor) -> Lesson:
        """The trials (B,), numbers below ``filled``, of environments (B,)."""
        lengths = self._ring["lengths"][trial, row]
        slots = int(lengths.max())

        def of(name: str) -> Tensor:
            found = self._ring[name][trial, :slots, row].transpose(0, 1)
            return found if found.dtype == torch.bool else found.float()

        previous = (of("action"), of("reward"), of("known"), of("done"))
        goals, taught = (self._ring[name][trial, row] for name in ("goals", "taught"))
        return Lesson(of("obs"), previous, of("labels"), goals, taught, lengths)

    def state_dict(self) -> State:
        """A copy of all that is kept."""
        return {"added": self.added, **{name: ring[: self.filled].clone() for name, ring in self._ring.items()}}

    def load_state_dict(self, state: State) -> None:
        """Restores what :meth:`state_dict` gave. Raises BidexError where its environments or trials differ."""
        here, there = self._ring["obs"].shape[1:], state["obs"].shape[1:]
        if here != there or len(state["obs"]) != min(state["added"], self.kept):
            raise BidexError(
                f"The checkpoint's data set keeps trials of (slots, num_envs, observations) = {tuple(there)}, this one "
                f"{self.kept} of {tuple(here)}. Resume with the run's own suite, num_envs and trials."
            )
        self.added = int(state["added"])
        for name, ring in self._ring.items():
            ring[: self.filled] = state[name].to(ring.device)
