"""A world that runs Meta-World's MT suites, with Meta-World's own tasks, rewards and physics.

The world steps its environments one after another.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.evaluation.play import Episodes, check_world, joined_episodes, play_tasks
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.metaworld.library import (
    ACTION_SIZE,
    EPISODE_STEPS,
    OBSERVATION_SIZE,
    TASKS_PER_CLASS,
    Single,
    make_tasks,
)
from bidex_meta.suite_files import metaworld_classes
from bidex_meta.world.base import Transition
from bidex_meta.world.checked import fits
from bidex_meta.world.contract import PooledWorld, State
from bidex_meta.world.foreign_world import ForeignWorld, Sizes


class MetaWorldWorld(ForeignWorld):
    """A world that runs one of Meta-World's suites on the CPU.

    ``suite`` is a key of ``suite_files.METAWORLD_SUITES``. Observations are Meta-World's 39 numbers, which include the
    goal, followed by the one-hot of the class. Rewards are Meta-World's "v2" rewards in [0, 10]. An episode has 500
    steps and ends only at the time limit. Start states are part of Meta-World's tasks, so an episode depends only on
    its task and the actions. The variation of a task is its number among the class's fifty tasks.

    ``seed`` determines Meta-World's tasks. Until ``reset(seed=...)`` is called, it also determines which tasks are
    drawn. Other keywords are those of ``World``. Raises BidexError for an unknown suite or mode, for fewer environments
    than classes, or if Meta-World is not installed.
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
        self._task_seed = seed
        self._tasks = make_tasks(suite, seed)
        self._singles = [Single(self.task_names[i]) for i in self.task_id.tolist()]
        # Actions of the running episodes, for checkpoints.
        self._actions = torch.zeros(num_envs, EPISODE_STEPS, ACTION_SIZE)
        self._pools: dict[str, list[int]] = {}
        self.set_tasks({name: range(TASKS_PER_CLASS) for name in self.task_names})

    def set_tasks(self, pools: Mapping[str, Sequence[int] | np.ndarray]) -> None:
        """Replace the sets of tasks ("pools") of some classes, from the next full reset on.

        ``pools`` holds the numbers of the new tasks by class, each (n,) or (n, 1). Raises BidexError for an unknown
        class, or for numbers that are not tasks.
        """
        chosen = dict(self._pools)
        for name, pool in pools.items():
            if name not in self.task_names:
                raise unknown_name(f"class of {self.suite}", name, self.task_names)
            numbers = np.asarray(pool)
            flat = numbers.size > 0 and numbers.shape in ((len(pool),), (len(pool), 1))
            # The comparison is false for NaN.
            whole = flat and bool((numbers == np.floor(numbers)).all())
            if not whole or not (numbers.min() >= 0 and numbers.max() < TASKS_PER_CLASS):
                fault = f"Expected tasks of {name} from 0 to {TASKS_PER_CLASS - 1}, (n,) or (n, 1)"
                raise BidexError(f"{fault}, got {numbers.tolist()}.")
            chosen[name] = [int(number) for number in numbers.flatten()]
        self._pools = chosen
        self._set_pool_sizes([len(chosen[name]) for name in self.task_names])

    @property
    def pools(self) -> list[np.ndarray]:
        """Return the task numbers of each class, each (n, 1), int64."""
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
        obs = self._obs.clone()
        reward = torch.zeros(self.num_envs)
        success = self._success & ~active
        unstable = broken
        numbers = action.numpy()
        for row in (active & ~broken).nonzero().squeeze(1).tolist():
            new, gained, reached, fell = self._singles[row].step(numbers[row])
            if fell:
                unstable[row] = True  # the row keeps its last finite observation
                continue
            obs[row, :OBSERVATION_SIZE] = torch.from_numpy(new)
            reward[row] = gained
            success[row] = reached
        return Transition(obs, reward, success, torch.zeros_like(unstable), unstable, {})

    def state_dict(self) -> State:
        """Return a copy of the state that decides the world's future: tensors and plain values."""
        own = {"actions": self._actions.clone()}
        return {**super().state_dict(), **own, "pools": {name: list(pool) for name, pool in self._pools.items()}}

    def _made(self) -> dict[str, str]:
        return super()._made() | {"suite": self.suite, "seed of tasks": str(self._task_seed)}

    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict``; raises BidexError if its suite, seed or size differs.

        Each running episode is replayed exactly from its start, because Meta-World keeps part of its state in Python.
        """
        fits(state, self.state_dict())
        self.set_tasks(state["pools"])
        self._restore(state)
        self._actions = state["actions"].clone()
        # Environments that wait for a reset, or were never started, are not checked before their next start.
        running = ~self.episodes.finished & (self.episodes.number >= 0)
        for row in running.nonzero().squeeze(1).tolist():
            self._singles[row].start(self._task(row))
            for action in self._actions[row, : int(self.episodes.length[row])].numpy():
                self._singles[row].step(action)

    def close_extras(self, **kwargs: object) -> None:
        """Free the environments."""
        for single in self._singles:
            single.close()


def evaluate_all_tasks(
    agent: Agent, world: PooledWorld, episodes_per_task: int = 1, *, seed: int = EVALUATION_SEED
) -> Evaluation:
    """Run ``evaluate`` over all tasks of all classes, in batches of the world's number of environments.

    An environment takes about 10 MB, which is too much for an environment per task: MT10 has 500 tasks. A policy
    without noise plays every episode of a task identically, so one episode is enough. ``world`` is a ``MetaWorldWorld``
    in autoreset mode DISABLED; this function changes its pools.
    """
    protocol = Protocol(seed=seed, episodes_per_task=episodes_per_task)
    check_world(world)
    at_once = min(rows.stop - rows.start for rows in world.slot_env_ids)
    parts: list[Episodes] = []
    for first in range(0, TASKS_PER_CLASS, at_once):
        pool = np.arange(first, min(first + at_once, TASKS_PER_CLASS))
        world.set_tasks({name: pool for name in world.task_names})
        played = play_tasks(agent, world, protocol.episodes_per_task, protocol.seed)
        parts.append(played | {"task": played["task"] + first})
    return Evaluation(results_by_class(world.task_names, joined_episodes(parts)), episodes_per_task)
