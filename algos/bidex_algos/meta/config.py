"""The options of every gradient-based meta-learner; imports no torch, so that a command line can show them quickly."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from bidex_algos.meta.adaptation import Adapted, StepSizeKind
from bidex_algos.nets.architecture import Options, network_bytes
from bidex_algos.nets.networks import Activation, Layers
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import LearnerConfig
from bidex_meta.utils.validation import Count, Fraction, Positive, check_rising

USUAL_STEPS = 300
"""Assumed number of steps per episode in estimates of memory, if the length of episodes is not known yet."""


@dataclass(frozen=True)
class MetaConfig(LearnerConfig):
    """Options of the policy, sampling and inner steps; the defaults are the preset ``laptop``."""

    hidden: Layers = (128, 128)  # Widths of the policy's hidden layers.
    activation: Activation = "tanh"  # Non-linearity of the hidden layers.
    init_std: Positive = 0.8  # Initial standard deviation of the actions; adaptation changes it if adapted is all.
    std_range: tuple[Positive, Positive] = (0.1, 1.5)  # Bounds of the standard deviation of the actions.
    tasks_per_class: Count = 3
    """Tasks of each class in a meta-batch, drawn again for each meta-batch; fewer if a class has fewer. The class's
    environments are divided among these tasks, and each environment plays one rollout."""
    max_adapt_steps: Count | None = None  # Steps after which an adaptation episode is cut; None: whole episodes.
    slice_steps: Count | None = None
    """Adapt on this number of steps of running episodes, as Bi-DexHands did; None: adapt on whole episodes."""
    inner_steps: Count = 1  # Adaptation steps before the outer objective is measured.
    inner_learning_rate: Positive = 0.1  # Size of an adaptation step.
    adapted: Adapted = "all"
    """Parameters that adaptation changes: all, or only the output layer of the mean (ANIL, Raghu et al. 2020)."""
    step_sizes: StepSizeKind = "fixed"
    """Inner step sizes that the outer step learns, starting from inner_learning_rate: one per tensor (layer, MAML++),
    one per weight (Meta-SGD), or none (fixed)."""
    step_size_rate: Positive = 0.01
    """Adam's step size for learned inner step sizes, relative to inner_learning_rate. A trust-region step moves the
    inner step sizes together with all other parameters."""
    advantage_scale: Literal["std", "variance"] = "std"
    """Divisor of the advantages in each task. With the variance, as in garage and Meta-World's baselines, the inner
    step depends on the scale of the rewards."""
    first_order: bool = False  # Leave out the second derivatives of the inner step.
    gamma: Fraction = 0.95  # Discount factor per step.
    lam: Fraction = 1.0  # Lambda of generalised advantage estimation.
    normalise_observations: bool = True
    """Normalise observations to zero mean and unit variance with running statistics."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "std_range")

    def check_environments(self, num_envs: int, tasks: Mapping[str, int]) -> None:
        """Raise BidexError if a class has fewer environments than tasks of a meta-batch."""
        for name, rows in self.environments_of(num_envs, tasks).items():
            batch = min(self.tasks_per_class, tasks[name] or self.tasks_per_class)
            if rows < batch:
                raise BidexError(
                    f"{self.algo}: {name} has {rows} environments for {batch} tasks of a meta-batch. Use num_envs of "
                    f"at least {batch * len(tasks)}, or lower tasks_per_class."
                )

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        steps = (self.slice_steps or self.max_adapt_steps or USUAL_STEPS) * (1 + self.inner_steps)
        return 4 * num_envs * width * steps + network_bytes(self.hidden, width, 2)


@dataclass(frozen=True)
class OuterConfig(MetaConfig):
    """Options of the outer step."""

    outer_learning_rate: Positive = 1e-3  # Adam's step size for the meta-parameters, at the beginning.
    max_grad_norm: Positive = 1.0  # Meta-gradients are clipped to this norm before a step of Adam.


# These values are from Table 48 of the Bi-DexHands appendix (ProMP), except the outer step. Rollouts there are eight
# steps of running episodes, and the inner step changes the weights too little to matter.
TABLE_48: Options = {
    "hidden": (2048, 1024, 512), "activation": "elu", "init_std": 1.0, "slice_steps": 8, "inner_steps": 1,
    "inner_learning_rate": 3e-4, "gamma": 0.9, "lam": 0.95, "normalise_observations": False,
}  # fmt: skip

# This preset is for policies that MT-PPO's preset laptop has trained on the same tasks (--start-from), and has the same
# network and discount. Before any meta-training (seed 0) we measured the return on ML1-wide's held-out task 8 after
# five shots of 100 episodes. With inner steps of 0.05 it rose by 2.2 (0.02: 0.8; 0.1: it fell), for all layers and for
# the head only. It rose by 1.7 with a trace of 0.95, and by 0.0 with 0.7.
TUNED: Options = {
    "hidden": (256, 256, 128), "activation": "elu", "std_range": (0.05, 1.5), "adapted": "head",
    "inner_learning_rate": 0.05, "gamma": 0.93, "lam": 0.9,
}  # fmt: skip

# This preset is the same for test tasks of unseen classes (ML4, ML20), with smaller steps and whole episodes. In
# docs/results/ml20.md LiftUnderarm lost 317 of return when it adapted to the first 150 of its 500 steps, and gained 352
# with all steps.
UNSEEN: Options = TUNED | {"inner_learning_rate": 0.01, "max_adapt_steps": 500, "tasks_per_class": 1}

# This preset is for version 2 of the suites (docs/results/ladder.md), from scratch or from a policy of MT-PPO's preset
# v2. The discount covers a whole episode of 250 steps; low noise lets the policy hold still, as success requires. The
# same step size changes a narrow distribution more. From a blind policy of a door (seed 1000), one inner step of 0.05
# lost return in ProMP's meta-batches (six or seven episodes per task). With 15 episodes per task, two steps of 0.02
# raised the return from 147 to 165, and two steps of 0.01 raised it to 157.
V2: Options = TUNED | {"gamma": 0.99, "init_std": 0.3, "step_sizes": "layer", "inner_learning_rate": 0.02}
