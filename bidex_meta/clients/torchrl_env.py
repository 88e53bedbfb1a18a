"""A world as TorchRL's environment: `Collector(TorchRLEnv(world), policy, ...)`.

Requires `pip install 'bidex-meta[torchrl]'`.
"""

import torch
from torch import Tensor

from bidex_meta.clients.needs import check_training, extra
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world.contract import VectorWorld

with extra("torchrl"):
    from tensordict import TensorDict, TensorDictBase
    from torchrl import data, envs

_EPISODE = {"r": torch.float32, "l": torch.int64, "success": torch.bool}


class TorchRLEnv(envs.EnvBase):
    """All environments of one world as a TorchRL environment with batch size (num_envs,); entries are (num_envs, ...).

    `next` always holds the observation that the step led to, also if the episode ended. After an end TorchRL requests a
    reset, which returns the first observation of the new episode; the world has already begun this episode. Two entries
    come in addition to `observation`: `success` of the present state, and `episode`, which holds return `r`, length `l`
    and `success` of the episode so far.

    `stagger` shortens first episodes (docs/clients.md); TorchRL's transforms count shortened episodes too. Raises
    BidexError for a world in another autoreset mode than SAME_STEP.
    """

    @checked_arguments
    def __init__(self, world: VectorWorld, stagger: bool = False) -> None:
        check_training(world, stagger)
        rows = world.num_envs
        device = world.device
        super().__init__(device=device, batch_size=torch.Size([rows]))
        self.world = world
        self._world_seed = None
        low = torch.as_tensor(world.observation_space.low)
        high = torch.as_tensor(world.observation_space.high)
        if bool(low.isfinite().all() and high.isfinite().all()):
            seen = data.Bounded(low, high, device=device)
        else:
            seen = data.Unbounded(low.shape, device=device)
        column = torch.Size([rows, 1])
        flag = data.Binary(1, column, dtype=torch.bool, device=device)
        counters = {name: data.Unbounded(column, dtype=_EPISODE[name], device=device) for name in ("r", "l")}
        episode = data.Composite({**counters, "success": flag}, shape=(rows,))
        self.observation_spec = data.Composite(observation=seen, success=flag.clone(), episode=episode, shape=(rows,))
        ends = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.done_spec = data.Composite(ends, shape=(rows,))
        self.action_spec = data.Bounded(-1.0, 1.0, torch.Size(world.action_space.shape), device=device)
        self.reward_spec = data.Unbounded(column, device=device)
        self._obs = torch.zeros_like(low, device=device)
        self._begun = torch.zeros(rows, dtype=torch.bool, device=device)

    def _set_seed(self, seed: int | None) -> None:
        self._world_seed = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is None:
            mask = torch.ones_like(self._begun)
        else:
            mask = asked.squeeze(-1)
        left = mask & ~self._begun  # environments whose episode did not end in the last step
        if asked is None or bool(left.all()):
            self._obs, _ = self.world.reset(seed=self._world_seed)
            self._world_seed = None
        elif bool(left.any()):
            self._obs, _ = self.world.reset(options={"reset_mask": left})
        self._begun = self._begun & ~mask
        return self._entries(self._obs, {name: torch.zeros_like(mask, dtype=kind) for name, kind in _EPISODE.items()})

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._obs, reward, terminated, truncated, info = self.world.step(tensordict.get("action"))
        self._begun = terminated | truncated
        entries = self._entries(info["final_obs"], info["running"], info["success"])
        ends = {"reward": reward, "done": self._begun, "terminated": terminated, "truncated": truncated}
        return entries.update({name: value[:, None] for name, value in ends.items()})

    def _entries(self, obs: Tensor, episode: dict[str, Tensor], success: Tensor | None = None) -> TensorDict:
        running = TensorDict({name: episode[name][:, None] for name in _EPISODE}, self.batch_size)
        if success is None:
            success = torch.zeros_like(self._begun)
        entries = {"observation": obs.clone(), "success": success[:, None], "episode": running}
        return TensorDict(entries, self.batch_size, device=self.device)
