"""ProMP: proximal meta-policy search (Rothfuss et al. 2019) on a batch of tasks at once.

The outer step, repeated ``outer_epochs`` times on one meta-batch with stages D_0 ... D_K::

    theta_0 = theta
    theta_k+1 = theta_k + inner_learning_rate * grad of mean over D_k of ratio(theta_k) * advantage      k < K
    maximise over theta, the mean over tasks of
        mean over D_K of min(ratio(theta_K) * advantage, clipped ratio * advantage)
        - kl_weight * sum over k < K of KL(policy that sampled D_k || theta_k)

The ratio, unlike the log-likelihood, has the right second derivative: it gives the policy before adaptation credit for
the data that adaptation needs (their section 4).
"""

import torch
from torch import Tensor

from bidex_algos.gradients.step_size import factor_of
from bidex_algos.meta.adaptation import TaskBatch, weighted_mean
from bidex_algos.meta.base import MetaLearner
from bidex_algos.meta.promp_config import PRESETS, ProMPConfig

__all__ = ["PRESETS", "ProMP", "ProMPConfig"]


class ProMP(MetaLearner):
    """ProMP, proximal meta-policy search (Rothfuss et al. 2019, arXiv 1810.06784).

    Arguments and attributes are those of :class:`~bidex_algos.meta.base.MetaLearner`.
    """

    name, objective = "promp", "ratio"
    config_type = ProMPConfig
    config: ProMPConfig

    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        measured = []
        for epoch in range(self.config.outer_epochs):
            surrogate, inner_kl, outer_kl = self._objective(batches)
            if epoch > 0:  # before the first step it is 0 by construction
                self._follow(outer_kl)
            norm = self._descend(self.config.kl_weight * inner_kl - surrogate)
            measured.append(torch.stack([-surrogate, inner_kl, outer_kl, norm]).detach())
        means = torch.stack(measured).mean(0)
        names = ("Loss/surrogate", "Policy/inner_kl", "Policy/outer_kl", "Policy/gradient_norm")
        told = dict(zip(names, means, strict=True))
        return told | {"Policy/outer_learning_rate": torch.tensor(self.adam.param_groups[0]["lr"], device=self.device)}

    def _follow(self, kl: Tensor) -> None:
        """Adapts the step size to the KL that the steps so far have made."""
        if self.config.desired_kl is None:
            return
        low, high = self.config.outer_learning_rate_range
        for group in self.adam.param_groups[:1]:  # not that of learned step sizes
            group["lr"] = min(max(group["lr"] * float(factor_of(kl.detach(), self.config.desired_kl)), low), high)

    def _objective(self, batches: list[TaskBatch]) -> tuple[Tensor, Tensor, Tensor]:
        """Clipped objective, summed KL before adaptation, and KL after it: means over tasks, scalars."""
        adapter, clip = self.policy.adapter, self.config.clip
        params = adapter.meta(self.rows.count)
        inner_kl = torch.zeros((), device=self.device)
        for batch in batches[:-1]:
            inner_kl = inner_kl + adapter.ratio_and_kl(params, batch)[1].mean()
            params = adapter.adapt(params, batch)
        last = batches[-1]
        ratio, outer_kl = adapter.ratio_and_kl(params, last)
        clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
        gain = torch.minimum(ratio * last.advantages, clipped * last.advantages)
        return weighted_mean(gain, last.weights).mean(), inner_kl, outer_kl.mean()
