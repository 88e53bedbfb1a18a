"""The speed of MT-PPO's update beside that of rsl-rl-lib (Schwarke et al. 2025; the extra ``rsl-rl``), on the CPU."""

import statistics
import time
from dataclasses import replace
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor, nn

from bidex_algos.onpolicy.mtppo import MTPPO, PRESETS, MTPPOConfig
from bidex_meta.world.base import make_spaces
from bidex_meta.world.contract import plain_groups

_END = 0.01
"""Chance of a step to end its episode, half of it by a time limit."""


def learner(
    preset: str = "laptop",
    num_envs: int = 1024,
    repeats: int = 7,
    threads: int | None = None,
    seed: int = 0,
    observations: int = 450,
    actions: int = 52,
    num_tasks: int = 4,
) -> dict[str, Any]:
    """Speed of MT-PPO's update against rsl-rl-lib's PPO, on random rollouts: the same for both.

    The same: sizes of networks and batch, passes and mini-batches, ELU, Adam with a step size that follows the KL,
    gradients of actor and critic clipped apart, no clipping of the value loss, float32, threads. The clock runs from a
    full rollout to new weights, and on over what each does before the next rollout: statistics of observations, mean
    losses. Two comparisons, their repeats interleaved:

    * ``defaults``: the preset as it is. What rsl-rl has not (a value head per task, returns and advantages normalised
      per task) stays on; both normalise observations if the preset does.
    * ``plain``: without any of these, and without normalised observations on either side.

    What stays different: MT-PPO evaluates the critic on the rollout within the clock, rsl-rl while it collects;
    MT-PPO shuffles for every pass, rsl-rl once an update; rsl-rl draws unused actions in every mini-batch.

    Args:
        preset: Of MT-PPO; rsl-rl gets the same numbers.
        num_envs: Rows.
        repeats: Interleaved repeats; medians are reported.
        threads: Threads of torch; None leaves them as they are.
        seed: Of weights, rollouts and shuffling.
        observations: Size of an observation, the one-hot included.
        actions: Number of actions.
        num_tasks: Number of tasks.

    Returns:
        For each comparison ``ratio`` (seconds of rsl-rl over those of MT-PPO, 1 = as fast, more = MT-PPO is faster),
        ``update_ratio`` (the same without what prepares the batch: values, advantages), the ``seconds`` of both and
        their ``samples_per_s``: samples of the rollout, each of which is learnt from once a pass.
    """
    full = replace(PRESETS[preset], autocast="off")
    plain = replace(
        full, value_heads=False, per_task_values=False, per_task_advantages=False, normalise_observations=False
    )
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        # rsl-rl draws from the global generator.
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            pairs = {}
            for name, config in (("defaults", full), ("plain", plain)):
                worlds = [Noise(num_envs, observations, actions, num_tasks, seed) for _ in range(2)]
                pairs[name] = Ours(worlds[0], config, seed), Theirs(worlds[1], config)
            found = _interleaved(pairs, repeats, full.rollout_steps * num_envs)
        used = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
    setting = {"preset": preset, "num_envs": num_envs, "threads": used, "rsl_rl": version("rsl-rl-lib")}
    return setting | found


def _interleaved(pairs: dict[str, tuple["Side", "Side"]], repeats: int, samples: int) -> dict[str, Any]:
    times: dict[str, list[list[tuple[float, float]]]] = {name: [] for name in pairs}
    for repeat in range(repeats + 1):
        for name, pair in pairs.items():
            # Who goes first alternates.
            order = pair if repeat % 2 else pair[::-1]
            took = {side: side.seconds() for side in order}
            if repeat:  # the first one warms up
                times[name].append([took[side] for side in pair])
    return {name: _summary(found, samples) for name, found in times.items()}


def _summary(times: list[list[tuple[float, float]]], samples: int) -> dict[str, Any]:
    names = "bidex_meta", "rsl_rl"
    seconds = [statistics.median(pair[i][0] for pair in times) for i in range(2)]
    return {
        "ratio": round(statistics.median(theirs[0] / ours[0] for ours, theirs in times), 3),
        "update_ratio": round(statistics.median(theirs[1] / ours[1] for ours, theirs in times), 3),
        "seconds": {name: round(value, 4) for name, value in zip(names, seconds, strict=True)},
        "samples_per_s": {name: round(samples / value) for name, value in zip(names, seconds, strict=True)},
    }


