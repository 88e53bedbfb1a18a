"""Options and presets of in-context learning."""

from dataclasses import dataclass
from typing import Literal

from bidex_algos.meta.config import USUAL_STEPS
from bidex_algos.nets.architecture import network_bytes
from bidex_algos.nets.networks import Activation, Autocast, Layers
from bidex_meta.training.learner import LearnerConfig
from bidex_meta.utils.validation import Count, Fraction, Positive, Whole, Widths

_USUAL_HIDDEN = 6  # entries of a goal, for an estimate of the memory; no class hides more


@dataclass(frozen=True)
class ICLConfig(LearnerConfig):
    """All options of in-context learning; the defaults are the preset ``laptop``."""

    hidden: Widths = (256, 128)  # Widths of the layers of the reward model that encode the observation.
    activation: Activation = "elu"  # Non-linearity of the hidden layers.
    candidates: Count = 512  # Number of candidate goals; the belief gives each candidate a probability.
    trust: Fraction = 0.05  # Factor of each log-likelihood, small because the errors of successive steps correlate.
    head: Layers = (512, 512)  # Widths of the actor's hidden layers.
    actor: Literal["own", "teacher"] = "own"
    """Source of the actions: a network that imitates the teachers, or the teacher's own policy. For this policy, a
    network predicts the entries of the observation that the suite hides. It needs a single run as --teacher."""
    init_std: Positive = 0.05  # Standard deviation of the actions in exploring episodes.
    episodes_per_trial: Count = 3  # Episodes that share one memory: the adaptation episodes, and one more.
    max_adapt_steps: Count | None = None  # Steps after which an episode of a trial is cut; None: whole episodes.
    still_share: Fraction = 0.3  # Share of the episodes in which the policy does not explore, as in an evaluation.
    try_steps: Count = 50  # Mean number of steps for which an exploring policy acts on the same goal.
    reward_unit: Positive = 0.3
    """The policy reads a reward as asinh(reward / reward_unit), normalised by running statistics."""
    updates_per_iteration: Count = 50  # Updates after each trial.
    batch_size: Count = 1024  # Steps per update, split evenly over the classes with a teacher.
    goals: Count = 8  # Number of goals, drawn in each step, for which rewards are computed besides the task's own.
    trials: Count = 1024  # Trials that each process keeps; the oldest are overwritten first.
    learning_rate: Positive = 1e-3  # Adam's step size.
    decay_steps: Whole = 0
    """Environment steps over which the step size falls linearly to a twentieth of learning_rate; 0: it is constant."""
    max_grad_norm: Positive = 1.0  # Gradients are clipped to this norm, separately for actor and model.
    teacher_steps: Whole = 300_000
    """Environment steps over which the share of trials in which the teacher acts falls from 1 to 0."""
    normalise_observations: bool = True  # Give observations zero mean and unit variance by running statistics.
    autocast: Autocast = "auto"
    """Use bfloat16 in hidden layers during updates; auto: on CUDA and on CPUs with AMX or AVX-512's BF16."""

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        steps = self.episodes_per_trial * min(self.max_adapt_steps or USUAL_STEPS, USUAL_STEPS)
        width += _USUAL_HIDDEN * (1 + self.goals)
        kept = (4 * num_envs + 2 * max(self.trials, num_envs)) * width * steps
        return kept + network_bytes(self.head, width, 1)


PRESETS: dict[str, ICLConfig] = {
    "laptop": ICLConfig(),
    # This preset is for 4,096 to 8,192 environments on a GPU. The values were never tried. They follow by the rules
    # below from preset laptop and from the ladder's runs with 64 environments (results/sweeps/ladder-rung0.toml).
    "gpu": ICLConfig(
        batch_size=16384,  # 16 times laptop's, for 64 times the steps, so each step is seen a quarter as often
        updates_per_iteration=200,  # the same number of Adam steps per trial as in the ladder's runs
        learning_rate=2e-3,  # twice laptop's; with the square root of the batch size it would be 4 times laptop's
        teacher_steps=6_000_000,  # two trials of 4,096 environments; the ladder's 100,000 are two trials of 64
        trials=16384,  # four trials of each of 4,096 environments take 12 GB; at least one is kept
    ),
}  # fmt: skip
