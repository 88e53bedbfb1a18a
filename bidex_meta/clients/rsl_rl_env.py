"""A world as rsl-rl's VecEnv: `OnPolicyRunner(RslRlVecEnv(world), config)`.

Requires `pip install 'bidex-meta[rsl-rl]'`.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from bidex_meta.clients.needs import check_training, extra
from bidex_meta.clients.trial_env import TrialWorld
from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world.contract import Info, TaskWorld, VectorWorld

with extra("rsl-rl"):
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict


class RslRlVecEnv(VecEnv):
    """All environments of one world as an rsl-rl VecEnv; tensors stay on the world's device.

    Observations are in two groups. The group `policy` contains the `observation_groups` of the world that the argument
    `policy` lists (empty: all). The group `critic` always contains all of them. `cfg` is a dict that rsl-rl's loggers
    store. In `extras`, `time_outs` marks episodes that were cut by the time limit or by broken physics, and `log` has
    the values of `EpisodeLog`, or none if no episode ended.

    `stagger` shortens first episodes (docs/clients.md). rsl-rl's "Mean reward" counts these episodes, but `log` does
    not. Raises BidexError for a world in another autoreset mode than SAME_STEP, for an unknown group, or if
    `episode_length_buf` is set to values that are negative or not whole, or is set for a `TrialWorld`.
    """

    @checked_arguments
    def __init__(self, world: TaskWorld, policy: Sequence[str] = (), cfg: object = None, stagger: bool = False) -> None:
        check_training(world, stagger)
        self.world: Any = world
        self.num_envs = world.num_envs
        self.num_actions = world.action_space.shape[1]
        self.device = world.device
        self.cfg = cfg or {}
        limits = world.max_episode_steps
        if bool((limits == limits[0]).all()):
            self.max_episode_length = int(limits[0])
        else:
            self.max_episode_length = limits
        groups = {group.name: group for group in world.observation_groups}
        for name in set(policy) - groups.keys():
            raise unknown_name("observation group", name, groups)
        entries = []
        for name in policy:
            entries += [torch.arange(part.start, part.stop) for part in groups[name].where]
        if entries:
            self._policy = torch.cat(entries).to(world.device)
        else:
            self._policy = None
        self._log = EpisodeLog(world)
        self._obs: Tensor | None = None

    @property
    def episode_length_buf(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Steps that each environment's running episode has lasted, int64 (num_envs,).

        Setting the property shortens the running episodes, which then do not count. Trials cannot be shortened.
        """
        if isinstance(self.world, TrialWorld):
            return self.world.elapsed
        return self.world.episodes.elapsed.clone()

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        if isinstance(self.world, TrialWorld):
            raise BidexError("episode_length_buf: expected whole trials. Leave init_at_random_ep_len False.")
        given = dense(value, self.world.device)
        if given is None:
            steps = torch.zeros(0)
        else:
            steps = given.to(torch.int64)
        if given is None or steps.shape != (self.num_envs,) or not bool(((given >= 0) & (given == steps)).all()):
            got = shortened(value if given is None else given.tolist())
            fault = f"whole numbers from 0 on, shape ({self.num_envs},), got {got}"
            raise BidexError(f"episode_length_buf: expected {fault}. Give steps, one number for each environment.")
        self.get_observations()
        episodes = self.world.episodes
        episodes.counts = episodes.counts & (steps == episodes.elapsed)
        episodes.elapsed = steps.minimum(self.world.max_episode_steps - 1)

    def reset(self, seed: int | None = None) -> tuple[TensorDict, Info]:
        """Start episodes of all environments."""
        with torch.inference_mode(False):
            self._obs = self.world.reset(seed=seed)[0]
            self._log = EpisodeLog(self.world)
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        """Return the present observations, `policy` (num_envs, p) and `critic` (num_envs, d)."""
        if self._obs is None:
            return self.reset()[0]
        if self._policy is None:
            policy = self._obs
        else:
            policy = self._obs[:, self._policy]
        return TensorDict({"policy": policy, "critic": self._obs}, [self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, Info]:
        """Take actions (num_envs, a); return observations, rewards and dones (num_envs,), and extras."""
        with torch.inference_mode(False), torch.no_grad():  # the world's tensors outlive the runner's inference mode
            self._obs, reward, terminated, truncated, info = self.world.step(actions)
            extras = {"time_outs": truncated, "log": self._log.update(info, terminated, truncated)}
            return self.get_observations(), reward, terminated | truncated, extras


class EpisodeLog:
    """Log of the episodes that ended since a full reset, under the tags of Isaac Lab, mjlab and rsl-rl."""

    def __init__(self, world: VectorWorld) -> None:
        self._world = world
        self._terms: dict[str, Tensor] = {}

    def update(self, info: Info, terminated: Tensor, truncated: Tensor) -> dict[str, Tensor]:
        """Return metrics of the episodes that ended in a step, by tag; the dict is empty if none ended.

        Each metric has one value per episode, float32; the logger averages them. Full episodes yield
        `Metrics/success_rate`, `Metrics/return`, `Metrics/length`, `Metrics/success/<task>` and, as sums over an
        episode, `Episode_Reward/<term>`. All episodes, also shortened ones, yield three tags that begin with
        `Episode_Termination/`: `terminated`, `time_out` and `unstable`.
        """
        ended = info["_final_obs"]
        episode_mask = info["episode_mask"]
        world = self._world
        for name, term in info.get("reward_terms", {}).items():
            self._terms[name] = self._terms.get(name, 0.0) + term
        if not bool(ended.any()):
            return {}
        unstable = info["unstable"]
        ends = {"terminated": terminated, "time_out": truncated & ~unstable, "unstable": unstable}
        log = {f"Episode_Termination/{name}": value[ended].float() for name, value in ends.items()}
        log |= {f"Episode_Reward/{name}": term[episode_mask] for name, term in self._terms.items()}
        success = info["running"]["success"].float()
        log |= {"Metrics/success_rate": success[episode_mask], "Metrics/return": info["running"]["r"][episode_mask]}
        log["Metrics/length"] = info["running"]["l"][episode_mask].float()
        for slot in world.task_id[episode_mask].unique().tolist():
            log[f"Metrics/success/{world.task_names[slot]}"] = success[episode_mask & (world.task_id == slot)]
        self._terms = {name: term.masked_fill(ended, 0.0) for name, term in self._terms.items()}
        return {name: value for name, value in log.items() if len(value)}
