"""The base of the gradient-based meta-learners: meta-batches of tasks, stages of adaptation, checkpoints.

The learners differ only in the outer step. In an iteration every task starts from the meta-parameters. In each stage k
= 0 ... inner_steps every environment plays an episode with its task's parameters. After each stage except the last, the
parameters take an inner step. The steps of algorithm 3 of Finn et al. (2017) are numbered in
``MetaLearner._iterate``; ``maml.py`` and ``promp.py`` take the last one.
"""

from abc import abstractmethod
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from bidex_algos.learner import Learner, as_numbers
from bidex_algos.meta.adaptation import Adapter, Objective, Params, TaskBatch, detached
from bidex_algos.meta.config import MetaConfig, OuterConfig
from bidex_algos.meta.stage import Outcome, Stage, TaskRows, moments, task_batch
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor
from bidex_algos.nets.normalise import ObservationNormaliser, RunningStats
from bidex_algos.nets.shape import Shape
from bidex_meta.agents import Timestep
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import world_size
from bidex_meta.training.learner import AutoresetMode, Capability, Parts, State
from bidex_meta.utils import maths
from bidex_meta.world.contract import PooledWorld, as_endless


class MetaPolicy(nn.Module):
    """A Gaussian actor with one adapted copy per task; follows the protocol of adapting agents (bidex_meta.agents).

    The parameters of the module are the meta-parameters. Before the first ``adapt`` the policy acts with the
    meta-parameters in every task. ``seed`` seeds the exploring actions.
    """

    def __init__(
        self, observations: ObservationNormaliser, actor: GaussianActor, config: MetaConfig, objective: Objective,
        seed: int = 0
    ):  # fmt: skip
        super().__init__()
        self.observations = observations
        self.actor = actor
        self.config = config
        self.adapter = Adapter(
            actor, config.inner_learning_rate, objective, config.std_range, config.first_order, config.adapted,
            config.step_sizes
        )  # fmt: skip
        self.step_sizes = self.adapter.step_sizes  # these weights are stored in checkpoints, unless None
        self.seed = seed
        self.generator: torch.Generator | None = None
        self.rows: TaskRows | None = None
        self.adapted: Params | None = None
        self.stage = Stage()
        self.elapsed: Tensor | None = None

    def assign(self, task_of_row: Tensor | None) -> None:
        """Set the task (N,) of each environment; environments of one task adapt together.

        With None every environment adapts separately.
        """
        if task_of_row is None:
            self.rows = None
        else:
            self.rows = TaskRows(task_of_row)
        self.init()

    def init(self) -> None:
        """Return to the meta-parameters; discard adapted parameters and stored transitions."""
        self.adapted = None
        self.stage = Stage()
        self.elapsed = None

    @torch.no_grad()
    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return sampled, unclamped actions (N, a) for raw observations (N, d), and their means."""
        if self.generator is None or self.generator.device != obs.device:
            self.generator = torch.Generator(obs.device).manual_seed(self.seed)
        mean, log_std = self._distribution(self.observations(obs))
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        return mean + log_std.exp() * noise, {"mean": mean}

    @torch.no_grad()
    def step(self, timestep: Timestep) -> None:
        """Store one transition of every environment."""
        terminated = timestep.terminated.bool()
        truncated = timestep.truncated.bool()
        valid = timestep.valid_mask
        if self.elapsed is None:
            elapsed = torch.zeros_like(terminated, dtype=torch.int64)
        else:
            elapsed = self.elapsed
        ended = terminated | truncated | ~valid
        self.stage.add(
            obs=self.observations(timestep.observation.float()), actions=timestep.action.float(),
            means=timestep.aux_policy_outputs["mean"], rewards=timestep.reward.float().masked_fill(~valid, 0.0),
            terminated=terminated, ended=ended, valid=valid, elapsed=elapsed
        )  # fmt: skip
        self.elapsed = (elapsed + 1).masked_fill(ended, 0)

    def adapt(self) -> None:
        """Take one inner step of each task on all transitions since the last inner step, if there are any."""
        if len(self.stage) == 0:
            return
        rows = self._rows(self.stage.obs[0])
        if self.adapted is None:
            params = self.adapter.meta(rows.count)
        else:
            params = self.adapted
        params = detached(params)  # this step is not differentiated
        log_std = params["log_std"].clamp(*self.adapter.log_std_range)
        batch = task_batch(self.stage, rows, log_std, self.config)
        self.adapted = detached(self.adapter.adapt(params, batch))
        self.stage = Stage()
        self.elapsed = None

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """Return mean actions of the adapted policies for raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        return self._distribution(self.observations(obs))[0].clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Do nothing, because the policy has no state that must be reset between episodes."""

    def _distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (N, a) and log standard deviations, (N, a) or (a,), for normalised observations (N, d)."""
        if self.adapted is None:
            return self.actor(obs), self.actor.log_std.clamp(*self.adapter.log_std_range)
        rows = self._rows(obs)
        means, log_std = self.adapter.distribution(self.adapted, rows.by_task(obs))
        return rows.by_row(means), log_std[rows.task_of_row]

    def _rows(self, obs: Tensor) -> TaskRows:
        if self.rows is None or len(self.rows.task_of_row) != len(obs):
            self.rows = TaskRows(torch.arange(len(obs), device=obs.device))
        return self.rows


