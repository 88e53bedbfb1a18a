"""Small runs of `bidex-meta run`."""

from bidex_meta.cli import main
from bidex_meta.runs import RunFolder

SMALL = ["--suite", "MT4", "--num-envs", "6", "--threads", "1", "--device", "cpu"]
SMALL += ["--learner.hidden", "8", "--learner.rollout-steps", "4", "--learner.num-minibatches", "2"]


def run(*arguments):
    """Train with small networks on a few environments; the exit code."""
    return main(["run", *SMALL, *map(str, arguments)])


def final(path):
    """The last checkpoint of a run."""
    loaded = RunFolder.open(path).checkpoints.load()
    assert loaded is not None
    return loaded
