"""Meta-World's MT suites as a world: single environments of a foreign library behind the face of ``bidex_meta.World``.

Our learners, evaluation and checkpoints run on it unchanged: a cross-check on tasks, rewards and physics that no one
here wrote. Rows are stepped one after the other, since each is an environment of its own; it is not fast.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.clients.metaworld import (
    ACTION_SIZE,
    EPISODE_STEPS,
    OBSERVATION_SIZE,
    TASKS_PER_CLASS,
    Single,
    class_names,
    make_tasks,
)
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.evaluation.play import check_world, play_tasks
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.world.actions import clean
from bidex_meta.world.autoreset import checked_mode, checked_seed, reset_mask
from bidex_meta.world.contract import PooledWorld, plain_groups
from bidex_meta.world.copying import Recreated
from bidex_meta.world.ends import Clock, ended_info
from bidex_meta.world.episodes import Episodes
from bidex_meta.world.groups import split_rows
from bidex_meta.world.random import row_keys, uniform
from bidex_meta.world.spaces import make_spaces

_TASK_DRAW, _ELAPSED_DRAW, _DRAWS = 0, 1, 2


class MetaWorldWorld(Recreated, VectorEnv):
    """A suite of Meta-World's with ``num_envs`` rows, split evenly and contiguously over its classes, on the CPU.

    Observations are Meta-World's 39 numbers (goal visible) with the class's one-hot behind them; rewards its "v2" in
    [0, 10]; an episode is 500 steps, ended by the time limit alone. In SAME_STEP mode each episode draws one of the
    class's fifty tasks and the first one starts at a random elapsed step, left out of statistics; in DISABLED mode row
    j of a class keeps task j modulo the number of tasks. Starts are part of Meta-World's tasks: an episode depends on
    its task and actions alone. All else is as in ``bidex_meta.World``: a ``contract.PooledWorld`` whose slots are the
    classes; a task's variation is its number among the class's fifty.
    """

    single_observation_space: Box
    single_action_space: Box
    observation_space: Box
    action_space: Box

    def __init__(
        self,
        suite: str,
        num_envs: int,
        *,
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        stagger: bool = True,
    ) -> None:
        """Makes the environments; no row is started before ``reset``.

        Args:
            suite: A key of ``clients.metaworld.SUITES``.
            num_envs: Rows over all classes, at least one for each.
            seed: Chooses Meta-World's tasks, and the draws of tasks until ``reset(seed=...)`` says otherwise.
            autoreset_mode: SAME_STEP (training) or DISABLED (evaluation), as a member or its name.
            stagger: As in ``bidex_meta.World``.

        Raises:
            BidexError: Unknown suite or mode, too few rows, or Meta-World is not installed.
        """
        self.suite, self.num_envs, self.device = suite, num_envs, torch.device("cpu")
        self.task_names = list(class_names(suite))
        self.num_tasks = self.num_id_columns = len(self.task_names)
        self.gammas: tuple[float | None, ...] = (None,) * self.num_tasks
        if num_envs < self.num_tasks:
            raise BidexError(f"Expected at least {self.num_tasks} rows, one for each class of {suite}, got {num_envs}.")
        self.autoreset_mode = checked_mode(autoreset_mode)
        self._stagger = stagger and self.autoreset_mode == AutoresetMode.SAME_STEP
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self._task_seed, self._tasks = seed, make_tasks(suite, seed)
        self.slot_rows = split_rows(num_envs, self.num_tasks)
        counts = [rows.stop - rows.start for rows in self.slot_rows]
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(torch.tensor(counts))
        self._index_in_slot = torch.cat([torch.arange(count) for count in counts])
        self._singles = [Single(self.task_names[i]) for i in self.task_id.tolist()]
        self.max_episode_steps, self._clock = torch.full((num_envs,), EPISODE_STEPS), Clock(num_envs, self.device)
        self._make_spaces()
        self._actions = torch.zeros(num_envs, EPISODE_STEPS, ACTION_SIZE)  # of the running episodes, for checkpoints
        self._obs = torch.zeros(self.observation_space.shape or ())
        self._obs[:, OBSERVATION_SIZE:] = torch.eye(self.num_tasks)[self.task_id]
        self._success = torch.zeros(num_envs, dtype=torch.bool)  # of the last transition: a frozen row keeps its own
        self._seed_rows(seed)
        self.set_tasks({name: range(TASKS_PER_CLASS) for name in self.task_names})

    def _make_spaces(self) -> None:
        # Meta-World's own space does not hold its observations: it was made before the goal became visible.
        low, high = (
            np.concatenate([np.full(OBSERVATION_SIZE, far), np.full(self.num_tasks, one_hot)]).astype(np.float32)
            for far, one_hot in ((-np.inf, 0.0), (np.inf, 1.0))
        )
        spaces = make_spaces(Box(low, high, dtype=np.float32), ACTION_SIZE, self.num_envs)
        self.single_observation_space, self.single_action_space = spaces.single_observation, spaces.single_action
        self.observation_space, self.action_space = spaces.observation, spaces.action
        self.observation_groups = plain_groups(OBSERVATION_SIZE + self.num_tasks, self.num_tasks)

    def _seed_rows(self, seed: int) -> None:
        self.seed = int(seed)
        pairs = zip(self.task_names, self.slot_rows, strict=True)
        self._keys = torch.cat([row_keys(self.seed, name, r.stop - r.start, self.device) for name, r in pairs])
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    def set_tasks(self, pools: Mapping[str, Sequence[int] | np.ndarray]) -> None:
        """Replaces the pools of tasks of some classes; they hold from the next full reset on.

        Args:
            pools: Class name to numbers of tasks among its fifty, shape (n,) or (n, 1).

        Raises:
            BidexError: Unknown class, an empty pool, a wrong shape or a number out of range.
        """
        chosen = dict(getattr(self, "_pools", {}))
        for name, pool in pools.items():
            if name not in self.task_names:
                raise unknown_name(f"class of {self.suite}", name, self.task_names)
            numbers = np.asarray(pool)
            flat = numbers.size > 0 and numbers.shape in ((len(pool),), (len(pool), 1))
            if not flat or not (numbers.min() >= 0 and numbers.max() < TASKS_PER_CLASS):  # false for NaN
                raise BidexError(
                    f"Expected tasks of {name} from 0 to {TASKS_PER_CLASS - 1}, (n,) or (n, 1), got {numbers.tolist()}."
                )
            chosen[name] = [int(number) for number in numbers.flatten()]
        self._pools = chosen
        self.num_slot_tasks = [len(chosen[name]) for name in self.task_names]
        self._pool_size = torch.tensor(self.num_slot_tasks)[self.task_id]
        self.task_index = self._index_in_slot % self._pool_size
        self._ready = False

    @property
    def pools(self) -> list[np.ndarray]:
        """Numbers of the tasks of each class, each (n, 1), int64."""
        return [np.array(self._pools[name])[:, None] for name in self.task_names]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Starts all draws anew; None goes on with the next episodes of the old seed.
            options: ``reset_mask``: which rows to start, shape (num_envs,), bool; all by default.

        Returns:
            Observations (num_envs, d) and an empty info.
        """
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._seed_rows(checked_seed(seed, mask))
        first = not self._ready or seed is not None
        self._ready = True
        self._begin(mask, stagger=first and self._stagger)
        return self._obs.clone(), {}

    def _begin(self, mask: Tensor, stagger: bool) -> None:
        """Starts new episodes in the rows of a mask and writes their observations."""
        self._clock.begin(mask)
        self.episodes.number = self.episodes.number + mask
        draws = uniform(self._keys, self.episodes.number, _DRAWS)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            task_index = (draws[:, _TASK_DRAW] * self._pool_size).long()
            self.task_index = torch.where(mask, task_index, self.task_index)
        elapsed = (draws[:, _ELAPSED_DRAW] * EPISODE_STEPS * stagger).long()
        self.episodes.begin(mask, elapsed)
        for row in mask.nonzero().squeeze(1).tolist():
            self._obs[row, :OBSERVATION_SIZE] = torch.from_numpy(self._singles[row].start(self._task(row)))

    def _task(self, row: int) -> Any:
        name = self.task_names[self.task_id[row]]
        return self._tasks[name][self._pools[name][self.task_index[row]]]

    def step(self, actions: Tensor | np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advances every row by one control step (1/80 s).

        Args:
            actions: Shape (num_envs, 4), clipped to [-1, 1]; a row with a non-finite number ends as unstable.

        Returns:
            Observations (num_envs, d), rewards, terminated (never) and truncated (num_envs,), and info. In SAME_STEP
            mode the observation of an ended row is already that of its next episode; ``final_obs`` has the last one.

        Raises:
            BidexError: A wrong shape, or no reset since the world was made or got other tasks.
        """
        action = torch.as_tensor(actions, dtype=torch.float32)
        if not self._ready:
            raise BidexError("Expected reset() before step(): the rows have no episode yet.")
        if action.shape != (self.num_envs, ACTION_SIZE):
            raise BidexError(f"Expected actions of shape ({self.num_envs}, {ACTION_SIZE}), got {tuple(action.shape)}.")
        action, broken = clean(action)
        active = ~self.episodes.finished
        self._actions[active, self.episodes.length[active]] = action[active]
        return self._finish(active, *self._advance(action, active, broken & active))

    def _advance(self, action: Tensor, active: Tensor, broken: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Steps the active rows whose action is not broken.

        Returns:
            Observations, rewards, successes, and which rows broke, of all rows.
        """
        obs, reward, success, unstable = self._obs.clone(), torch.zeros(self.num_envs), self._success & ~active, broken
        numbers = action.numpy()
        for row in (active & ~broken).nonzero().squeeze(1).tolist():
            new, gained, reached, fell = self._singles[row].step(numbers[row])
            if fell:
                unstable[row] = True  # its last finite observation stays
                continue
            obs[row, :OBSERVATION_SIZE] = torch.from_numpy(new)
            reward[row], success[row] = gained, reached
        return obs, reward, success, unstable

    def _finish(
        self, active: Tensor, obs: Tensor, reward: Tensor, success: Tensor, unstable: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Turns the rows' transitions into what ``step`` returns, and starts new episodes."""
        episodes = self.episodes
        episodes.add(active, reward, reward, success)
        late = episodes.elapsed >= self.max_episode_steps
        ended = (late | unstable) & active
        truncated = ended | episodes.truncated
        info: dict[str, Any] = {
            "success": success,
            "unstable": unstable,
            "reward_unscaled": reward.clone(),
            "final_obs": obs,
            "_final_obs": ended,
            "so_far": episodes.statistics(),
            "counted": ended & episodes.counts,
        }
        if ended.any():
            info |= ended_info(info)
            self._clock.stamp(info)
        self._obs, self._success = obs.clone(), success.clone()
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            if ended.any():
                self._begin(ended, stagger=False)
        else:
            episodes.truncated = truncated.clone()
            episodes.finished = episodes.finished | ended
        return self._obs.clone(), reward, torch.zeros_like(truncated), truncated, info

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides the future of the world: tensors and plain values, copied."""
        return {
            "suite": self.suite,
            "task_seed": self._task_seed,
            "seed": self.seed,
            "pools": {name: list(pool) for name, pool in self._pools.items()},
            "episodes": self.episodes.state_dict(),
            "task_index": self.task_index.clone(),
            "actions": self._actions.clone(),
            "observation": self._obs.clone(),
            "success": self._success.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what ``state_dict`` gave, on a world of the same suite, seed and rows.

        Meta-World's environments keep part of their state in Python attributes and in the model, so each running
        episode is played again from its start: exact, and a fraction of a second for a row.

        Raises:
            BidexError: The state is of another suite, seed or number of rows.
        """
        here = self.suite, self._task_seed, self.num_envs
        there = state["suite"], state["task_seed"], len(state["observation"])
        if here != there:
            raise BidexError(
                f"Expected the state of a world with (suite, seed, num_envs) = {here}, got {there}; build the world "
                "with the same."
            )
        self.set_tasks(state["pools"])
        self._seed_rows(int(state["seed"]))
        self.episodes.load_state_dict(state["episodes"])
        self.task_index, self._actions = state["task_index"].clone(), state["actions"].clone()
        self._obs, self._success = state["observation"].clone(), state["success"].clone()
        self._ready = True
        # What waits for a reset, or was never started, is not looked at before its next start.
        running = ~self.episodes.finished & (self.episodes.number >= 0)
        for row in running.nonzero().squeeze(1).tolist():
            self._singles[row].start(self._task(row))
            for action in self._actions[row, : int(self.episodes.length[row])].numpy():
                self._singles[row].step(action)

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the environments."""
        for single in self._singles:
            single.close()


def evaluate_all_tasks(
    agent: Agent, world: PooledWorld, episodes_per_task: int = 1, *, seed: int | None = None
) -> Evaluation:
    """``evaluate`` over all tasks of all classes, as many at a time as the world has rows for.

    An environment takes some 10 MB, so that a row for each of MT10's five hundred tasks would fill a laptop. Starts are
    part of the tasks: a policy without noise plays every episode of a task alike, and one is enough.

    Args:
        agent: The policy.
        world: A ``MetaWorldWorld`` in autoreset mode DISABLED; it is left with other pools of tasks.
        episodes_per_task: Episodes of each task.
        seed: Passed to the world's resets.
    """
    check_world(world, episodes_per_task)
    at_once = min(rows.stop - rows.start for rows in world.slot_rows)
    parts: list[dict[str, np.ndarray]] = []
    for first in range(0, TASKS_PER_CLASS, at_once):
        pool = np.arange(first, min(first + at_once, TASKS_PER_CLASS))
        world.set_tasks({name: pool for name in world.task_names})
        played = play_tasks(agent, world, episodes_per_task, seed)
        parts.append(played | {"task": played["task"] + first})
    episodes = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return Evaluation(results_by_class(world.task_names, episodes), episodes_per_task)
