"""MAML: model-agnostic meta-learning (Finn et al. 2017) for policies, on a batch of tasks at once.

Let theta_0 = theta. On the data D_k of stage k the inner step is theta_k+1 = theta_k + rate * grad mean log pi(theta_k)
* advantage. The outer step changes theta to raise the mean of ratio(theta_K) * advantage on the data D_K of the last
stage, while KL(sampling policy || theta_K) stays below max_kl. With ``outer`` adam the outer step is one step of Adam.
``first_order`` leaves out the second derivatives.
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

    outer: Literal["trpo", "adam"] = "trpo"  # Outer step: a trust-region step as in the paper, or a step of Adam.
    max_kl: Positive = 0.01  # Bound of the mean KL between sampling and adapted policies in a trust-region step.
    damping: NonNegative = 1e-2  # Added to the diagonal of the Fisher matrix.
    cg_iterations: Count = 10  # Conjugate-gradient iterations.
    backtracks: Count = 15  # Points that the line search tries.
    backtrack_factor: Fraction = 0.8  # Factor by which the line search shortens the step at each try.


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
        # Algorithm 3, last line: update theta by the gradient of the adapted policies' losses, averaged over tasks. As
        # in the paper's experiments the step is TRPO's; ``adam`` takes the algorithm's plain gradient step, by Adam.
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
        # Algorithm 3, line "compute adapted parameters": theta'_i = theta - alpha * gradient of the loss on D_i. The
        # graph is kept, so the outer gradient has the inner steps' second derivatives, unless ``first_order``.
        for batch in batches[:-1]:
            params = adapter.adapt(params, batch)
        # The loss of the adapted policies on D'_i, the trajectories that they sampled themselves.
        ratio, kl = adapter.ratio_and_kl(params, batches[-1])
        return weighted_mean(ratio * batches[-1].advantages, batches[-1].weights).mean(), kl.mean()