def make_meta_policy(
    config: MetaConfig, objective: Objective, inputs: Inputs, actions: int, init: torch.Generator, seed: int = 0
) -> MetaPolicy:
    """Make a policy with fresh weights drawn from ``init``, a CPU generator.

    Encoders of observation groups (in ``inputs``) are the same for all tasks: the inner step does not change them.
    """
    actor = GaussianActor(inputs, config.hidden, actions, config.init_std, init, config.activation)
    return MetaPolicy(ObservationNormaliser(inputs, config.normalise_observations), actor, config, objective, seed)


class MetaLearner(Learner):
    """Learns parameters that improve strongly by one gradient step on a task's own data; runs in one process."""

    world: PooledWorld
    config: OuterConfig
    policy: MetaPolicy
    remedy = "lower inner_learning_rate or the outer step"
    objective: ClassVar[Objective]  # objective of the inner step
    capabilities = frozenset({Capability.ADAPTS})
    going_on = ("obs", "elapsed", "steps_with_tasks", *Learner.going_on)

    def __init__(self, world: PooledWorld, config: OuterConfig, seed: int):
        if world_size() > 1:
            raise BidexError(f"{self.name}: learns in one process, got {world_size()}. Start it without torchrun.")
        super().__init__(world, config, seed)
        self.policy.seed = seed
        self.adapt_steps = config.max_adapt_steps or int(world.max_episode_steps.max())
        self.obs: Tensor | None = None
        self.elapsed = torch.zeros(world.num_envs, dtype=torch.int64, device=self.device)
        self.steps_with_tasks = 0
        # Tasks are drawn from these pools, because the world's own pools will hold the tasks of a meta-batch.
        self.pools = [pool.copy() for pool in world.pools]
        self.endless = as_endless(world)
        self.tasks_generator = torch.Generator().manual_seed(seed)
        self.rows = TaskRows(world.task_id)
        self.adam = torch.optim.Adam(self.policy.actor.parameters(), lr=config.outer_learning_rate)
        if self.policy.step_sizes is not None:
            sizes = list(self.policy.step_sizes.parameters())
            self.adam.add_param_group({"params": sizes, "lr": config.step_size_rate})

    @classmethod
    def autoreset_mode(cls, config: OuterConfig) -> AutoresetMode:
        """Return the autoreset mode that the world must have.

        The mode is SAME_STEP if the learner adapts on slices of running episodes. It is DISABLED if the learner adapts
        on whole episodes, because whole episodes must begin together.
        """
        if config.slice_steps is None:
            return "DISABLED"
        return "SAME_STEP"

    @abstractmethod
    def _outer(self, batches: list[TaskBatch]) -> dict[str, Tensor]:
        """Update the meta-parameters from the batches of the stages; return scalars to be logged."""

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimisers by their names in a checkpoint."""
        return {"adam": self.adam}

    def _descend(self, loss: Tensor) -> Tensor:
        self.adam.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.actor.parameters(), self.config.max_grad_norm)
        self.adam.step()
        return norm

    def _iterate(self) -> dict[str, float]:
        # Step 1: sample a batch of tasks. Slices of running episodes keep their tasks until the episodes are over.
        if self.config.slice_steps is None or self.obs is None or self.steps_with_tasks >= self.adapt_steps:
            self._draw_tasks()
        adapter = self.policy.adapter
        adapter.project()
        params = detached(adapter.meta(self.rows.count))
        seen = RunningStats((self.policy.observations.measured.size,)).to(self.device)
        batches = list[TaskBatch]()
        reported = dict[str, float]()
        steps = 0
        for k in range(self.config.inner_steps + 1):
            # Step 2: sample each task's trajectories, with the meta-parameters (k = 0) or with the adapted parameters.
            with self._collecting():
                stage, outcome = self._sample(params, seen)
                steps += int(outcome.steps)
            log_std = params["log_std"].clamp(*adapter.log_std_range)
            batches.append(task_batch(stage, self.rows, log_std, self.config))
            reported |= self._reported(outcome, k)
            # Step 3: adapt the parameters of each task by a gradient step on its own trajectories. No graph is kept:
            # the outer step adapts again, on the same trajectories, to differentiate through this step.
            if k < self.config.inner_steps:
                params = detached(adapter.adapt(params, batches[-1]))
        # Step 4: update the meta-parameters with the trajectories that the adapted policies sampled.
        reported |= as_numbers(self._outer(batches))
        self.policy.observations.merge(seen.mean, seen.var, seen.count)
        self.env_steps += steps
        if (sizes := self.policy.step_sizes) is not None:
            reported["Policy/inner_learning_rate"] = self.config.inner_learning_rate * float(sizes.mean())
        reported["Policy/std"] = float(self.policy.actor.log_std.detach().clamp(*adapter.log_std_range).exp().mean())
        return reported

    def _draw_tasks(self) -> None:
        chosen = self._chosen_tasks()
        self.world.set_tasks(chosen)
        sizes = torch.tensor([len(tasks) for tasks in chosen.values()], device=self.device)
        first = sizes.cumsum(0) - sizes
        self.rows = TaskRows(first[self.world.task_id] + self.world.task_index)
        self.obs = None
        self.steps_with_tasks = 0

    def _chosen_tasks(self) -> dict[str, np.ndarray]:
        """Return the tasks of the next meta-batch: for each class, by name, an array with one row per task.

        A row holds the numbers that distinguish the task from other tasks of its class. A class has ``tasks_per_class``
        rows, or fewer if its pool of tasks is smaller.
        """
        count = self.config.tasks_per_class
        if self.endless is not None:
            number = int(torch.randint(2**31, (), generator=self.tasks_generator))
            return self.endless.fresh_tasks(number, count)
        chosen = {}
        for name, pool in zip(self.world.task_names, self.pools, strict=True):
            order = torch.randperm(len(pool), generator=self.tasks_generator)[:count]
            chosen[name] = pool[order.numpy()]
        return chosen

    @torch.no_grad()
    def _sample(self, params: dict[str, Tensor], seen: RunningStats) -> tuple[Stage, Outcome]:
        """Play a whole episode, or a slice of an episode, in every environment.

        The statistics ``seen`` are updated with raw observations. The policy reads normalised observations.
        """
        policy = self.policy
        rows = self.rows
        stage = Stage()
        longest = min(int(self.world.max_episode_steps.max()), self.adapt_steps)
        horizon = self.config.slice_steps or longest
        obs = self.obs
        if obs is None or self.config.slice_steps is None:
            self.elapsed = torch.zeros_like(self.elapsed)
            first = self.env_steps == 0 and self.steps_with_tasks == 0
            if first:
                obs = self._first_observations()
            else:
                obs = self.world.reset()[0]
        running = torch.ones_like(self.elapsed, dtype=torch.bool)
        earned = torch.zeros(len(running), device=self.device)
        # A slice is a success if two conditions hold. The suite's rule holds at the end of the slice or at the end of
        # an episode in the slice, and the goal was met in at least one of the slice's steps.
        success = torch.zeros_like(running)
        ended_well = torch.zeros_like(running)
        met = torch.zeros_like(running)
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
            success = torch.where(running, info["running"]["success"], success)
            ended_well |= success & over & running
            met |= info["success"] & valid
            self.elapsed = (self.elapsed + 1).masked_fill(over, 0)
            if self.config.slice_steps is None:
                running = running & ~over
                if maths.may_look(self.device) and not running.any():
                    break
        self.obs = obs
        self.steps_with_tasks += len(stage)
        return stage, Outcome(earned, (success | ended_well) & met, steps)

    def _reported(self, outcome: Outcome, k: int) -> dict[str, float]:
        last = k == self.config.inner_steps
        if k > 0 and not last:
            return {}
        reported: dict[str, float] = {}
        for what, whole, values in (
            ("return", "mean_return", outcome.earned), ("success", "success_rate", outcome.success.float())
        ):  # fmt: skip
            sums = torch.zeros(self.world.num_tasks, device=self.device).index_add(0, self.world.task_id, values)
            means = (sums / torch.bincount(self.world.task_id, minlength=self.world.num_tasks)).tolist()
            tag = "Train" if last else "Before"
            reported |= {f"{tag}/{what}/{name}": mean for name, mean in zip(self.world.task_names, means, strict=True)}
            reported[f"{tag}/{whole}"] = sum(means) / len(means)
        return reported

    @classmethod
    def _make_policy(cls, config: MetaConfig, shape: Shape, init: torch.Generator, device: torch.device) -> MetaPolicy:
        return make_meta_policy(config, cls.objective, cls._inputs(config, shape), shape.actions, init).to(device)

    def policy_state_dict(self) -> State:
        """Return the state that :meth:`load_policy` needs: network, statistics, sizes, config and exploration seed."""
        return super().policy_state_dict() | {"seed": self.seed}

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> MetaPolicy:
        """Return the adapting agent of a checkpoint (``learner.policy``), for a world of any number of environments."""
        policy = super().load_policy(state, device)
        policy.seed = state["seed"]
        return policy

    def _parts(self) -> Parts:
        return {**self._optimisers(), "generator": self.generator, "tasks_generator": self.tasks_generator}

    def _place(self) -> State:
        return {"rows": self.rows.task_of_row, **super()._place()}

    def _go_on_from(self, state: State) -> None:
        super()._go_on_from(state)
        self.rows = TaskRows(state["rows"].to(self.device))

    def _check_size(self, state: State) -> None:
        self._expect("", f"{len(state['elapsed'])} environments", f"{self.world.num_envs} environments")
