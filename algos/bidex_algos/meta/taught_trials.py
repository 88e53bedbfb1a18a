"""The data set from which a student with a memory learns: trials, teachers' labels, and hidden values of the tasks.

The data set is a ring buffer of trials of all environments on the device, in half precision. 1,024 trials of ML1-v2,
with three episodes of 225 steps, take 0.7 GB.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.meta.trials import Trials
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import State


class Steps(NamedTuple):
    """States in trials, with the rewards that each of g goals would have given for reaching these states."""

    obs: Tensor
    """Raw observations (B, d)."""
    labels: Tensor
    """Targets of the actor in these states (B, a), such as the teachers' actions."""
    goals: Tensor
    """Goals (B, g, k); the first of the g goals is the hidden values of the step's own task."""
    rewards: Tensor
    """Rewards under each goal (B, g)."""
    paid: Tensor
    """True if the step had a reward, False at the beginning of an episode, bool (B,)."""


class TaughtTrials:
    """The last ``kept`` trials of N environments.

    Four tensors are filled while ``trials`` is played, and :meth:`keep` then stores them: ``labels`` (S, N, a),
    ``goals`` (S, N, g, k), ``rewards`` (S, N, g) and ``taught`` (N,), which marks trials in which teachers act. A label
    has ``labels`` entries; the default is those of an action. The first of g goals is the task's own. The rewards that
    the other goals would have given are computed in hindsight. The goals of a slot belong to the state in this slot,
    and the rewards of a slot are those of the step that leaves this state, under the goals of the next slot.
    """

    def __init__(self, trials: Trials, kept: int, goals: int, size: int, labels: int | None = None):
        self.trials = trials
        self.kept = kept
        self.added = 0
        slots, rows, actions = trials.actions.shape
        labels = labels or actions
        device = trials.obs.device
        self.labels = torch.zeros(slots, rows, labels, device=device)
        self.goals = torch.zeros(slots, rows, goals, size, device=device)
        self.rewards = torch.zeros(slots, rows, goals, device=device)
        self.taught = torch.zeros(rows, dtype=torch.bool, device=device)

        def empty(*shape: int, dtype: torch.dtype = torch.float16) -> Tensor:
            # The ring is not filled: memory is allocated at the first write, and no entry is read earlier.
            return torch.empty(kept, slots, rows, *shape, dtype=dtype, device=device)

        self._ring = {
            "obs": empty(trials.obs.shape[2]), "labels": empty(labels), "rewards": empty(goals, dtype=torch.float32),
            "paid": empty(dtype=torch.bool),
            "goals": empty(goals, size),
            "taught": torch.empty(kept, rows, dtype=torch.bool, device=device),
            "lengths": torch.empty(kept, rows, dtype=torch.int64, device=device),
        }  # fmt: skip

    @property
    def filled(self) -> int:
        """Return the number of stored trials of each environment."""
        return min(self.added, self.kept)

    def keep(self) -> None:
        """Store the trial that every environment has just played."""
        t = self.trials
        # Rewards move one slot later, to the state that they led to. The state after an episode's last reward is not
        # recorded.
        rewards, paid = (torch.cat([torch.zeros_like(x[:1]), x[:-1]]) for x in (self.rewards, t.valid & ~t.ended))
        new = {"obs": t.obs, "rewards": rewards, "paid": paid, "labels": self.labels, "goals": self.goals}
        for name, value in (new | {"taught": self.taught, "lengths": t.lengths}).items():
            self._ring[name][self.added % self.kept] = value
        self.added += 1

    def steps(self, trial: Tensor, row: Tensor, share: Tensor) -> Steps:
        """Return B steps: one step of the trial ``trial[i]`` of the environment ``row[i]`` for each i.

        The entries of ``trial`` (B,) are below ``filled``. ``share`` (B,), in [0, 1), is the position of the step in
        its trial, relative to the trial's length.
        """
        slot = (share * self._ring["lengths"][trial, row]).long()
        ring = self._ring
        names = ("obs", "labels", "goals", "rewards", "paid")
        obs, labels, goals, rewards, paid = (ring[name][trial, slot, row] for name in names)
        return Steps(obs.float(), labels.float(), goals.float(), rewards, paid)

    def state_dict(self) -> State:
        """Return a copy of the stored data."""
        return {"added": self.added, **{name: ring[: self.filled].clone() for name, ring in self._ring.items()}}

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if ``state`` has other environments or trials."""
        here = self._ring["obs"].shape[1:]
        there = state["obs"].shape[1:]
        if here != there or len(state["obs"]) != min(state["added"], self.kept):
            raise BidexError(
                f"The checkpoint's data set keeps trials of (slots, num_envs, observations) = {tuple(there)}, this one "
                f"{self.kept} of {tuple(here)}. Resume with the run's own suite, num_envs and trials."
            )
        self.added = int(state["added"])
        for name, ring in self._ring.items():
            ring[: self.filled] = state[name].to(ring.device)
