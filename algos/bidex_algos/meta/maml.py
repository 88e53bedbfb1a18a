"""MAML: model-agnostic meta-learning (Finn et al. 2017) for policies, on a batch of tasks at once.

The outer step on one meta-batch with stages D_0 ... D_K::

    theta_0 = theta
    theta_k+1 = theta_k + inner_learning_rate * grad of mean over D_k of log pi(theta_k) * advantage      k < K
    maximise over theta, the mean over tasks of the mean over D_K of ratio(theta_K) * advantage,
        while the mean KL(policy that sampled D_K || theta_K) stays below max_kl        (or: one step of Adam)

theta_K depends on theta through the inner steps; ``first_order`` leaves their derivative out.
"""

import torch
from torch import Tensor

from bidex_algos.gradients.trust_region import trust_region_step
from bidex_algos.meta.adaptation import TaskBatch, weighted_mean
from bidex_algos.meta.base import MetaLearner
from bidex_algos.meta.maml_config import PRESETS, MAMLConfig

__all__ = ["MAML", "PRESETS", "MAMLConfig"]


class MAML(MetaLearner):
    """MAML (Finn et al. 2017, arXiv 1703.03400) with a trust region.

    Arguments and attributes are those of its base.
    """

    name, objective = "maml", "likelihood"
    config_type = MAMLConfig
    config: MAMLConfig

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return super()._optimisers() if self.config.outer == "adam" else {}

    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        return self._trust_region(batches) if self.config.outer == "trpo" else self._adam_step(batches)

    def _objective(self, batches: list[TaskBatch]) -> tuple[Tensor, Tensor]:
        """Surrogate objective and KL after adaptation: means over tasks, scalars."""
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

        surrogate, kl = self._objective(batches)
        stepped = trust_region_step(list(self.policy.parameters()), surrogate, kl, measure, self.config)
        return stepped.told("Policy/outer_kl", self.device)
