"""Meta-World's MT suites as a world, stepped one by one: tasks, rewards and physics that no one here wrote."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.evaluation.play import check_world, play_tasks
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.metaworld.library import (
    ACTION_SIZE,
    EPISODE_STEPS,
    OBSERVATION_SIZE,
    TASKS_PER_CLASS,
    Single,
    make_tasks,
)
from bidex_meta.suite import metaworld_classes
from bidex_meta.world.base import Transition
from bidex_meta.world.checked import fits
from bidex_meta.world.contract import PooledWorld, State
from bidex_meta.world.foreign_world import ForeignWorld, Sizes


class MetaWorldWorld(ForeignWorld):
    """A suite of Meta-World's on the CPU, a key of ``suite.METAWORLD_SUITES``: a world whose slots are the classes.

    Observations are Meta-World's 39 numbers (goal visible) with the class's one-hot behind them; rewards its "v2" in
    [0, 10]; an episode is 500 steps, ended by the time limit alone. Starts are part of Meta-World's tasks: an episode
    depends on its task and actions alone. A task's variation is its number among the class's fifty. ``seed`` chooses
    Meta-World's tasks, and the draws of tasks until ``reset(seed=...)``; other keywords as of ``bidex_meta.World``.
    Raises BidexError for an unknown suite or mode, fewer environments than classes, or where Meta-World is not
    installed.
    """

    def __init__(
        self,
        suite: str,
        num_envs: int,
        *,
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        stagger: bool = True,
    ) -> None:
        self.suite = suite
        sizes = Sizes(OBSERVATION_SIZE, ACTION_SIZE, EPISODE_STEPS)
        super().__init__(metaworld_classes(suite), num_envs, sizes, seed, autoreset_mode, stagger)
        self._task_seed, self._tasks = seed, make_tasks(suite, seed)
        self._singles = [Single(self.task_names[i]) for i in self.task_id.tolist()]
        self._actions = torch.zeros(num_envs, EPISODE_STEPS, ACTION_SIZE)  # of the running episodes, for checkpoints
        self._pools: dict[str, list[int]] = {}
        self.set_tasks({name: range(TASKS_PER_CLASS) for name in self.task_names})

    def set_tasks(self, pools: Mapping[str, Sequence[int] | np.ndarray]) -> None:
        """Replaces pools by numbers of tasks, (n,) or (n, 1), from the next full reset on; else BidexError."""
        chosen = dict(self._pools)
        for name, pool in pools.items():
            if name not in self.task_names:
                raise unknown_name(f"class of {self.suite}", name, self.task_names)
            numbers = np.asarray(pool)
            flat = numbers.size > 0 and numbers.shape in ((len(pool),), (len(pool), 1))
            if not flat or not (numbers.min() >= 0 and numbers.max() < TASKS_PER_CLASS):  # false for NaN
                what = f"Expected tasks of {name} from 0 to {TASKS_PER_CLASS - 1}, (n,) or (n, 1)"
                raise BidexError(f"{what}, got {numbers.tolist()}.")
            chosen[name] = [int(number) for number in numbers.flatten()]
        self._pools = chosen
        self._set_pool_sizes([len(chosen[name]) for name in self.task_names])

    @property
    def pools(self) -> list[np.ndarray]:
        """Numbers of the tasks of each class, each (n, 1), int64."""
        return [np.array(self._pools[name])[:, None] for name in self.task_names]

    def _place(self, mask: Tensor) -> None:
        for row in mask.nonzero().squeeze(1).tolist():
            self._obs[row, :OBSERVATION_SIZE] = torch.from_numpy(self._singles[row].start(self._task(row)))

    def _task(self, row: int) -> object:
        name = self.task_names[self.task_id[row]]
        return self._tasks[name][self._pools[name][self.task_index[row]]]

    def _advance(self, active: Tensor, broken: Tensor) -> Transition:
        action = self._action
        self._actions[active, self.episodes.length[active]] = action[active]
        obs, reward, success, unstable = self._obs.clone(), torch.zeros(self.num_envs), self._success & ~active, broken
        numbers = action.numpy()
        for row in (active & ~broken).nonzero().squeeze(1).tolist():
            new, gained, reached, fell = self._singles[row].step(numbers[row])
            if fell:
                unstable[row] = True  # its last finite observation stays
                continue
            obs[row, :OBSERVATION_SIZE] = torch.from_numpy(new)
            reward[row], success[row] = gained, reached
        return Transition(obs, reward, success, torch.zeros_like(unstable), unstable, {})

    def state_dict(self) -> State:
        """All that decides the world's future: tensors and plain values, copied."""
        own = {"actions": self._actions.clone()}
        return {**super().state_dict(), **own, "pools": {name: list(pool) for name, pool in self._pools.items()}}

    def _made(self) -> dict[str, str]:
        return super()._made() | {"suite": self.suite, "seed of tasks": str(self._task_seed)}

    def load_state_dict(self, state: State) -> None:
        """Restores a ``state_dict``; raises BidexError for one of another suite, seed or size.

        Each running episode is played again from its start, exactly: Meta-World keeps part of its state in Python.
        """
        fits(state, self.state_dict())
        self.set_tasks(state["pools"])
        self._restore(state)
        self._actions = state["actions"].clone()
        # What waits for a reset, or was never started, is not looked at before its next start.
        running = ~self.episodes.finished & (self.episodes.number >= 0)
        for row in running.nonzero().squeeze(1).tolist():
            self._singles[row].start(self._task(row))
            for action in self._actions[row, : int(self.episodes.length[row])].numpy():
                self._singles[row].step(action)

    def close_extras(self, **kwargs: object) -> None:
        """Frees the environments."""
        for single in self._singles:
            single.close()


def evaluate_all_tasks(
    agent: Agent, world: PooledWorld, episodes_per_task: int = 1, *, seed: int = EVALUATION_SEED
) -> Evaluation:
    """``evaluate`` over all tasks of all classes, as many at a time as the world has environments.

    An environment takes some 10 MB, so there is not one for each of MT10's five hundred tasks. Without noise a policy
    plays every episode of a task alike, and one is enough. ``world`` is a ``MetaWorldWorld`` in autoreset mode
    DISABLED; it is left with other pools.
    """
    protocol = Protocol(seed=seed, episodes_per_task=episodes_per_task)
    check_world(world)
    at_once = min(rows.stop - rows.start for rows in world.slot_env_ids)
    parts: list[dict[str, np.ndarray]] = []
    for first in range(0, TASKS_PER_CLASS, at_once):
        pool = np.arange(first, min(first + at_once, TASKS_PER_CLASS))
        world.set_tasks({name: pool for name in world.task_names})
        played = play_tasks(agent, world, protocol.episodes_per_task, protocol.seed)
        parts.append(played | {"task": played["task"] + first})
    episodes = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return Evaluation(results_by_class(world.task_names, episodes), episodes_per_task)
