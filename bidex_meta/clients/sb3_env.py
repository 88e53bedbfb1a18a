"""A world as stable-baselines3's VecEnv: `PPO("MlpPolicy", SB3VecEnv(world))`.

Requires `pip install 'bidex-meta[sb3]'`.
"""

import math
from collections import defaultdict, deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from bidex_meta.clients.needs import check_training, extra
from bidex_meta.errors import BidexError
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world import checked
from bidex_meta.world.contract import Info, VectorWorld

_Rows = None | int | Iterable[int]

with extra("sb3"):
    from stable_baselines3.common import callbacks, monitor, vec_env


class SB3VecEnv(vec_env.VecEnv):
    """All environments of one world as a stable-baselines3 (SB3) VecEnv, with NumPy arrays.

    One SB3 seed seeds the starts of all environments. When an episode ends, the environment's entry of `infos` has
    `terminal_observation` and `TimeLimit.truncated`. If the latter is true, SB3 bootstraps from the value of that
    observation. The entry also has `episode` (r, l, t), `is_success` (by the suite's rule) and `task`, unless the
    episode was shortened.

    `stagger` shortens first episodes (docs/clients.md). SB3 does not count shortened episodes, but `VecMonitor` does.
    Raises BidexError for a world in another autoreset mode than SAME_STEP.
    """

    @checked_arguments
    def __init__(self, world: VectorWorld, stagger: bool = False) -> None:
        check_training(world, stagger)
        self.world: Any = world
        self._names = [world.task_names[task] for task in world.task_id.tolist()]
        super().__init__(world.num_envs, world.single_observation_space, world.single_action_space)
        self.metadata = world.metadata

    def reset(self) -> np.ndarray:
        """Start all episodes; return observations (num_envs, d)."""
        obs, _ = self.world.reset(seed=self._seeds[0], options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        return obs.cpu().numpy()

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (num_envs, a)."""
        self._actions = checked.action(actions, self.world.action_space.shape, self.world.device)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:
        """Take the stored actions; return observations (num_envs, d), rewards and dones (num_envs,), and infos."""
        obs, reward, _, truncated, info = self.world.step(self._actions)
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        ended = info["_final_obs"]
        rows = ended.nonzero().squeeze(1).tolist()
        if rows:
            values = {"truncated": truncated, "episode_mask": info["episode_mask"]}
            values |= info.get("episode", info["running"])
            columns = {name: value[ended].tolist() for name, value in values.items()}
            for i, (row, final) in enumerate(zip(rows, info["final_obs"][ended].cpu().numpy(), strict=True)):
                infos[row] = {"terminal_observation": final, "TimeLimit.truncated": columns["truncated"][i]}
                if columns["episode_mask"][i]:
                    episode = {name: columns[name][i] for name in ("r", "l", "t") if name in columns}
                    infos[row] |= {"episode": episode, "is_success": columns["success"][i], "task": self._names[row]}
        return obs.cpu().numpy(), reward.cpu().numpy(), ended.cpu().numpy(), infos

    def get_attr(self, attr_name: str, indices: _Rows = None) -> list[object]:
        """Return an attribute of the world as a list with one value for each environment in `indices` (None: all)."""
        return [self.world.get_attr(attr_name)[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: _Rows = None) -> None:
        """Set an attribute of the world; raise BidexError if ``indices`` leave out environments."""
        self._check_all("set_attr", indices)
        setattr(self.world, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: object, indices: _Rows = None, **method_kwargs: object
    ) -> list[object]:
        """Call a method of the world once; return its result for each environment in ``indices`` (None: all).

        ``render`` is called for each of these environments. Raises BidexError if ``reset`` leaves out environments.
        """
        if method_name == "render":
            rows = self._get_indices(indices)
            return [self.world.render(*method_args, env_id=row, **method_kwargs) for row in rows]
        if method_name == "reset":
            self._check_all(method_name, indices)
        return [getattr(self.world, method_name)(*method_args, **method_kwargs)] * len(list(self._get_indices(indices)))

    def _check_all(self, method: str, indices: _Rows) -> None:
        if len(set(self._get_indices(indices))) < self.num_envs:
            raise BidexError(f"{method}: expected all environments of the world, got {indices}. Leave indices out.")

    def env_is_wrapped(self, wrapper_class: type, indices: _Rows = None) -> list[bool]:
        """Return for each environment whether a wrapper is present: True only for `Monitor`.

        SB3's evaluation therefore takes returns and lengths from `infos`, which report whole episodes.
        """
        return [wrapper_class is monitor.Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> list[np.ndarray]:
        """Return a picture of each environment, uint8; SB3's `render` and `VecVideoRecorder` tile them.

        A single picture has 640 x 480 pixels. Several pictures have about 1280 x 960 pixels together, and at least 32 x
        24 pixels each.
        """
        columns = math.ceil(math.sqrt(self.num_envs))
        width = max(32, min(640, 1280 // columns // 4 * 4))
        return [self.world.render(env_id=row, width=width, height=width * 3 // 4) for row in range(self.num_envs)]

    def close(self) -> None:
        """Free the world."""
        self.world.close()


class SuccessPerTask(callbacks.BaseCallback):
    """Logs `rollout/success/<task>`, the share of successes among each task's last 100 episodes."""

    def _on_training_start(self) -> None:
        self._solved: dict[str, deque[bool]] = defaultdict(lambda: deque(maxlen=100))

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "is_success" in info:
                self._solved[info["task"]].append(info["is_success"])
        return True

    def _on_rollout_end(self) -> None:
        for task, solved in self._solved.items():
            self.logger.record(f"rollout/success/{task}", sum(solved) / len(solved))