class Noise:
    """A world of random numbers: what a learner does with them costs what it always costs.

    Args:
        num_envs: Rows.
        observations: Size of an observation.
        actions: Number of actions.
        num_tasks: Number of tasks, whose one-hot ends the observation.
        seed: Two worlds of one seed give the same, whatever the actions.
    """

    def __init__(self, num_envs: int, observations: int, actions: int, num_tasks: int, seed: int):
        self.num_envs, self.num_tasks, self.num_id_columns = num_envs, num_tasks, num_tasks
        spaces = make_spaces(Box(-np.inf, np.inf, (observations,), np.float32), actions, num_envs)
        self.single_observation_space, self.single_action_space = spaces.single_observation, spaces.single_action
        self.observation_space, self.action_space = spaces.observation, spaces.action
        self.observation_groups = plain_groups(observations, num_tasks)
        self.device, self.metadata = torch.device("cpu"), {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.task_id = torch.arange(num_envs) * num_tasks // num_envs
        self.task_names = [f"task{i}" for i in range(num_tasks)]
        self.gammas: tuple[float | None, ...] = (None,) * num_tasks
        self.generator = torch.Generator().manual_seed(seed)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Random observations."""
        return self._observe(), {}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Random observations, rewards and ends."""
        reward = torch.randn(self.num_envs, generator=self.generator)
        chance = torch.rand(self.num_envs, generator=self.generator)
        obs = self._observe()
        ended, nobody = chance < _END, torch.zeros(self.num_envs, dtype=torch.bool)
        zeros, none = torch.zeros(self.num_envs), torch.zeros(self.num_envs, dtype=torch.int64)
        info = {"success": nobody, "unstable": nobody, "reward_unscaled": reward, "final_obs": obs, "_final_obs": ended}
        info |= {"running": {"r": zeros, "l": none, "success": nobody, "unscaled": zeros}, "episode_mask": nobody}
        return obs, reward, chance < _END / 2, (chance >= _END / 2) & ended, info

    def state_dict(self) -> dict[str, Any]:
        """Nothing is kept."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing is kept."""

    def close(self) -> None:
        """Nothing is held."""

    def _observe(self) -> Tensor:
        obs = torch.randn(self.num_envs, *self.single_observation_space.shape, generator=self.generator)
        obs[:, -self.num_tasks :] = nn.functional.one_hot(self.task_id, self.num_tasks)
        return obs


class Side(Protocol):
    """One of the two that are compared."""

    def seconds(self) -> tuple[float, float]:
        """Collects a rollout and learns from it: seconds of learning, and of the update alone."""
        ...

    def parameters(self) -> list[nn.Parameter]:
        """Weights of actor and critic."""
        ...


class _Timed(MTPPO):
    """MT-PPO with a clock around its update, the only part of it that is no metric."""

    update_seconds = 0.0

    def _update(self, *given: Any) -> Any:
        start = time.perf_counter()
        losses = super()._update(*given)
        self.update_seconds = time.perf_counter() - start
        return losses


class Ours:
    """MT-PPO.

    Args:
        world: Where rollouts come from.
        config: Of MT-PPO.
        seed: Of weights, actions and shuffling.
    """

    def __init__(self, world: Noise, config: MTPPOConfig, seed: int):
        self.learner = _Timed(world, config, seed)

    def seconds(self) -> tuple[float, float]:
        """See :class:`Side`."""
        return self.learner.iterate()["Perf/learning_time"], self.learner.update_seconds

    def parameters(self) -> list[nn.Parameter]:
        """See :class:`Side`."""
        return [*self.learner.policy.parameters(), *self.learner.critic.parameters()]


class Theirs:
    """rsl-rl's PPO, driven as its own runner does.

    Args:
        world: Where rollouts come from.
        config: Of MT-PPO: the same in rsl-rl's words.
    """

    def __init__(self, world: Noise, config: MTPPOConfig):
        from rsl_rl.algorithms import PPO
        from rsl_rl.models import MLPModel
        from rsl_rl.storage import RolloutStorage

        self.world, self.steps = world, config.rollout_steps
        self.obs = self._pack(world.reset()[0])
        groups = {"actor": ["all"], "critic": ["all"]}
        actions = world.single_action_space.shape[0]
        network = {
            "hidden_dims": config.hidden,
            "activation": config.activation,
            "obs_normalization": config.normalise_observations,
        }
        gaussian = {
            "class_name": "GaussianDistribution",
            "init_std": config.init_std,
            "std_range": config.std_range,
            "std_type": "log",
        }
        actor = MLPModel(self.obs, groups, "actor", actions, **network, distribution_cfg=gaussian)
        critic = MLPModel(self.obs, groups, "critic", 1, **network)
        kept = RolloutStorage("rl", world.num_envs, config.rollout_steps, self.obs, [actions])
        self.ppo = PPO(
            actor,
            critic,
            kept,
            num_learning_epochs=config.epochs,
            num_mini_batches=config.num_minibatches,
            clip_param=config.clip,
            gamma=config.gamma,
            lam=config.lam,
            value_loss_coef=config.value_loss_weight,
            entropy_coef=config.entropy_weight,
            learning_rate=config.learning_rate,
            max_grad_norm=config.max_grad_norm,
            use_clipped_value_loss=False,
            schedule="adaptive" if config.adaptive_learning_rate else "fixed",
            desired_kl=config.desired_kl,
        )
        self.ppo.train_mode()

    def seconds(self) -> tuple[float, float]:
        """See :class:`Side`."""
        with torch.inference_mode():
            for _ in range(self.steps):
                obs, reward, terminated, truncated, _ = self.world.step(self.ppo.act(self.obs))
                self.obs = self._pack(obs)
                self.ppo.process_env_step(self.obs, reward, terminated | truncated, {"time_outs": truncated.float()})
            start = time.perf_counter()
            self.ppo.compute_returns(self.obs)
        prepared = time.perf_counter()
        self.ppo.update()
        done = time.perf_counter()
        return done - start, done - prepared

    def parameters(self) -> list[nn.Parameter]:
        """See :class:`Side`."""
        return [*self.ppo.actor.parameters(), *self.ppo.critic.parameters()]

    def _pack(self, obs: Tensor) -> Any:
        from tensordict import TensorDict

        return TensorDict({"all": obs}, batch_size=[len(obs)])
