"""BRC: "bigger, regularised, categorical" (Nauman et al. 2025, arXiv 2505.23150): SAC on all tasks with large critics.

Targets are r + gamma (1 - terminated) (Z'(s', a') - alpha log pi(a'|s')), with Z' the mean of both critics'
distributions. The critics are wide residual networks. Rewards are divided by their task's largest return (equation 2 of
the paper). The networks read the task as a learned vector of unit norm. Everything else is described in ``mtsac.py``
and ``categorical.py``; see ``docs/learners/brc.md``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from bidex_algos.advantages import discounts
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, Layers, linear
from bidex_algos.nets.policy import squashed_policy
from bidex_algos.offpolicy.categorical import Categorical, CategoricalConfig, check_residual
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.replay import Transitions
from bidex_meta.utils.validation import Count, Finite, NonNegative, Share, Whole


class ResidualBlock(nn.Module):
    """Residual block: x plus the output of two layers on x.

    Each layer has a layer norm, and the non-linearity is between the layers. All widths are equal.
    """

    def __init__(self, width: int, generator: torch.Generator, activation: Activation):
        super().__init__()
        first, second = (linear(width, width, math.sqrt(2.0), generator) for _ in range(2))
        norms = nn.LayerNorm(width), nn.LayerNorm(width)
        self.layers = nn.Sequential(first, norms[0], ACTIVATIONS[activation](), second, norms[1])

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, width) to (batch, width)."""
        return x + self.layers(x)


class ResidualMLP(MLP):
    """One normalised layer followed by residual blocks; replaces :class:`MLP` and takes its arguments.

    ``hidden`` lists one width several times: once for the first layer and once for each block. The layer norm is always
    used; ``layer_norm`` has no effect.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = True
    ):  # fmt: skip
        super().__init__(inputs, hidden[:1], outputs, output_gain, generator, activation, layer_norm=True)
        self.body.extend(ResidualBlock(width, generator, activation) for width in hidden[1:])


@dataclass(frozen=True)
class BRCConfig(CategoricalConfig, MTSACConfig):
    """All options of BRC; the defaults are the preset ``laptop``."""

    critic_hidden: Layers = (256, 256, 256)
    """Width of the critics' layers, once for the first layer and once for each residual block of two layers."""
    hidden: Layers = (256, 256)  # Width of the actor's layers, listed as in critic_hidden.
    value_heads: bool = False  # Give each critic one distribution per task instead of one for all.
    task_embedding: Whole = 32
    """Size of a learned vector that each network reads instead of the task's one-hot; 0: networks read the one-hot."""
    updates_per_step: Count = 4  # Updates of all networks after each vector step.
    n_steps: Count = 3  # Number of steps whose rewards a target sums before it adds the value of the next state.
    tau: Share = 0.05  # Share of the critics that enters the target critics in each update (1 - Polyak's factor).
    clipped_double_q: bool = False  # Targets and actor use the critic with the lower value; off: the mean of both.
    weight_decay: NonNegative = 1e-4  # Weight decay of AdamW, relative to the step size; 0: Adam.
    target_entropy_per_action: Finite = -0.5
    """Target of the temperatures: entropy of the squashed policy per entry of the action. Uniform actions have 0.69."""
    one_temperature: bool = False  # Use one temperature for all tasks, which adapts to their mean entropy.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_residual(self)


PRESETS: dict[str, BRCConfig] = {
    # The values are from the authors' code (github.com/naumix/BiggerRegularizedCategorical, 2025): train.py,
    # jaxrl/agent/brc_learner.py and jaxrl/networks.py. There each task has one environment, a warm-up of 5,000
    # transitions and a replay of 1,000,000; the same numbers result here with 256 environments per task. Log standard
    # deviations range from -10 to 2 and start in the middle. The decay is AdamW's default there, 1e-4. The gradient has
    # no limit (here a huge one), and observations are not normalised.
    "paper": BRCConfig(
        hidden=(256, 256), critic_hidden=(4096, 4096, 4096), replay_steps=4000, warmup_steps=20, updates_per_step=2,
        batch_size=1024, gamma=0.99, n_steps=1, tau=0.005, learning_rate=3e-4, critic_learning_rate=3e-4,
        alpha_learning_rate=3e-4, init_alpha=0.1, one_temperature=True, std_range=(4.54e-5, 7.39), init_std=0.0183,
        weight_decay=1e-4, max_grad_norm=1e9, normalise_observations=False, atoms=101, value_bound=10.0,
    ),
    "laptop": BRCConfig(),
}  # fmt: skip


class BRC(Categorical, MTSAC):
    """BRC (Nauman et al. 2025, arXiv 2505.23150) on a batched world."""

    name = "brc"
    config_type = BRCConfig
    presets = PRESETS
    config: BRCConfig
    critic_network = ResidualMLP
    unit_embeddings = True
    policy_of = staticmethod(partial(squashed_policy, network=ResidualMLP))

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        next_actions, log_prob = self.policy.sample(next_obs, self.generator)
        bonus = -self.log_alpha.exp()[self.task_of_draw] * log_prob
        return self._projected(draw, self._following(next_obs, next_actions), bonus)

    def _reward_scale(self) -> Tensor:
        if not self.config.per_task_rewards:
            return super()._reward_scale()
        tasks = torch.arange(self.world.num_tasks, device=self.device)
        gamma = discounts(self.world, self.config.gamma, tasks)
        bound = self.config.value_bound
        each = abs(self.target_entropy) / (1.0 - gamma)
        # The range leaves room for the entropy of all future steps, and at least half of it for rewards.
        room = bound - (self.log_alpha.detach().exp() * each).clamp_max(0.5 * bound)
        return (self.returns.bound / room).clamp_min(1e-8)

    def _gap_that_counts(self, gap: Tensor) -> Tensor:
        if self.config.one_temperature:
            return gap.mean().expand_as(gap)
        return gap
