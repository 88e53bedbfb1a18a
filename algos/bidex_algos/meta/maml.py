"""MAML: model-agnostic meta-learning (Finn et al. 2017) for policies, on a batch of tasks at once.

The outer step on one meta-batch with stages D_0 ... D_K::

    theta_0 = theta
    theta_k+1 = theta_k + inner_learning_rate * grad of mean over D_k of log pi(theta_k) * advantage      k < K
    maximise over theta, the mean over tasks of the mean over D_K of ratio(theta_K) * advantage,
        while the mean KL(policy that sampled D_K || theta_K) stays below max_kl        (or: one step of Adam)

theta_K depends on theta through the inner steps; ``first_order`` leaves their derivative out.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from bidex_algos.meta.adaptation import TaskBatch, weighted_mean
from bidex_algos.meta.base import MetaLearner
from bidex_algos.meta.config import TABLE_48, TUNED, UNSEEN, OuterConfig
from bidex_algos.trust_region import trust_region_step
from bidex_meta.utils.validation import Count, Fraction, NonNegative, Positive


@dataclass(frozen=True)
class MAMLConfig(OuterConfig):
    """Everything that can be set about MAML; the defaults are the preset ``laptop``."""

    outer: Literal["trpo", "adam"] = "trpo"
    """How the meta-parameters move: a trust-region step, as in the paper, or one step of Adam."""
    outer_learning_rate: Positive = 1e-3
    """Adam's step size for the meta-parameters."""
    max_grad_norm: Positive = 1.0
    """Before a step of Adam, meta-gradients longer than this are shortened to it."""
    max_kl: Positive = 0.01
    """Mean KL of the adapted policies from those that sampled that a trust-region step may not exceed."""
    damping: NonNegative = 1e-2
    """Added to the diagonal of the Fisher matrix."""
    cg_iterations: Count = 10
    """Conjugate-gradient iterations."""
    backtracks: Count = 15
    """Points that the line search tries."""
    backtrack_factor: Fraction = 0.8
    """By which the line search shortens the step."""


PRESETS: dict[str, MAMLConfig] = {
    # The Bi-DexHands appendix has no table for MAML: all but the trust region, MAML's own, is as in ProMP's.
    "paper": MAMLConfig(**TABLE_48, max_kl=0.01, damping=1e-5),
    "tuned": MAMLConfig(**TUNED),
    "unseen": MAMLConfig(**UNSEEN),
    "laptop": MAMLConfig(),
}


class MAML(MetaLearner):
    """MAML (Finn et al. 2017, arXiv 1703.03400) with a trust region."""

    name, objective = "maml", "likelihood"
    config_type, presets = MAMLConfig, PRESETS
    config: MAMLConfig

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return super()._optimisers() if self.config.outer == "adam" else {}

    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        return self._trust_region(batches) if self.config.outer == "trpo" else self._adam_step(batches)

    def _objective(self, batches: list[TaskBatch]) -> tuple[Tensor, Tensor]:
        adapter = self.policy.adapter
        params = adapter.meta(self.rows.count)
        for batch in batches[:-1]:
            params = adapter.adapt(params, batch)
        ratio, kl = adapter.ratio_and_kl(params, batches[-1])
        return weighted_mean(ratio * batches[-1].advantages, batches[-1].weights).mean(), kl.mean()

    def _adam_step(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        surrogate, _ = self._objective(batches)
        norm = self._descend(-surrogate)
        with torch.no_grad():
            _, kl = self._objective(batches)
        return {"Loss/surrogate": -surrogate.detach(), "Policy/outer_kl": kl, "Policy/gradient_norm": norm}

    def _trust_region(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        @torch.no_grad()
        def measure() -> tuple[float, float]:
            objective, moved = torch.stack(self._objective(batches)).tolist()
            return objective, moved

        (surrogate, kl), cfg = self._objective(batches), self.config
        stepped = trust_region_step(list(self.policy.parameters()), surrogate, kl, measure, cfg, cfg.max_kl)
        return stepped.reported("Policy/outer_kl", self.device)
