"""Meta-World's interface for the classes of this benchmark: Meta-World code needs only other imports and names.

docs/metaworld.md lists the differences and the speed. MuJoCo 4 breaks Meta-World's own environments; importing this
module fixes them in this process (``library.mended``). It also registers `Benchmark` as a subclass of Meta-World's
class of that name.
"""

from contextlib import suppress

from bidex_meta.benchmark import Benchmark
from bidex_meta.metaworld.benchmarks import ML1, ML4, ML20, MT1, MT4, MT20, CustomML, CustomMT
from bidex_meta.metaworld.library import mended
from bidex_meta.metaworld.vector_envs import make_ml_envs, make_ml_envs_test, make_ml_envs_train, make_mt_envs
from bidex_meta.tasks.task import Task

with suppress(ModuleNotFoundError):
    mended().Benchmark.register(Benchmark)

__all__ = [
    "ML1", "ML4", "ML20", "MT1", "MT4", "MT20", "Benchmark", "CustomML", "CustomMT", "Task",
    "make_ml_envs", "make_ml_envs_test", "make_ml_envs_train", "make_mt_envs",
]  # fmt: skip

_ABSENT = {"MT10": "MT4 or MT20", "MT25": "MT20", "MT50": "MT20", "ML10": "ML4 or ML20", "ML25": "ML20", "ML45": "ML20"}
_CLASSES = "ALL_V3_ENVIRONMENTS"


def __getattr__(name: str) -> object:
    """Return one of Meta-World's wrappers by name, or all our classes for ``ALL_V3_ENVIRONMENTS``.

    For other names of Meta-World's suites and classes, an AttributeError is raised that names our alternative.
    """
    if name == _CLASSES:
        return {task: MT1(task).train_classes[task] for task in MT1.ENV_NAMES}
    if name in _ABSENT:
        raise AttributeError(f"{name} has Meta-World's own classes. Here there is {_ABSENT[name]}.")
    if name.startswith(_CLASSES):
        raise AttributeError(f"{name} is not here: MT1(name) shows the goal and ML1(name) hides it.")
    wrappers = mended().wrappers
    if name.startswith("_") or not hasattr(wrappers, name):
        raise AttributeError(f"bidex_meta.metaworld has no {name!r}; docs/metaworld.md says what it has.")
    return getattr(wrappers, name)
