"""Protocol of an evaluation: seeds, tasks and episodes. Python functions and the commands share it."""

from dataclasses import dataclass, replace

from bidex_meta.errors import BidexError, shortened
from bidex_meta.suite import OTHERS, SPLITS
from bidex_meta.utils.validation import whole_number

EVALUATION_SEED = 1_000_000
"""Seed of the starts in evaluations. Training does not use this seed, so the starts are new to the policy."""
_LEAST = {
    "seed": 0, "tasks": 1, "episodes_per_task": 1, "shots": 0, "rollouts": 1, "trials": 1, "max_adapt_steps": 1
}  # fmt: skip
_MOST = 1_000_000


@dataclass(frozen=True)
class Protocol:
    """The tasks and episodes of an evaluation, for ``evaluate``, ``meta_evaluate`` and the commands.

    Raises BidexError for an unknown split, or a number out of range.
    """

    split: str | None = None
    """Split that the tasks belong to: ``train``, ``test``, or ``others`` (the same number of unseen tasks of the train
    classes, drawn with another seed; see ``Benchmark.make_world``). None: the tasks of the given world."""
    seed: int = EVALUATION_SEED  # Seed of all starts.
    tasks: int | None = None  # Number of tasks of each class, the first of its pool; None: all.
    episodes_per_task: int = 4  # Evaluation episodes of each task, after each trial.
    shots: int = 2  # Number of adaptation rounds, one after the other; ``evaluate`` ignores it.
    rollouts: int | None = None
    """Exploring episodes of each task in a shot; None: one in each environment that has the task."""
    trials: int = 1  # Number of adaptations to each task, each from the unadapted policy and with new episodes.
    hidden_rewards: bool = False
    """Also play the evaluation episodes with their rewards hidden. Otherwise rewards are shown in all episodes, as in
    the papers: an agent that learns while it acts needs them. Episodes with hidden rewards test what the agent
    remembers."""
    max_adapt_steps: int | None = None
    """Number of steps after which exploring episodes are cut (``truncated``); None: they are not cut."""

    def __post_init__(self) -> None:
        splits = (*SPLITS, OTHERS)
        if self.split is not None and self.split not in splits:
            raise BidexError(f"split: expected one of {', '.join(splits)}, got {shortened(self.split)}.")
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is not None or name not in ("tasks", "rollouts", "max_adapt_steps"):
                whole_number(name, value, least, None if name in ("seed", "shots", "max_adapt_steps") else _MOST)

    def changed(self, **given: str | int | None) -> "Protocol":
        """Return the protocol with the given entries replaced; None leaves an entry unchanged."""
        return replace(self, **{name: value for name, value in given.items() if value is not None})
