"""MAML: model-agnostic meta-learning (Finn et al. 2017) for policies, on a batch of tasks at once.

Let theta_0 = theta and, on stages D_0 ... D_K, theta_k+1 = theta_k + rate * grad mean log pi(theta_k) * advantage. The
outer step raises the mean of ratio(theta_K) * advantage on D_K over theta, while KL(sampling policy || theta_K) stays
below max_kl; alternatively it is one step of Adam. ``first_order`` ignores the dependence of theta_K on theta.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bidex_algos.meta.adaptation import TaskBatch, weighted_mean
from bidex_algos.meta.base import MetaLearner
from bidex_algos.meta.config import TABLE_48, TUNED, UNSEEN, V2, OuterConfig
from bidex_algos.trust_region import trust_region_step
from bidex_meta.utils.validation import Count, Fraction, NonNegative, Positive


@dataclass(frozen=True)
class MAMLConfig(OuterConfig):
    """All options of MAML; the defaults are the preset ``laptop``."""

    outer: Literal["trpo", "adam"] = "trpo"
    """Optimiser of the meta-parameters: trpo (a trust-region step, as in the paper) or adam."""
    outer_learning_rate: Positive = 1e-3  # With --learner.outer adam: learning rate of the meta-parameters.
    max_grad_norm: Positive = 1.0
    """With --learner.outer adam: maximum norm of meta-gradients; longer gradients are scaled down."""
    max_kl: Positive = 0.01
    """With --learner.outer trpo: maximum mean KL divergence between the sampling policies and the adapted ones."""
    damping: NonNegative = 1e-2  # With --learner.outer trpo: value added to the diagonal of the Fisher matrix.
    cg_iterations: Count = 10  # With --learner.outer trpo: iterations of the conjugate-gradient solver.
    backtracks: Count = 15  # With --learner.outer trpo: maximum number of step lengths that the line search tries.
    backtrack_factor: Fraction = 0.8  # With --learner.outer trpo: factor by which the line search shortens the step.


PRESETS: dict[str, MAMLConfig] = {
    # The Bi-DexHands appendix has no table for MAML. The trust region is MAML's own; the rest is ProMP's table.
    "paper": MAMLConfig(**TABLE_48, max_kl=0.01, damping=1e-5),
    "tuned": MAMLConfig(**TUNED),
    "unseen": MAMLConfig(**UNSEEN),
    "v2": MAMLConfig(**V2, max_kl=0.03),  # MT-PPO's desired_kl
    "laptop": MAMLConfig(),
}


class MAML(MetaLearner):
    """MAML (Finn et al. 2017, arXiv 1703.03400) with a trust region."""

    name = "maml"
    objective = "likelihood"
    config_type = MAMLConfig
    presets = PRESETS
    config: MAMLConfig

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        if self.config.outer == "adam":
            return super()._optimisers()
        return {}

    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        surrogate, kl = self._objective(batches)
        cfg = self.config
        if cfg.outer == "adam":
            norm = self._descend(-surrogate)
            with torch.no_grad():
                _, kl = self._objective(batches)
            return {"Loss/surrogate": -surrogate.detach(), "Policy/outer_kl": kl, "Policy/gradient_norm": norm}

        @torch.no_grad()
        def measure() -> tuple[float, float]:
            objective, moved = torch.stack(self._objective(batches)).tolist()
            return objective, moved

        return trust_region_step(
            list(self.policy.parameters()), surrogate, kl, measure, cfg, cfg.max_kl, "Policy/outer_kl"
        )

    def _objective(self, batches: list[TaskBatch]) -> tuple[Tensor, Tensor]:
        adapter = self.policy.adapter
        params = adapter.meta(self.rows.count)
        for batch in batches[:-1]:
            params = adapter.adapt(params, batch)
        ratio, kl = adapter.ratio_and_kl(params, batches[-1])
        return weighted_mean(ratio * batches[-1].advantages, batches[-1].weights).mean(), kl.mean()
