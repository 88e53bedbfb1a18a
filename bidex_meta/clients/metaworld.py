"""Meta-World at arm's length: which of its suites there are, its tasks, and one of its environments.

The batched world made of these is ``clients/metaworld_world.py``. Nothing here needs torch, and Meta-World itself (a
foreign library with physics and rewards that no one here wrote) is imported only when something is made of it.
"""

import functools
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError, unknown_name

PREFIX = "metaworld/"
SUITES: dict[str, tuple[str, ...]] = {
    "metaworld/MT10": (
        "reach-v3",
        "push-v3",
        "pick-place-v3",
        "door-open-v3",
        "drawer-open-v3",
        "drawer-close-v3",
        "button-press-topdown-v3",
        "peg-insert-side-v3",
        "window-open-v3",
        "window-close-v3",
    ),
    # No suite of Meta-World's: three of its classes that are learned within minutes.
    "metaworld/MT3": ("reach-v3", "drawer-close-v3", "button-press-topdown-v3"),
}
"""The suites by name, and their classes in Meta-World's order."""

TASKS_PER_CLASS = 50
OBSERVATION_SIZE = 39
ACTION_SIZE = 4
EPISODE_STEPS = 500

_BROKEN = ("BADQPOS", "BADQVEL", "BADQACC", "CONTACTFULL", "CNSTRFULL")


def class_names(suite: str) -> tuple[str, ...]:
    """The classes of a suite.

    Raises:
        BidexError: There is no such suite of Meta-World's; with the nearest name and the list.
    """
    if suite not in SUITES:
        raise unknown_name("suite of Meta-World", suite, SUITES)
    return SUITES[suite]


@functools.lru_cache(
    maxsize=8
)  # drawing them resets each class fifty times: seconds that evaluation need not pay again
def make_tasks(suite: str, seed: int) -> dict[str, tuple[Any, ...]]:
    """Meta-World's own fifty tasks of each class of a suite, goal visible.

    Those of MT10 are ``metaworld.MT10(seed)``'s, those of MT3 ``metaworld.MT1(name, seed)``'s. Meta-World puts NumPy's
    global generator back to where it was.

    Args:
        suite: E.g. ``"metaworld/MT3"``.
        seed: A whole number from 0 on.

    Raises:
        BidexError: Unknown suite, or Meta-World is not installed.
    """
    names, library, seed = class_names(suite), _library(), seed % 2**32  # as far as NumPy's old generator can count
    made = [library.MT10(seed=seed)] if suite == "metaworld/MT10" else [library.MT1(name, seed=seed) for name in names]
    tasks = [task for benchmark in made for task in benchmark.train_tasks]
    return {name: tuple(task for task in tasks if task.env_name == name) for name in names}


class Single:
    """One environment of Meta-World's. An episode is a function of its task and actions: nothing of it is random.

    Args:
        name: Its class, e.g. ``"reach-v3"``.
    """

    def __init__(self, name: str) -> None:
        self._env = _library().ALL_V3_ENVIRONMENTS[name]()
        import mujoco

        self._broken = [int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in _BROKEN]

    def start(self, task: Any) -> np.ndarray:
        """Begins an episode of a task.

        Returns:
            Observation, shape (39,), float64: the goal in the last three entries.
        """
        self._env.set_task(task)
        return self._env.reset()[0]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """One control step of 1/80 s.

        Args:
            action: Shape (4,), float32, in [-1, 1]: displacement of the hand (× 0.01 m), gripper.

        Returns:
            Observation (39,), reward in [0, 10] by the formula "v2", success, and whether the physics broke.
        """
        obs, reward, _, _, info = self._env.step(action)
        # MuJoCo goes on from its default state after a bad number; only its counters tell.
        broken = bool(np.any(self._env.data.warning.number[self._broken]))
        broken = broken or not (np.isfinite(obs).all() and np.isfinite(reward))
        return obs, float(reward), bool(info["success"]), broken

    def close(self) -> None:
        """Frees the environment."""
        self._env.close()


@functools.cache
def _library() -> Any:
    """Meta-World, mended."""
    from bidex_meta.metaworld.mending import mended  # torch comes with it: not where suites are listed

    try:
        library = mended()
    except ModuleNotFoundError as error:
        raise BidexError(
            f"Expected Meta-World for a suite {PREFIX}..., but {error.name} is not installed. "
            "Mend: pip install metaworld==3.0.0"
        ) from None
    import mujoco

    # MuJoCo would print each broken row to stderr and a log file in the working folder; Single.step tells it.
    mujoco.set_mju_user_warning(_silent)
    return library


def _silent(message: str) -> None:
    """Swallows MuJoCo's warnings."""
