"""`metaworld.evaluation` on environments of this benchmark: Meta-World's own functions, with our class names.

With several environments per class these functions count the first episodes that finish, and success ends an episode,
so easy tasks are counted more often than hard ones. `bidex_meta.evaluation` plays each task equally often.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from metaworld import evaluation as library
from metaworld.evaluation import Agent, MetaLearningAgent, Timestep

from bidex_meta.metaworld.adapters import MetaWorldEnvs

_CLASSES = "ALL_V3_ENVIRONMENTS"
Envs = MetaWorldEnvs | SyncVectorEnv | AsyncVectorEnv

__all__ = ["Agent", "MetaLearningAgent", "Timestep", "evaluation", "known_to_metaworld", "metalearning_evaluation"]


def evaluation(agent: Agent, eval_envs: Envs, num_episodes: int = 50) -> tuple[float, float, dict, dict]:
    """Return success rate and return over all classes, and both per class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.evaluation(agent, cast(SyncVectorEnv, eval_envs), num_episodes)


def metalearning_evaluation(agent: MetaLearningAgent, eval_envs: Envs, *args: int, **kwargs: int) -> tuple:
    """Return success rate and return after adaptation, and success per class; see Meta-World's function."""
    with known_to_metaworld(eval_envs):
        return library.metalearning_evaluation(agent, cast(SyncVectorEnv, eval_envs), *args, **kwargs)


@contextmanager
def known_to_metaworld(envs: Envs) -> Iterator[None]:
    """Make the class names of ``envs`` known to `metaworld.evaluation` within the ``with`` block.

    Meta-World's dict of classes is replaced by a larger copy and restored afterwards. The dict itself is not changed,
    because Meta-World's modules share it.
    """
    before = vars(library)[_CLASSES]
    ours = {str(name): type(str(name), (), {}) for name in envs.get_attr("task_name")}
    setattr(library, _CLASSES, {**before, **ours})
    try:
        yield
    finally:
        setattr(library, _CLASSES, before)
