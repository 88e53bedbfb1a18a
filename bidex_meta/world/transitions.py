"""What a step did: to rows of one class by its own formulas, and to all rows of a world, gathered from its parts."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.state import TaskState
from bidex_meta.world.part import Part


@dataclass(frozen=True)
class Transition:
    """What a step did to rows of one class, before it is scaled or cleaned.

    Attributes:
        terms: Reward terms by name, each (n,).
        reward: Their sum, shape (n,).
        success: Shape (n,), bool.
        failed: Shape (n,), bool.
    """

    terms: dict[str, Tensor]
    reward: Tensor
    success: Tensor
    failed: Tensor


def judge(task: TaskClass, state: TaskState) -> Transition:
    """Reward, success and ends of the step just made."""
    terms = task.reward_terms(state)
    values = list(terms.values())
    reward = torch.stack(values).sum(dim=0) if len(values) > 1 else values[0]
    return Transition(terms, reward, task.success(state), task.failed(state))


@dataclass(frozen=True)
class Transitions:
    """A step of n rows, before rewards are scaled and broken rows cleaned.

    Attributes:
        reward: Shape (n,).
        success: Shape (n,), bool.
        failed: Shape (n,), bool: the episode has come to a true end.
        unstable: Shape (n,), bool: the engine has told the row broken.
        terms: Reward terms by name, each (n,), 0 in rows of classes without the term.
        obs: Observations, shape (n, d).
    """

    reward: Tensor
    success: Tensor
    failed: Tensor
    unstable: Tensor
    terms: dict[str, Tensor]
    obs: Tensor


def collect(
    parts: Iterable[Part], task_index: Tensor, action: Tensor, width: int, with_id: Callable[[Tensor, Tensor], Tensor]
) -> Transitions:
    """Judges and observes all rows after a step.

    Args:
        parts: The world's parts; each is asked for when its turn comes.
        task_index: Task of each row, shape (n,).
        action: Actions of the step, shape (n, a).
        width: Entries of an observation.
        with_id: Writes the task id into observations (k, d) of world rows (k,) and returns them.
    """
    n, device = len(action), action.device
    reward, obs = torch.empty(n, device=device), torch.empty(n, width, device=device)
    success, failed, unstable = torch.zeros(3, n, dtype=torch.bool, device=device).unbind()
    terms: dict[str, Tensor] = {}
    for part in parts:
        group = part.group
        states = list(part.states(group.take(task_index)))
        out = None if group.span is None else obs[group.span]
        values = with_id(part.observe(states, group.take(action), out=out), group.rows)
        broke = part.unstable()
        for member, where, state in states:
            rows, made = member.world_rows, judge(member.scene.task, state)
            reward[rows], success[rows], failed[rows] = made.reward, made.success, made.failed
            unstable[rows] = broke[where]
            for name, value in made.terms.items():
                terms.setdefault(name, torch.zeros(n, device=device))[rows] = value
            if out is None:
                obs[rows] = values[where]
    return Transitions(reward, success, failed, unstable, terms, obs)
