"""Trials as episodes, for any recurrent learner: `TrialEnv` is one environment, `TrialWorld` a batched world.

A trial is a few episodes of one task with rewards shown, as in RL² (Duan et al. 2016). Each observation ends in the
last action, the last reward, and a flag that is 1 if the last step ended an episode. These entries are 0 at the start
of a trial.
"""

from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from gymnasium.vector.utils import batch_space
from torch import Tensor

from bidex_meta.benchmark import Benchmark
from bidex_meta.clients.gymnasium_ids import OF_SINGLES, both_seeds, make_suite_world
from bidex_meta.clients.needs import check_training
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.suite import SPLITS, Suite
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks.task import Task
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import World, checked
from bidex_meta.world.contract import Info, ObservationGroup, Options, State, Step
from bidex_meta.world.episodes import Clock, check_single_reset, ended_info
from bidex_meta.world.single_env import SuiteEnv
from bidex_meta.world.wrapper import PooledWorldWrapper

EPISODES = 3
"""Default number of episodes in a trial, as in the meta-test."""
_OF_EPISODES = ("episode", "_episode", "final_info", "_final_info")
_SUMS = ("r", "l", "unscaled")
_SEEDS = 2**31


class TrialWorld(PooledWorldWrapper):
    """A training world in which each episode is a trial: `world.episodes_per_task` episodes of one task.

    `TrialWorld(Benchmark("ML1-v2").make_world("train", 64, episodes_per_task=3))` is a `contract.VectorWorld` and can
    be passed to the other adapters, such as `SB3VecEnv`. Return and length are those of the trial; success is that of
    the trial's last episode. Within a trial, the next episode starts in the step that ends the previous one, and
    neither `terminated` nor `truncated` is set. The trial ends when its last episode ends, or when physics breaks.
    Staggered starts are switched off, so no episode is shortened; call `reset` before the first `step`.

    Raises BidexError for a world in another autoreset mode than SAME_STEP, one whose environments keep their tasks, or
    one that shows its goals.
    """

    world: World

    @checked_arguments
    def __init__(self, world: World) -> None:
        check_training(world, stagger=False)
        _check_hides(world.hides_goals, ", ".join(world.task_names))
        if not world.draws_tasks:
            raise BidexError(
                "Expected a world that draws a task for each trial, got one whose environments keep their tasks. Make "
                "it with episodes_per_task, also for trials of one episode."
            )
        super().__init__(world)
        self.episodes_per_task = world.episodes_per_task
        self.max_episode_steps = world.max_episode_steps * self.episodes_per_task
        self.single_observation_space = _extended(world.single_observation_space, world.single_action_space)
        self.observation_space = cast(Box, batch_space(self.single_observation_space, world.num_envs))
        known = slice(world.observation_size, world.observation_size + world.action_size + 2)
        self.observation_groups = (*world.observation_groups, ObservationGroup("last_step", (known,)))
        everywhere = torch.ones(world.num_envs, dtype=torch.bool, device=world.device)
        self._clock = Clock(world.num_envs, world.device)
        self._last = torch.zeros(world.num_envs, world.action_size + 2, device=world.device)
        self._sums: dict[str, Tensor] = {}
        self._forget(everywhere)
        self._begun = False

    @property
    def elapsed(self) -> Tensor:
        """Return the steps that each environment's running trial has lasted, int64 (num_envs,)."""
        return self._sums["l"] + self.world.episodes.elapsed

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start trials; see `VectorWorld.reset`."""
        obs, info = self.world.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool)
        mask = torch.as_tensor(mask, device=self.device)
        self._forget(mask)
        self._begun = True
        return self._begin(mask, obs, info)

    def step(self, action: Tensor | np.ndarray, /) -> Step:
        """Take actions; see `VectorWorld.step`. Raises BidexError before the first reset."""
        if not self._begun:
            raise BidexError("TrialWorld: expected reset() before step(), because no trial has begun.")
        is_last = self._episode_of_trial() == self.episodes_per_task - 1
        given, _ = checked.clean(checked.action(action, self.action_space.shape, self.device))
        obs, reward, terminated, truncated, own = self.world.step(action)
        ended = own["_final_obs"]
        over = ended & (is_last | own["unstable"])
        last = torch.cat((given, reward[:, None], ended[:, None].float()), dim=1)
        # The end of a trial is not marked, because its last observation has the value of an ongoing episode.
        final_last = torch.where(own["unstable"][:, None], self._last, last)
        final_last[:, -1] = final_last[:, -1].masked_fill(over & ~own["unstable"], 0.0)
        final = torch.cat((torch.where(over[:, None], own["final_obs"], obs), final_last), dim=1)
        info = {name: value for name, value in own.items() if name not in _OF_EPISODES}
        running = dict(own["running"])
        for name, before in self._sums.items():
            running[name] = running[name] + before
        info |= {"final_obs": final, "_final_obs": over, "running": running, "episode_mask": over}
        if _OF_EPISODES[0] in own:
            info |= ended_info(info)
            self._clock.stamp(info)
        self._last = last
        self._sums = {name: torch.where(ended, running[name], before) for name, before in self._sums.items()}
        self._forget(over)
        obs, more = self._begin(over, obs, info)
        return obs, reward, terminated & over, truncated & over, more

    def _episode_of_trial(self) -> Tensor:
        return self.world.episodes.number % self.episodes_per_task

    def _forget(self, mask: Tensor) -> None:
        """Clear what is stored about finished trials in the environments of ``mask``, where new trials begin.

        The stored values are the last step's action and reward, whether it ended an episode, the sums over the trial,
        and the clock.
        """
        self._clock.begin(mask)
        self._last = self._last.masked_fill(mask[:, None], 0.0)
        if not self._sums:
            self._sums = {name: torch.zeros(self.num_envs, device=self.device) for name in _SUMS}
            self._sums["l"] = self._sums["l"].long()
        self._sums = {name: value.masked_fill(mask, 0) for name, value in self._sums.items()}

    def _begin(self, mask: Tensor, obs: Tensor, info: Info) -> tuple[Tensor, Info]:
        """Finish the start of trials in the environments of ``mask``; return all observations and the info.

        If an environment has left its trial before the last episode, it is reset until a trial of another task begins.
        """
        while bool((left := mask & (self._episode_of_trial() > 0)).any()):
            obs, pictures = self.world.reset(options={"reset_mask": left})
            info = info | pictures
        return torch.cat((obs, self._last), dim=1), info

    def state_dict(self) -> State:
        """Return the state of the world and of its running trials, for a checkpoint."""
        trials = {"last": self._last, **self._sums}
        return {**super().state_dict(), "trials": {name: value.clone() for name, value in trials.items()}}

    def load_state_dict(self, state: State, /) -> None:
        """Restore a `state_dict` of a world of trials with the same settings."""
        own = {"trials": {"last": self._last, **self._sums}}
        checked.fits(state, own)
        super().load_state_dict(state)
        trials = {name: value.to(self.device, copy=True) for name, value in state["trials"].items()}
        self._last = trials.pop("last")
        self._sums = trials
        self._begun = True


class TrialEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of a suite with hidden goals, in which an episode is a whole trial; each reset draws a task.

    `suite` is a name, a file or a `Suite`; `split` is `"train"` or `"test"`; `episodes` is the number of episodes in a
    trial. All tasks of the split are equally likely; in a suite with `tasks_per_class = 0` the train split draws new
    tasks. `seed` chooses the tasks. It also seeds the order and the starts of the trials, until `reset(seed=...)` sets
    another seed. Without `seed`, the tasks are those of seed 0, and the trials differ from environment to environment.
    `render_mode` is None or `"rgb_array"`. `task` is the task of the running trial, and `max_episode_steps` is the
    length of the longest trial, that is, the sum of the time limits of its episodes.

    `info` has `success`, `unscaled_reward` and `unstable`. At the end of each episode it also has `episode_success`, by
    the suite's rule. At the end of the trial it also has `is_success`, the success of the last episode. The trial
    terminates or is truncated like its last episode, or ends when physics breaks. Raises BidexError for an unknown
    suite, split or render mode, and for a suite that shows its goals.
    """

    metadata = SuiteEnv.metadata

    @checked_arguments
    def __init__(
        self, suite: str | Path | Suite | None = None, split: str = "train", episodes: int = EPISODES,
        seed: int | None = None, render_mode: str | None = None
    ) -> None:  # fmt: skip
        task_seed, self._first_seed = both_seeds(seed)
        if suite is None:
            raise _no_suite()
        benchmark = Benchmark(suite, task_seed)
        _check_hides(benchmark.suite.observation == "masked", benchmark.name)
        if split not in SPLITS:
            raise unknown_name("split", split, SPLITS)
        if split == "train":
            classes = benchmark.train_classes
            self._tasks = benchmark.train_tasks
            self._draws_new = benchmark.suite.train_tasks == 0
        else:
            classes = benchmark.test_classes
            self._tasks = benchmark.test_tasks
            self._draws_new = False
        self.episodes = whole_number("episodes", episodes, 1, checked.MOST_EPISODES)
        self.render_mode = render_mode
        self._envs = {name: env_class(render_mode) for name, env_class in classes.items()}
        self.max_episode_steps = self.episodes * max(env.max_path_length for env in self._envs.values())
        self.task = self._tasks[0]
        self._env = self._envs[self.task.env_name]
        self.action_space = self._env.action_space
        self._num_actions = self._env.task_class.action_size
        self.observation_space = _extended(self._env.observation_space, self.action_space)
        self._left = 0  # number of episodes that the running trial has left

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Start a trial of another task; return an observation and an empty info. A seed always gives the same trial.

        There are no options.
        """
        check_single_reset(seed, options)
        if seed is None:
            seed = self._first_seed
        self._first_seed = None
        super().reset(seed=seed)
        self.task = self._drawn_task()
        self._env = self._envs[self.task.env_name]
        self._env.set_task(self.task)
        self._left = self.episodes
        self._last = np.zeros(self._num_actions + 2, np.float32)
        return self._seen(self._begin_episode()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Advance 1/60 s by an action (a,) in [-1, 1]; if an episode of the trial ends, begin the next one.

        Raises BidexError if no trial runs.
        """
        if self._left == 0:
            raise BidexError("Expected reset() before step(): there is no running trial.")
        obs, reward, terminated, truncated, info = self._env.step(action)
        self._solved = (self._solved or info["success"] > 0.0) and not info["unstable"]
        ended = terminated or truncated
        if ended:
            info["episode_success"] = self._solved
            self._left = 0 if info["unstable"] else self._left - 1
        over = ended and self._left == 0
        if over:
            info["is_success"] = self._solved
        elif ended:
            obs = self._begin_episode()
        if not info["unstable"]:
            # The end of a trial is not marked, because its last observation has the value of an ongoing episode.
            applied, _ = checked.clean(checked.one_row(action, self._env.action_space))
            self._last[:] = *applied[0], reward, ended and not over
        return self._seen(obs), reward, terminated and over, truncated and over, info

    def _drawn_task(self) -> Task:
        task = self._tasks[int(self.np_random.integers(len(self._tasks)))]
        if not self._draws_new:
            return task
        task_class = self._envs[task.env_name].task_class
        variation = task_class.variation_space.sample(self.np_random, 1)[0]
        return Task.from_variation(task.env_name, variation, task_class.instruction(variation, hidden=True))

    def _begin_episode(self) -> np.ndarray:
        self._solved = False
        obs, _ = self._env.reset(seed=int(self.np_random.integers(_SEEDS)))
        return obs

    def _seen(self, obs: np.ndarray) -> np.ndarray:
        return np.concatenate((obs, self._last), dtype=np.float32)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (height, width, 3), uint8; None without a render mode."""
        return self._env.render()

    def close(self) -> None:
        """Free the environments of all classes."""
        for env in self._envs.values():
            env.close()


def make_trials(
    suite: str | None = None, split: str = "train", episodes: int = EPISODES, num_envs: int = 1,
    seed: int | None = None, benchmark_seed: int | None = None, render_mode: str | None = None, **options: Any
) -> TrialWorld:  # fmt: skip
    """Make the world of `gymnasium.make_vec("bidex-meta/trials", num_envs=64, suite="ML1-v2")`.

    `episodes` is the number of episodes in a trial; other arguments are those of `make_suite_world`, without `stagger`.
    """
    if suite is None:
        raise _no_suite()
    chosen = load_suite(suite)
    _check_hides(chosen.observation == "masked", chosen.name)
    for name in options.keys() & OF_SINGLES:
        raise BidexError(f"{name}: expected options of a world for trials. Leave it out.")
    if options.pop("stagger", False):
        raise BidexError("stagger: expected False, because trials are not shortened. Leave it out.")
    options["episodes_per_task"] = episodes
    made = make_suite_world(suite, split, num_envs, seed, benchmark_seed, render_mode, **options)
    return TrialWorld(cast(World, made))  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all


def _extended(observation: Space, action: Space) -> Box:
    """Return the observation space with three further parts: last action, last reward, and flag of an episode's end."""
    assert isinstance(observation, Box) and isinstance(action, Box)
    low = (*observation.low, *action.low, -np.inf, 0.0)
    high = (*observation.high, *action.high, np.inf, 1.0)
    return Box(np.array(low, np.float32), np.array(high, np.float32))


def _no_suite() -> BidexError:
    return BidexError('suite: expected a suite that hides its goals, got none. Name one: suite="ML1-v2".')


def _check_hides(hides: bool, name: str) -> None:
    if not hides:
        raise BidexError(
            f"Expected a suite that hides its goals, for trials; {name} shows them. Name an ML suite (ML1-v2, ML5-v2, "
            "ML20-v2, ML1-CLASS-v2 for any class) or a file with masked observations."
        )
