"""Single environments of a suite's task classes, used like Meta-World's: `env = cls()`, then `env.set_task(task)`.

They serve code that was written for Meta-World; `Benchmark.make_world` makes all environments of a suite at once.
"""

import copyreg
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Protocol

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box

from bidex_meta.errors import BidexError
from bidex_meta.rules import CONTROL_RATE, V1, Randomisation, Rules, versioned_name
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.task import Task
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Count, Pixels, Whole, true_or_false, whole_number
from bidex_meta.world.checked import one_row
from bidex_meta.world.config import WorldConfig
from bidex_meta.world.contract import Info, Options
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.episodes import check_single_reset
from bidex_meta.world.groups import Slot
from bidex_meta.world.rendering import CAMERAS
from bidex_meta.world.world import World

_FAR = 2**31


class AnyTask(Protocol):
    """The part of a task (`bidex_meta.Task`, or Meta-World's) that `set_task` reads."""

    @property
    def env_name(self) -> str:
        """Name of the task's class."""
        ...

    @property
    def data(self) -> bytes:
        """Variation of the task, as in `bidex_meta.Task`."""
        ...


@dataclass(frozen=True)
class EnvRecipe:
    """A task class with the settings of its suite that determine observations and rewards."""

    name: str
    moving_base: bool | None
    """True if the hands' bases move, False if they are fixed, None for the class's default."""
    options: tuple[tuple[str, float | str], ...]
    padded_size: int
    """Number of entries of an observation, without a point cloud."""
    hides_goal: bool
    reward_scale: float
    class_name: str | None = None
    """Name of the task class if it differs from ``name``, which may contain the name of an object."""
    rules: Rules = V1
    """The suite's rules."""
    points: tuple[int, bool] = (0, False)
    """Number of points of the cloud that replaces objects' states (0: no cloud), and whether points have kinds."""
    listed: bool = False
    """True if the suite's file lists the tasks; these may lie outside of the class's variation space."""
    touch: bool = False
    """True if observations show touch sensors."""
    randomisation: Randomisation | None = None
    """Randomisation of the environments; None: nothing is randomised."""

    @property
    def env_name(self) -> str:
        """Return the name by which tasks refer to the class; with the rules of version 2 it ends in ``-v2``."""
        return versioned_name(self.name, self.rules)

    def make_class(self) -> type["SuiteEnv"]:
        """Return the environment class; equal recipes give the same class object."""
        return _make_class(self)


class _Remade(type):
    """Metaclass of classes that are made at run time and are in no module; they are pickled as their ``EnvRecipe``."""


def _reduced(made: _Remade) -> str | tuple[Callable[..., _Remade], tuple[EnvRecipe]]:
    recipe = vars(made).get("recipe")
    if recipe is None:
        return made.__qualname__  # the class is one of the module's own
    return _make_class, (recipe,)


copyreg.pickle(_Remade, _reduced)


