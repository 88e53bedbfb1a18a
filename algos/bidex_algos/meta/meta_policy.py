"""The agent of MAML and ProMP: a policy that takes gradient steps on what it sees of a task."""

import torch
from torch import Tensor, nn

from bidex_algos.meta.adaptation import Adapter, Objective, Params, detached
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.stage import Stage, TaskRows, task_batch
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_meta.agents import Timestep


class MetaPolicy(nn.Module):
    """A Gaussian actor with adapted copies, one a task; follows the protocol of adapting agents (bidex_meta.agents).

    Its own parameters are the meta-parameters. Before the first ``adapt`` every task plays by them. ``seed`` is that of
    the exploring actions.
    """

    def __init__(
        self, observations: ObservationNormaliser, actor: GaussianActor, config: MetaConfig, objective: Objective,
        seed: int = 0
    ):  # fmt: skip
        super().__init__()
        self.observations, self.actor, self.config = observations, actor, config
        self.adapter = Adapter(
            actor, config.inner_learning_rate, objective, config.std_range, config.first_order, config.adapted,
            config.step_sizes
        )  # fmt: skip
        self.step_sizes = self.adapter.step_sizes  # among the weights of a checkpoint, where there are such
        self.seed = seed
        self.generator: torch.Generator | None = None
        self.rows: TaskRows | None = None
        self.adapted: Params | None = None
        self.stage = Stage()
        self.elapsed: Tensor | None = None

    def assign(self, task_of_row: Tensor | None) -> None:
        """The task (N,) of each environment; those of one task share what they learn. None: each has its own."""
        self.rows = None if task_of_row is None else TaskRows(task_of_row)
        self.init()

    def init(self) -> None:
        """Back to the meta-parameters; all adaptation and its data are forgotten."""
        self.adapted, self.stage, self.elapsed = None, Stage(), None

    @torch.no_grad()
    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Sampled actions (N, a), not clamped, for raw observations (N, d); and their means."""
        if self.generator is None or self.generator.device != obs.device:
            self.generator = torch.Generator(obs.device).manual_seed(self.seed)
        mean, log_std = self._distribution(self.observations(obs))
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        return mean + log_std.exp() * noise, {"mean": mean}

    @torch.no_grad()
    def step(self, timestep: Timestep) -> None:
        """Takes in one transition of every environment."""
        terminated, truncated = timestep.terminated.bool(), timestep.truncated.bool()
        valid = getattr(timestep, "valid", None)
        valid = torch.ones_like(terminated) if valid is None else valid
        elapsed = torch.zeros_like(terminated, dtype=torch.int64) if self.elapsed is None else self.elapsed
        ended = terminated | truncated | ~valid
        self.stage.add(
            obs=self.observations(timestep.observation.float()), actions=timestep.action.float(),
            means=timestep.aux_policy_outputs["mean"], rewards=timestep.reward.float().masked_fill(~valid, 0.0),
            terminated=terminated, ended=ended, valid=valid, elapsed=elapsed
        )  # fmt: skip
        self.elapsed = (elapsed + 1).masked_fill(ended, 0)

    def adapt(self) -> None:
        """One inner step of each task on all transitions since the last one; without any, nothing happens."""
        if len(self.stage) == 0:
            return
        rows = self._rows(self.stage.obs[0])
        params = detached(self._params(rows))  # nobody differentiates this step
        log_std = params["log_std"].clamp(*self.adapter.log_std_range)
        batch = task_batch(self.stage, rows, log_std, self.config)
        self.adapted = detached(self.adapter.adapt(params, batch))
        self.stage, self.elapsed = Stage(), None

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """Mean actions of the adapted policies for raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        return self._distribution(self.observations(obs))[0].clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget between episodes."""

    def _distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Means (N, a) and logarithms of standard deviations, (N, a) or (a,), for normalised observations (N, d)."""
        if self.adapted is None:
            return self.actor(obs), self.actor.log_std.clamp(*self.adapter.log_std_range)
        rows = self._rows(obs)
        means, log_std = self.adapter.distribution(self.adapted, rows.by_task(obs))
        return rows.by_row(means), log_std[rows.task_of_row]

    def _params(self, rows: TaskRows) -> Params:
        return self.adapter.meta(rows.count) if self.adapted is None else self.adapted

    def _rows(self, obs: Tensor) -> TaskRows:
        if self.rows is None or len(self.rows.task_of_row) != len(obs):
            self.rows = TaskRows(torch.arange(len(obs), device=obs.device))
        return self.rows


def make_meta_policy(
    config: MetaConfig, objective: Objective, inputs: Inputs, actions: int, init: torch.Generator, seed: int = 0
) -> MetaPolicy:
    """A policy with fresh weights of ``init``, a CPU generator; no inner step moves the encoders of ``inputs``."""
    actor = GaussianActor(inputs, config.hidden, actions, config.init_std, init, config.activation)
    return MetaPolicy(ObservationNormaliser(inputs, config.normalise_observations), actor, config, objective, seed)
