"""Protocol of an evaluation: seeds, tasks and episodes, the same object for Python and for the commands."""

from dataclasses import dataclass, replace

from bidex_meta.errors import BidexError, shortened
from bidex_meta.suite import OTHERS, SPLITS
from bidex_meta.utils.validation import whole_number

EVALUATION_SEED = 1_000_000
"""Seed of the starts in evaluations. Nobody trains with it, so the starts are new to the policy."""
_LEAST = {
    "seed": 0, "tasks": 1, "episodes_per_task": 1, "shots": 0, "rollouts": 1, "trials": 1, "max_adapt_steps": 1
}  # fmt: skip
_MOST = 1_000_000


@dataclass(frozen=True)
class Protocol:
    """What an evaluation plays; ``evaluate`` and ``meta_evaluate`` take one, and the commands make one of their flags.

    Raises BidexError for an unknown split, or a number out of range.
    """

    split: str | None = None
    """Tasks of a world: ``train``, ``test``, or ``others``, which are as many tasks of the train classes, drawn by
    another seed, that no run trained on; see ``Benchmark.make_world``. None: those of the world that is given."""
    seed: int = EVALUATION_SEED
    """Seed of all starts."""
    tasks: int | None = None
    """The first so many tasks of each class; None: all."""
    episodes_per_task: int = 4
    """Evaluation episodes of each task, after each trial."""
    shots: int = 1
    """How often an agent that adapts does so, one after the other; ``evaluate`` plays without adaptation."""
    rollouts: int | None = None
    """Exploring episodes of each task in a shot; None: one in each environment that plays it."""
    trials: int = 1
    """How often each task is adapted to, from the start and with other episodes."""
    max_adapt_steps: int | None = None
    """Exploring episodes are cut (``truncated``) after so many steps; None: they are whole."""

    def __post_init__(self) -> None:
        splits = (*SPLITS, OTHERS)
        if self.split is not None and self.split not in splits:
            raise BidexError(f"split: expected one of {', '.join(splits)}, got {shortened(self.split)}.")
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is not None or name not in ("tasks", "rollouts", "max_adapt_steps"):
                whole_number(name, value, least, None if name in ("seed", "shots", "max_adapt_steps") else _MOST)

    def changed(self, **given: str | int | None) -> "Protocol":
        """Return the protocol with the entries that are given; None leaves an entry as it is."""
        return replace(self, **{name: value for name, value in given.items() if value is not None})
