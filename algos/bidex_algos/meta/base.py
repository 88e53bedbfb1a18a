"""What the gradient-based meta-learners share: meta-batches of tasks, stages of adaptation, checkpoints.

They differ in the outer step alone. An iteration::

    draw tasks; every task starts from the meta-parameters
    for each stage k = 0 ... inner_steps:
        every environment plays one episode by its task's parameters          D_k
        theta_k+1 = theta_k + inner_learning_rate * gradient on D_k   (not after the last)
    outer step of the meta-parameters on D_0 ... D_K
"""

from abc import abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.learner import Learner, as_numbers
from bidex_algos.meta.adaptation import Objective, TaskBatch, detached
from bidex_algos.meta.config import MetaConfig, OuterConfig
from bidex_algos.meta.meta_policy import MetaPolicy, make_meta_policy
from bidex_algos.meta.stage import Outcome, Stage, TaskRows, moments, task_batch
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.shape import Shape
from bidex_algos.rollout import may_look
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import world_size
from bidex_meta.train.learner import AutoresetMode, Parts, State
from bidex_meta.world.contract import PooledWorld


class MetaLearner(Learner):
    """Learns parameters from which one gradient step on a task's own data goes far; in one process."""

    world: PooledWorld
    config: OuterConfig
    policy: MetaPolicy
    remedy = "lower inner_learning_rate or the outer step"
    objective: ClassVar[Objective]
    """What its inner step follows."""
    adapts = True

    def __init__(self, world: PooledWorld, config: OuterConfig, seed: int):
        if world_size() > 1:
            raise BidexError(f"{self.name}: learns in one process, got {world_size()}. Start it without torchrun.")
        super().__init__(world, config, seed)
        self.policy.seed = seed
        self.obs: Tensor | None = None
        self.elapsed = torch.zeros(world.num_envs, dtype=torch.int64, device=self.device)
        self.steps_with_tasks = 0
        # What can be drawn from; the world's own pools will be those of a meta-batch.
        self.pools = [pool.copy() for pool in world.pools]
        self._check_rows()
        self.tasks_generator = torch.Generator().manual_seed(seed)
        self.rows = TaskRows(world.task_id)
        self.adam = torch.optim.Adam(self.policy.actor.parameters(), lr=config.outer_learning_rate)
        if self.policy.step_sizes is not None:
            sizes = list(self.policy.step_sizes.parameters())
            self.adam.add_param_group({"params": sizes, "lr": config.step_size_rate})

    @classmethod
    def autoreset_mode(cls, config: OuterConfig) -> AutoresetMode:
        """Whole episodes wait for each other, slices of them go on."""
        return "DISABLED" if config.slice_steps is None else "SAME_STEP"

    def _check_rows(self) -> None:
        rows = torch.bincount(self.world.task_id, minlength=self.world.num_tasks).tolist()
        for name, count, pool in zip(self.world.task_names, rows, self.pools, strict=True):
            tasks = min(self.config.tasks_per_class, len(pool))
            if count < tasks:
                raise BidexError(
                    f"{self.name}: {name} has {count} environments for {tasks} tasks of a meta-batch. Use num_envs of "
                    f"at least {tasks * self.world.num_tasks}, or lower tasks_per_class."
                )

    @abstractmethod
    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        """Moves the meta-parameters by what the stages showed; returns scalars to be logged."""

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """The optimisers by the names they have in a checkpoint."""
        return {"adam": self.adam}

    def _descend(self, loss: Tensor) -> Tensor:
        """One step of Adam of the meta-parameters; the norm of the meta-gradient before it was shortened, a scalar."""
        self.adam.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.actor.parameters(), self.config.max_grad_norm)
        self.adam.step()
        return norm

    def _iterate(self) -> dict[str, float]:
        if self.config.slice_steps is None or self.obs is None or self.steps_with_tasks >= self.config.max_adapt_steps:
            self._draw_tasks()
        adapter = self.policy.adapter
        adapter.project()
        params = detached(adapter.meta(self.rows.count))
        seen = RunningStats((self.policy.observations.measured.size,)).to(self.device)
        batches: list[TaskBatch] = []
        reported: dict[str, float] = {}
        steps = 0
        for k in range(self.config.inner_steps + 1):
            with self._collecting():
                stage, outcome = self._sample(params, seen)
                steps += int(outcome.steps)
            log_std = params["log_std"].clamp(*adapter.log_std_range)
            batches.append(task_batch(stage, self.rows, log_std, self.config))
            reported |= self._reported(outcome, k)
            if k < self.config.inner_steps:
                params = detached(adapter.adapt(params, batches[-1]))
        reported |= as_numbers(self._outer(batches))
        self.policy.observations.merge(seen.mean, seen.var, seen.count)
        self.env_steps += steps
        if self.policy.step_sizes is not None:
            reported["Policy/inner_learning_rate"] = self.config.inner_learning_rate * float(
                self.policy.step_sizes.mean()
            )
        reported["Policy/std"] = float(self.policy.actor.log_std.detach().clamp(*adapter.log_std_range).exp().mean())
        return reported

    def _draw_tasks(self) -> None:
        chosen = {}
        for name, pool in zip(self.world.task_names, self.pools, strict=True):
            order = torch.randperm(len(pool), generator=self.tasks_generator)[: self.config.tasks_per_class]
            chosen[name] = pool[order.numpy()]
        self.world.set_tasks(chosen)
        sizes = torch.tensor([len(tasks) for tasks in chosen.values()], device=self.device)
        first = sizes.cumsum(0) - sizes
        self.rows = TaskRows(first[self.world.task_id] + self.world.task_index)
        self.obs, self.steps_with_tasks = None, 0

    @torch.no_grad()
    def _sample(self, params: dict[str, Tensor], seen: RunningStats) -> tuple[Stage, Outcome]:
        """A whole episode, or a slice, in every environment; raw observations go into ``seen``, clipped ones on."""
        policy, rows, stage = self.policy, self.rows, Stage()
        if self.config.slice_steps is None:
            horizon = min(int(self.world.max_episode_steps.max()), self.config.max_adapt_steps)
        else:
            horizon = self.config.slice_steps
        obs = self._begin()
        running = torch.ones_like(self.elapsed, dtype=torch.bool)
        earned, success = torch.zeros(len(running), device=self.device), torch.zeros_like(running)
        steps = torch.zeros_like(self.elapsed[0])
        for t in range(horizon):
            normal = policy.observations(obs)
            means, log_std = policy.adapter.distribution(params, rows.by_task(normal))
            mean = rows.by_row(means)
            noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
            action = mean + log_std[rows.task_of_row].exp() * noise
            steps += running.sum()
            before = obs
            obs, reward, terminated, truncated, info = self.world.step(action)
            broken = info["unstable"]
            valid = running & ~broken
            seen.merge(*moments(policy.observations.measured(before), valid))
            over = terminated | truncated | broken
            last = torch.full_like(over, self.config.slice_steps is None and t + 1 == horizon)
            stage.add(
                obs=normal, actions=action, means=mean, rewards=reward.masked_fill(~valid, 0.0), terminated=terminated,
                ended=over | last | ~running, valid=valid, elapsed=self.elapsed,
            )  # fmt: skip
            earned += info["reward_unscaled"].masked_fill(~valid, 0.0)
            success |= info["success"] & valid
            self.elapsed = (self.elapsed + 1).masked_fill(over, 0)
            if self.config.slice_steps is None:
                running = running & ~over
                if may_look(self.device) and not running.any():
                    break
        self.obs = obs
        self.steps_with_tasks += len(stage)
        return stage, Outcome(earned, success, steps)

    def _begin(self) -> Tensor:
        if self.obs is not None and self.config.slice_steps is not None:
            return self.obs
        self.elapsed = torch.zeros_like(self.elapsed)
        if self.env_steps == 0 and self.steps_with_tasks == 0:
            return self._first_observations()
        return self.world.reset()[0]

    def _reported(self, outcome: Outcome, k: int) -> dict[str, float]:
        last = k == self.config.inner_steps
        if k > 0 and not last:
            return {}
        reported: dict[str, float] = {}
        for what, values in (("return", outcome.earned), ("success", outcome.success.float())):
            sums = torch.zeros(self.world.num_tasks, device=self.device).index_add(0, self.world.task_id, values)
            means = (sums / torch.bincount(self.world.task_id, minlength=self.world.num_tasks)).tolist()
            tag = f"Train/{what}" if last else f"Before/{what}"
            reported |= {f"{tag}/{name}": mean for name, mean in zip(self.world.task_names, means, strict=True)}
            whole = {"return": "mean_return", "success": "success_rate"}[what]
            reported[f"{'Train' if last else 'Before'}/{whole}"] = sum(means) / len(means)
        return reported

    @classmethod
    def _make_policy(cls, config: MetaConfig, shape: Shape, init: torch.Generator, device: torch.device) -> MetaPolicy:
        return make_meta_policy(config, cls.objective, cls._inputs(config, shape), shape.actions, init).to(device)

    def policy_state_dict(self) -> State:
        """What :meth:`load_policy` needs: network, statistics, sizes, config, and the seed that it explores by."""
        return super().policy_state_dict() | {"seed": self.seed}

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> MetaPolicy:
        """The adapting agent of a checkpoint (``learner.policy``), for a world of any number of environments."""
        policy = super().load_policy(state, device)
        policy.seed = state["seed"]
        return policy

    def _parts(self) -> Parts:
        return {**self._optimisers(), "generator": self.generator, "tasks_generator": self.tasks_generator}

    def _place(self) -> State:
        return {
            "rows": self.rows.task_of_row,
            "obs": self.obs,
            "elapsed": self.elapsed,
            "steps_with_tasks": self.steps_with_tasks,
            **super()._place(),
        }

    def _go_on_from(self, state: State) -> None:
        super()._go_on_from(state)
        self.rows = TaskRows(state["rows"].to(self.device))
        self.obs = None if state["obs"] is None else state["obs"].to(self.device, copy=True)
        self.elapsed = state["elapsed"].to(self.device, copy=True)
        self.steps_with_tasks = int(state["steps_with_tasks"])

    def _check_size(self, state: State) -> None:
        self._expect("", f"{len(state['elapsed'])} environments", f"{self.world.num_envs} environments")
