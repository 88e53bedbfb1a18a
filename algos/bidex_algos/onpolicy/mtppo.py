"""MT-PPO: proximal policy optimisation (Schulman et al. 2017) on all tasks of a world at once.

One policy reads the task's one-hot in its observation. An iteration collects ``rollout_steps`` steps in every row, then
makes ``epochs`` passes over them in shuffled mini-batches. What is done differently from Bi-DexHands' MTPPO, and why,
stands in ``docs/learners/mtppo.md``.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.gradients.balancing import balance_of
from bidex_algos.gradients.step_size import AdaptiveAdams
from bidex_algos.nets.precision import autocast
from bidex_algos.onpolicy.base import Batch, OnPolicy
from bidex_algos.onpolicy.demonstrations import Demonstrations
from bidex_algos.onpolicy.mtppo_config import PRESETS, MTPPOConfig
from bidex_algos.onpolicy.ppo_loss import NAMES, PPOLoss, ppo_loss
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import sum_gradients, world_size
from bidex_meta.world.contract import VectorWorld

__all__ = ["MTPPO", "PRESETS", "Batch", "MTPPOConfig"]


class MTPPO(OnPolicy):
    """Multi-task PPO (Schulman et al. 2017, arXiv 1707.06347) on a batched world.

    Arguments and attributes are those of :class:`~bidex_algos.onpolicy.base.OnPolicy`. Several processes make a
    mini-batch as many times larger.

    Raises:
        BidexError: Fewer samples in a rollout than mini-batches.
    """

    name, remedy = "mtppo", "lower learning_rate"
    config_type = MTPPOConfig
    config: MTPPOConfig
    demonstrations: Demonstrations | None = None

    def __init__(self, world: VectorWorld, config: MTPPOConfig, seed: int):
        samples = config.rollout_steps * world.num_envs
        if samples < config.num_minibatches:
            raise BidexError(
                f"mtppo: {config.num_minibatches} mini-batches need as many samples, but {world.num_envs} rows x "
                f"{config.rollout_steps} steps give {samples}. Raise num_envs or lower num_minibatches."
            )
        super().__init__(world, config, seed)
        self.adams = AdaptiveAdams(self.policy.actor.parameters(), self.critic.parameters(), config, self.device)
        self.balance = balance_of(config, world.num_tasks, self.device)

    def learn_from_demonstrations(self, data: Joined) -> None:
        """Takes what its policy shall also imitate; before the first iteration and before a checkpoint is loaded.

        Args:
            data: In the form of the learner's world; some of its tasks may have none.
        """
        self.demonstrations = Demonstrations(data, self.config, self.seed, self.device)
        self.per_process = (*OnPolicy.per_process, "demonstrated")

    def _iterate(self) -> dict[str, float]:
        if self.demonstrations is not None and self.config.demonstration_cloning and not self.env_steps:
            self.demonstrations.clone(self.policy)
        self.policy.observations.settled = self._critic_alone()
        return super()._iterate()

    def _imitated(self) -> float:
        """Weight of the demonstrations in this update, 0 without any."""
        return 0.0 if self.demonstrations is None else self.demonstrations.weight(self.env_steps)

    def _critic_alone(self) -> bool:
        """Whether the policy stays as it is in this iteration, and with it what it sees."""
        return self.env_steps < self.config.critic_first

    def _optimisers(self) -> dict[str, Any]:
        return self.adams.parts() | (self.balance.parts() if self.balance is not None else {})

    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """PPO's update: returns the means over all mini-batches of what it measured."""
        cfg, actor = self.config, self.policy.actor
        old_log_std = actor.log_std.detach().clone()
        low, high = (math.log(std) for std in cfg.std_range)
        measured: list[Tensor] = []
        for first, index, count in self._mini_batches(batch, cfg.epochs, cfg.num_minibatches):
            part = batch.select(index)
            measured.append(self._gradients(part, count, old_log_std))
            # The first mini-batch compares the sampling policy with itself and says nothing about the step.
            if not first and not self._critic_alone():
                self.adams.follow(measured[-1][2])
            actor_weights, critic_weights = list(actor.parameters()), list(self.critic.parameters())
            for weights in [actor_weights, critic_weights] if cfg.clip_apart else [actor_weights + critic_weights]:
                nn.utils.clip_grad_norm_(weights, cfg.max_grad_norm)
            self.adams.step(self._critic_alone())
            with torch.no_grad():
                actor.log_std.clamp_(low, high)
                if self.balance is not None:
                    self.balance.learn(lambda b=part, n=count: self._above_least(b, n, old_log_std))
        names = list(NAMES)
        if self.balance is not None:
            names.append(self.balance.tag)
        if self._imitated():
            names.append("Loss/demonstrations")
        means = torch.stack(measured).mean(0)
        told = {**dict(zip(names, means, strict=True)), "Policy/lr": self.adams.rate}
        if self.demonstrations is not None:
            told["Policy/demonstration_weight"] = means.new_tensor(self._imitated())
        return told

    def _gradients(self, b: Batch, count: Tensor, old_log_std: Tensor) -> Tensor:
        """Puts the gradients of a mini-batch into the parameters; ``count`` samples are in it, over all processes.

        Returns:
            Surrogate loss, value loss, KL, share of clipped ratios; with surgery its own number; with demonstrations
            the distance from them: (4,) to (6,).
        """
        cfg, actor = self.config, self.policy.actor
        loss = self._loss(b, count, old_log_std, self._critic(b.obs, b.task_id))
        rest = cfg.value_loss_weight * loss.value - cfg.entropy_weight * loss.entropy
        numbers, imitated = loss.numbers(), None
        if self.demonstrations is not None and (weight := self._imitated()):
            imitated = self.demonstrations.loss(self.policy) / world_size()
            rest = rest + weight * imitated
        self.adams.zero_grad()
        if self.balance is not None:
            losses, least = self._per_task(-loss.earned, b.task_id), self._per_task(self._least(b, count), b.task_id)
            numbers.append(self.balance.backward(losses, least, list(actor.parameters())))
            rest.backward()
        else:
            (loss.surrogate + rest).backward()
        if imitated is not None:
            numbers.append(imitated.detach())
        return sum_gradients([*actor.parameters(), *self.critic.parameters()], torch.stack(numbers))

    def _loss(self, b: Batch, count: Tensor, old_log_std: Tensor, values: Tensor) -> PPOLoss:
        """What the present actor and ``values`` (B,) make of a mini-batch."""
        actor = self.policy.actor
        with autocast(self.device, self.low_precision):
            means = actor(b.obs)
        return ppo_loss(
            b.actions,
            means,
            actor.log_std_of(b.obs),
            b.old_means,
            actor.log_std_of(b.obs, old_log_std),
            b.old_log_probs,
            b.advantages,
            values,
            b.targets,
            weights=b.weights / count,
            clip=self.config.clip,
        )

    def _least(self, b: Batch, count: Tensor) -> Tensor:
        """The least that each sample's surrogate loss can become (B,): no ratio earns more than the clip allows."""
        return -b.weights / count * (b.advantages + self.config.clip * b.advantages.abs())

    def _above_least(self, b: Batch, count: Tensor, old_log_std: Tensor) -> Tensor:
        """How far each task's surrogate loss is above that, (num_tasks,)."""
        loss = self._loss(b, count, old_log_std, b.targets)
        return self._per_task(-loss.earned - self._least(b, count), b.task_id)

    # Checkpoints.

    def _parts(self) -> dict[str, Any]:
        more = {} if self.demonstrations is None else {"demonstrated": self.demonstrations.generator}
        return super()._parts() | more

    def _place(self) -> dict[str, Any]:
        more = {} if self.demonstrations is None else {"demonstrations": self.demonstrations.fingerprint}
        return super()._place() | more

    def _check_size(self, state: dict[str, Any]) -> None:
        super()._check_size(state)
        if self.demonstrations is not None:
            self.demonstrations.check(self.name, state.get("demonstrations"))

    def _per_task(self, x: Tensor, task_id: Tensor) -> Tensor:
        """Sums (num_tasks,) of what each sample has (B,)."""
        return x.new_zeros(self.world.num_tasks).index_add(0, task_id, x)
