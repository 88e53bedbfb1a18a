"""Multi-task and meta reinforcement learning for two dexterous hands on MuJoCo.

    from bidex_meta import Benchmark, RunConfig, evaluate, train
    world = Benchmark("MT4-v2", seed=0).make_world("train", num_envs=1024)
    run = train(RunConfig(suite="MT4-v2", algo="mtppo", minutes=5))
    print(evaluate(run).success)

Importing the package registers the Gymnasium ids (`bidex-meta/MT4-v1`, ...), shortens the time that waiting OpenMP
threads spin (docs/troubleshooting.md#slow-runs-and-poor-results) and lets CUDA use 32 queues. Torch and MuJoCo are
loaded when a name that needs them is first used.
"""

import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from bidex_meta.clients.gymnasium_ids import register_ids
from bidex_meta.errors import BidexError
from bidex_meta.suite import Suite
from bidex_meta.suite_files import load_suite, suite_names
from bidex_meta.utils.gl_backend import set_aside_what_is_missing

if TYPE_CHECKING:
    from bidex_meta.benchmark import Benchmark, make_task_world
    from bidex_meta.config import RunConfig
    from bidex_meta.experiments.evaluating import evaluate, meta_test
    from bidex_meta.experiments.learners import learner_class
    from bidex_meta.experiments.plotting import plot
    from bidex_meta.experiments.policies import load_policy
    from bidex_meta.experiments.recording import RecordConfig, record
    from bidex_meta.experiments.sweep_plan import SweepPlan
    from bidex_meta.experiments.sweeping import sweep
    from bidex_meta.experiments.training import train
    from bidex_meta.experiments.transferring import transfer
    from bidex_meta.experiments.verifying import verify
    from bidex_meta.runs import RunFolder
    from bidex_meta.tasks.task import Task
    from bidex_meta.world import World

__all__ = [
    "Benchmark", "BidexError", "RecordConfig", "RunConfig", "RunFolder", "Suite", "SweepPlan", "Task", "World",
    "__version__", "evaluate", "learner_class", "load_policy", "load_suite", "make_task_world", "meta_test", "plot",
    "record", "suite_names", "sweep", "train", "transfer", "verify",
]  # fmt: skip

_LAZY = {
    "Benchmark": "bidex_meta.benchmark",
    "RecordConfig": "bidex_meta.experiments.recording",
    "RunConfig": "bidex_meta.config",
    "RunFolder": "bidex_meta.runs",
    "SweepPlan": "bidex_meta.experiments.sweep_plan",
    "Task": "bidex_meta.tasks.task",
    "World": "bidex_meta.world",
    "evaluate": "bidex_meta.experiments.evaluating",
    "learner_class": "bidex_meta.experiments.learners",
    "load_policy": "bidex_meta.experiments.policies",
    "make_task_world": "bidex_meta.benchmark",
    "meta_test": "bidex_meta.experiments.evaluating",
    "plot": "bidex_meta.experiments.plotting",
    "record": "bidex_meta.experiments.recording",
    "sweep": "bidex_meta.experiments.sweeping",
    "train": "bidex_meta.experiments.training",
    "transfer": "bidex_meta.experiments.transferring",
    "verify": "bidex_meta.experiments.verifying",
}

try:
    __version__ = version("bidex-meta")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0.0.0"

if "OMP_WAIT_POLICY" not in os.environ:
    # A waiting thread that spins takes a core from other work. torch reads these settings once, when it loads its
    # OpenMP library: the first is a number of spins for GNU's library, the second is in milliseconds for LLVM's and
    # Intel's.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    os.environ.setdefault("KMP_BLOCKTIME", "1")
# Groups of classes that step at the same time need one queue each. CUDA reads this setting once, before its first call.
os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")

set_aside_what_is_missing()
register_ids()


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