class SuiteEnv(gymnasium.Env[np.ndarray, np.ndarray], metaclass=_Remade):
    """A task class as an environment that plays the task it is given; its subclasses are listed in `train_classes`.

    Classes and environments can be pickled and copied: a copy has the same task and continues bit for bit.

    Observations are those of the suite's worlds without the one-hot: they are padded to the suite's widest class, and
    goal entries are zero if the suite hides goals. If the suite shows point clouds, a cloud follows and replaces the
    objects' states. `info` has `success` (1.0 or 0.0), `unscaled_reward` and `unstable` (physics broke: the episode is
    truncated). In version 1 `success` says whether the goal is met in this state. In version 2 success counts at the
    end of an episode, so that `success` is 0.0 before the last step. An episode is a success if any of its steps has
    `success` 1.0 and its physics did not break.

    The suite's randomisation applies to the classes in `train_classes`. `max_episode_steps` shortens the time limit of
    episodes; in version 2 success is then judged at this limit.

    `render_mode` is None or `"rgb_array"`. `camera_name` is `"front"` (default), `"side"`, `"top"` or `"back"`;
    `camera_id` may give its index in this list instead. Pictures have `width` x `height` pixels. There is only the
    suite's reward: `reward_function_version` must be `"v2"`, Meta-World's default. Raises BidexError for other values.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_RATE}  # noqa: RUF012  (Gymnasium's own convention)
    recipe: ClassVar[EnvRecipe]
    task_class: ClassVar[TaskClass]
    """The task class, which defines scene, variations, observation, reward and success."""

    @checked_arguments
    def __init__(
        self,
        render_mode: str | None = None,
        camera_name: str | None = None,
        camera_id: Whole | None = None,
        width: Pixels = 480,
        height: Pixels = 480,
        reward_function_version: str = "v2",
        max_episode_steps: Count | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise BidexError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}.")
        if reward_function_version != "v2":
            raise BidexError(
                "reward_function_version: expected 'v2', which stands for the suite's reward, the only one here; got "
                f"{reward_function_version!r}."
            )
        self.render_mode = render_mode
        self._picture = (width, height, _camera(camera_name, camera_id))
        self._limit = self.task_class.episode_steps
        if max_episode_steps is not None:
            self._limit = min(self._limit, max_episode_steps)
        recipe = self.recipe
        space = self.task_class.variation_space
        slot = Slot(recipe.name, self.task_class, np.array([space.low]), recipe.reward_scale)
        points = PointsRule(*recipe.points) if recipe.points[0] else None
        config = WorldConfig(
            num_envs=1,
            engine="c",
            threads=1,
            autoreset_mode="DISABLED",
            observation="masked" if recipe.hides_goal else "plain",
            pad_to=recipe.padded_size,
            points=points,
            randomisation=recipe.randomisation,
        )
        self._world = World([slot], config)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self.goal_space = Box(np.array(space.low), np.array(space.high), dtype=np.float64)
        self.terminate_on_success = False
        self._task: Task | None = None
        self._given: Task | None = None  # the task waits for the next reset
        self._begun = False
        self._over = True

    @property
    def task_name(self) -> str:
        """Return the name by which tasks refer to the class; with the rules of version 2 it ends in ``-v2``."""
        return self.recipe.env_name

    @property
    def max_path_length(self) -> int:
        """Return the time limit of an episode, steps of 1/60 s."""
        return self._limit

    def seed(self, seed: int) -> list[int]:
        """Seed the random numbers of starts and wrappers, as `reset(seed=...)` does, and those of the spaces."""
        seed = whole_number("seed", seed, 0)
        super().reset(seed=seed)
        for space in (self.action_space, self.observation_space, self.goal_space):
            space.seed(seed)
        return [seed]

    @checked_arguments
    def set_task(self, task: AnyTask) -> None:
        """Set one of the benchmark's tasks of this class; the next reset begins to play it.

        Raises BidexError for a task of another class or version, or with a variation of another size or range.
        """
        name = self.recipe.env_name
        if task.env_name != name:
            raise BidexError(
                f"Expected a task of {name}, got one of {task.env_name}. Take tasks and classes of one benchmark."
            )
        space = self.task_class.variation_space
        given = Task(name, task.data)
        variation = given.variation
        if variation.shape != (space.size,):
            raise BidexError(f"Expected a task of {space.size} numbers, got {variation.shape}.")
        if not self.recipe.listed and not space.contains(variation):
            outside = next(i for i in range(space.size) if not space.low[i] <= variation[i] <= space.high[i])
            raise BidexError(
                f"Expected a task of {name} with {space.names[outside]} from {space.low[outside]:g} to "
                f"{space.high[outside]:g}, got {variation[outside]:g}. Take tasks and classes of one benchmark."
            )
        self._given = given

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Start an episode; return observation (d,), float32, and an empty info. A seed always gives the same episode.

        Raises BidexError if no task was set, and for any options.
        """
        check_single_reset(seed, options)
        super().reset(seed=seed)
        if self._given is not None:
            self._world.set_tasks({self.recipe.name: self._given.variation[None]})
            self._task = self._given
            self._given = None
        if self._task is None:
            raise BidexError(f"{self.recipe.name}: expected set_task(task) before reset().")
        drawn: int | None = int(self.np_random.integers(_FAR))
        rule = self.recipe.randomisation
        if self._begun and seed is None and rule is not None and rule.draw == "environment":
            drawn = None  # the world draws on, and keeps what it has drawn for this environment
        obs, _ = self._world.reset(seed=drawn)
        self._begun = True
        self._over = False
        return _array(obs), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Make one control step of 1/60 s under an action (a,) in [-1, 1].

        Returns observation (d,), float32, reward, terminated (the task failed, e.g. an egg dropped; with
        `terminate_on_success` also after success), truncated (time is up, or physics broke), and info. In version 2
        success counts only when the episode ends, so `terminate_on_success` shortens no episode. Raises BidexError if
        no episode runs.
        """
        if self._over:
            raise BidexError(f"{self.recipe.name}: expected set_task(task) and reset() before step().")
        obs, reward, terminated, truncated, info = self._world.step(one_row(action, self.action_space))
        cut = bool(truncated) or int(self._world.episodes.length) >= self._limit
        ended = bool(terminated) or cut
        success = bool(info["success"]) and (ended or not self._world.success_at_end)
        lost = bool(terminated) or (self.terminate_on_success and success)
        self._over = lost or cut
        step_info = {"success": float(success), "unscaled_reward": float(info["reward_unscaled"])}
        step_info["unstable"] = bool(info["unstable"])
        return _array(obs), float(reward), lost, cut and not lost, step_info

    def toggle_terminate_on_success(self, on: bool) -> None:
        """Set whether an episode ends at its first success; in version 2 no success comes before the time limit."""
        self.terminate_on_success = true_or_false("on", on)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture, shape (height, width, 3), uint8; None without a render mode."""
        width, height, camera = self._picture
        if self.render_mode is None:
            return None
        return self._world.render(0, width, height, camera)

    def close(self) -> None:
        """Free the world."""
        self._world.close()


@cache
def _make_class(recipe: EnvRecipe) -> type[SuiteEnv]:
    name = recipe.class_name or recipe.name
    task_class = registry.get(name, recipe.moving_base, recipe.touch, **dict(recipe.options))
    task_class.adopt(recipe.rules)
    text = f"{task_class.instruction()}."
    return _Remade(recipe.env_name, (SuiteEnv,), {"recipe": recipe, "task_class": task_class, "__doc__": text})


def _camera(name: str | None, number: int | None) -> str:
    names = list(CAMERAS)
    if number is None and name is None:
        return names[0]
    if number is None and name in names:
        return name
    if number is not None and number < len(names):
        return names[number]
    raise BidexError(f"Expected a camera among {', '.join(names)}, got {name if number is None else number!r}.")


def _array(batch: torch.Tensor) -> np.ndarray:
    return batch[0].cpu().numpy()
