"""Meta-World's library, fixed for MuJoCo 4: its tasks and its environments, one at a time."""

import functools
from importlib import import_module
from types import ModuleType

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv

from bidex_meta.errors import BidexError
from bidex_meta.suite_files import metaworld_classes

TASKS_PER_CLASS = 50
OBSERVATION_SIZE = 39
ACTION_SIZE = 4
EPISODE_STEPS = 500

_WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)
_WARNINGS = ("BADQPOS", "BADQVEL", "BADQACC", "CONTACTFULL", "CNSTRFULL")
_BROKEN = [int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in _WARNINGS]


def mended() -> ModuleType:
    """Return Meta-World's module with its environments fixed; raise ModuleNotFoundError if it is not installed.

    Meta-World 3.0.0 sets the hand's weld by writing eleven numbers to a whole row of ``eq_data``. Since MuJoCo 3.17 a
    row has twelve entries, so no environment could be made. The fix writes the numbers to the first eleven entries.
    """
    import_module("metaworld.sawyer_xyz_env").SawyerMocapBase.reset_mocap_welds = _reset_mocap_welds
    return import_module("metaworld")


def _reset_mocap_welds(self: MujocoEnv) -> None:
    welds = np.flatnonzero(self.model.eq_type == mujoco.mjtEq.mjEQ_WELD)
    self.model.eq_data[welds, : len(_WELD)] = _WELD


@functools.cache
def _library() -> ModuleType:
    try:
        library = mended()
    except ModuleNotFoundError as error:
        fault = f"Expected Meta-World for a suite metaworld/..., but {error.name} is not installed"
        raise BidexError(f"{fault}. Fix it: pip install metaworld==3.0.0") from None
    # MuJoCo would print each broken environment to stderr and to a log file. Single.step reports it.
    mujoco.set_mju_user_warning(lambda message: None)
    return library


@functools.lru_cache(maxsize=8)  # drawing tasks resets each class 50 times, which takes seconds
def make_tasks(suite: str, seed: int) -> dict[str, tuple[object, ...]]:
    """Return Meta-World's 50 tasks of each class of a suite, e.g. ``"metaworld/MT3"``, goal visible.

    MT10's tasks come from ``metaworld.MT10(seed)``, other suites' from ``metaworld.MT1(name, seed)``. Raises BidexError
    for an unknown suite, or if Meta-World is not installed.
    """
    names = metaworld_classes(suite)
    library = _library()
    seed = seed % 2**32  # the range of NumPy's old generator
    if suite != "metaworld/MT10":
        return {name: tuple(library.MT1(name, seed=seed).train_tasks) for name in names}
    tasks = library.MT10(seed=seed).train_tasks
    return {name: tuple(task for task in tasks if task.env_name == name) for name in names}


class Single:
    """One environment of Meta-World's class ``name``."""

    def __init__(self, name: str) -> None:
        self._env = _library().ALL_V3_ENVIRONMENTS[name]()

    def start(self, task: object) -> np.ndarray:
        """Begin an episode of a task; return the observation (39,), float64, whose last three entries are the goal."""
        self._env.set_task(task)
        return self._env.reset()[0]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Apply an action (4,) for 1/80 s.

        Returns the observation (39,), the reward in [0, 10], whether the task is solved, and whether the physics broke.
        """
        obs, reward, _, _, info = self._env.step(action)
        # After an invalid number MuJoCo continues from its default state, and only its counters show this.
        broken = bool(np.any(self._env.data.warning.number[_BROKEN]))
        broken = broken or not (np.isfinite(obs).all() and np.isfinite(reward))
        return obs, float(reward), bool(info["success"]), broken

    def close(self) -> None:
        """Free the environment."""
        self._env.close()
