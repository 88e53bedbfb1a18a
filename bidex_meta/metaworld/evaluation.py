"""`metaworld.evaluation` on environments of this benchmark: its own functions, given the names of our classes.

With several environments per class these functions count the first episodes that finish, and success ends an episode,
so easy tasks are counted more often than hard ones. `bidex_meta.evaluation` plays each task equally often.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from metaworld import evaluation as library
from metaworld.evaluation import Agent, MetaLearningAgent, Timestep

__all__ = ["Agent", "MetaLearningAgent", "Timestep", "evaluation", "known_to_metaworld", "metalearning_evaluation"]


def evaluation(agent: Agent, eval_envs: Any, num_episodes: int = 50) -> tuple[float, float, dict, dict]:
    """Return success rate and return over all classes, and both per class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.evaluation(agent, eval_envs, num_episodes)


def metalearning_evaluation(agent: MetaLearningAgent, eval_envs: Any, *args: Any, **kwargs: Any) -> tuple:
    """Return success rate and return after adaptation, and success per class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.metalearning_evaluation(agent, eval_envs, *args, **kwargs)


@contextmanager
def known_to_metaworld(envs: Any) -> Iterator[None]:
    """Add the classes of ``envs`` to the names in `metaworld.evaluation` (a copy: other modules share its dict)."""
    module: Any = library
    before = module.ALL_V3_ENVIRONMENTS
    ours: dict[str, Any] = {name: type(name, (), {}) for name in envs.get_attr("task_name")}
    module.ALL_V3_ENVIRONMENTS = {**before, **ours}
    try:
        yield
    finally:
        module.ALL_V3_ENVIRONMENTS = before
