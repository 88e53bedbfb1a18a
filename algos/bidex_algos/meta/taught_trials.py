"""The data set of a student with a memory: trials, what teachers would have done in them, and what the tasks hide.

A ring of trials of all environments on the device, in half precision: 1,024 of ML1-v2, with three episodes of 225
steps, take 0.9 GB.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.meta.trials import Trials
from bidex_algos.nets.inputs import Columns
from bidex_meta.errors import BidexError
from bidex_meta.train.learner import State


class Evidence(NamedTuple):
    """What the memory was shown in some trials: S slots of B rows."""

    noted: Tensor
    """Columns of raw observations (S, B, n)."""
    reward: Tensor
    """Rewards that led there (S, B)."""
    known: Tensor
    """Whether they were shown, bool (S, B)."""
    goals: Tensor
    """What the tasks hide (B, k)."""
    counts: Tensor
    """Steps that count, bool (S, B): not where a teacher went to the goal, which rewards shall tell."""


class TaughtTrials:
    """The last ``kept`` trials of N environments.

    ``labels`` (S, N, a), ``goals`` (N, g, k), ``rewards`` (S, N, g) and ``taught`` (N,) are filled while ``trials`` is
    played; then ``keep`` takes all. Of ``g`` goals the first is the task's; for the others the same steps are rewarded
    in hindsight.
    """

    def __init__(self, trials: Trials, kept: int, goals: int, size: int):
        self.trials, self.kept, self.added = trials, kept, 0
        slots, rows, actions = trials.actions.shape
        device = trials.obs.device
        self.labels = torch.zeros(slots, rows, actions, device=device)
        self.goals, self.rewards = (torch.zeros(*n, device=device) for n in ((rows, goals, size), (slots, rows, goals)))
        self.taught = torch.zeros(rows, dtype=torch.bool, device=device)

        def empty(*shape: int, dtype: torch.dtype = torch.float16) -> Tensor:
            # Not filled: an operating system gives memory when it is first written, and nothing is read before that.
            return torch.empty(kept, slots, rows, *shape, dtype=dtype, device=device)

        self._ring = {
            "obs": empty(trials.obs.shape[2]), "labels": empty(actions), "rewards": empty(goals, dtype=torch.float32),
            "known": empty(dtype=torch.bool),
            "goals": torch.empty(kept, rows, goals, size, device=device),
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
        *_, known, _ = t.previous(len(t.obs))
        # Behind an action as ``previous`` has it, so that a reward stands beside what it led to.
        rewards = torch.cat([torch.zeros_like(self.rewards[:1]), self.rewards[:-1]])
        new = {"obs": t.obs, "rewards": rewards, "known": known, "labels": self.labels, "goals": self.goals}
        for name, value in (new | {"taught": self.taught, "lengths": t.lengths}).items():
            self._ring[name][self.added % self.kept] = value
        self.added += 1

    def steps(self, trial: Tensor, row: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Raw observations (B, d), labels (B, a) and goals (B, k) of a step of each of some trials.

        Of trials (B,), numbers below ``filled``, of environments (B,), at a share in [0, 1) of their lengths (B,).
        """
        slot = (share * self._ring["lengths"][trial, row]).long()
        obs, labels = (self._ring[name][trial, slot, row].float() for name in ("obs", "labels"))
        return obs, labels, self._ring["goals"][trial, row, 0]

    def evidence(self, trial: Tensor, row: Tensor, goal: Tensor, columns: Columns) -> Evidence:
        """Of trials (B,) of environments (B,), rewarded for one of the goals (B,)."""
        lengths, taught = (self._ring[name][trial, row] for name in ("lengths", "taught"))
        slots = int(lengths.max())
        obs, known = (self._ring[name][trial, :slots, row] for name in ("obs", "known"))
        rewards = self._ring["rewards"][trial, :slots, row, goal]
        counts = (torch.arange(slots, device=lengths.device)[:, None] < lengths) & ~(taught & (goal == 0))
        noted = columns(obs).transpose(0, 1).float()
        return Evidence(noted, rewards.T, known.T, self._ring["goals"][trial, row, goal], counts)

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
