"""`metaworld.evaluation` on environments of this benchmark: its own functions, given the names of our classes.

With several environments of a class they count the first episodes that finish, and success ends an episode, so that
easy tasks crowd out hard ones. `bidex_meta.evaluation` plays each task equally often.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from metaworld import evaluation as library
from metaworld.evaluation import Agent, MetaLearningAgent, Timestep

__all__ = ["Agent", "MetaLearningAgent", "Timestep", "evaluation", "known_to_metaworld", "metalearning_evaluation"]


def evaluation(agent: Agent, eval_envs: Any, num_episodes: int = 50) -> tuple[float, float, dict, dict]:
    """Success rate and return over the classes, and both of each class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.evaluation(agent, eval_envs, num_episodes)


def metalearning_evaluation(agent: MetaLearningAgent, eval_envs: Any, *args: Any, **kwargs: Any) -> tuple:
    """Success rate and return after adaptation, and success of each class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.metalearning_evaluation(agent, eval_envs, *args, **kwargs)


@contextmanager
def known_to_metaworld(envs: Any) -> Iterator[None]:
    """Adds an ``envs``' classes to the names in `metaworld.evaluation` (a copy: others share its dict)."""
    module: Any = library
    before = module.ALL_V3_ENVIRONMENTS
    ours: dict[str, Any] = {name: type(name, (), {}) for name in envs.get_attr("task_name")}
    module.ALL_V3_ENVIRONMENTS = {**before, **ours}
    try:
        yield
    finally:
        module.ALL_V3_ENVIRONMENTS = before
