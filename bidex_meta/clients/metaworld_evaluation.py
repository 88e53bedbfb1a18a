"""One of our worlds as the ``eval_envs`` of ``metaworld.evaluation``, for agents and scripts that know no other way.

    from bidex_meta.metaworld.evaluation import metalearning_evaluation
    envs = MetaWorldEnvs(Benchmark("ML1").make_world("test", 4, autoreset_mode="DISABLED"))
    metalearning_evaluation(ForMetaWorld(agent), envs, num_evals=1, adaptation_episodes=10)

A check that both protocols fit, not our score: with several rows of a name Meta-World counts the first episodes that
finish, and success ends them, so easy tasks crowd out hard ones. ``bidex_meta.evaluation.meta_test`` plays each task
equally often.
"""

from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from bidex_meta.errors import BidexError
from bidex_meta.world.contract import PooledWorld


class MetaWorldEnvs(VectorEnv):
    """A world in NumPy arrays, with resets in the same step and the attributes and methods that Meta-World calls.

    Args:
        world: In autoreset mode DISABLED: when a row starts anew is decided here, since success may end an episode, and
            a SAME_STEP world would begin with shortened ones.

    Raises:
        BidexError: A world that resets by itself.
    """

    def __init__(self, world: PooledWorld):
        if world.metadata["autoreset_mode"] != AutoresetMode.DISABLED:
            raise BidexError("Expected a world that does not reset by itself. Make it with autoreset_mode='DISABLED'.")
        self.world, self.num_envs = world, world.num_envs
        self.metadata = {**world.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.observation_space = world.single_observation_space, world.observation_space
        self.single_action_space, self.action_space = world.single_action_space, world.action_space
        self.terminate_on_success = False
        self.task_name = [world.task_names[slot] for slot in world.task_id.tolist()]
        self._pools = world.pools
        self._samples = 0
        self._returns = torch.zeros(self.num_envs, dtype=torch.float64, device=world.task_id.device)
        self._lengths = torch.zeros_like(world.task_id)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Starts an episode in every row: observations (num_envs, d)."""
        obs, _ = self.world.reset(seed=seed)
        self._returns.zero_()
        self._lengths.zero_()
        return obs.cpu().numpy(), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every row.

        Args:
            actions: Shape (num_envs, a), in [-1, 1].

        Returns:
            Observations (num_envs, d), in ended rows those of the next episode; rewards, terminated, truncated, and
            info with ``success``, ``final_obs`` and ``final_info`` (``episode``: r, l; ``success``).
        """
        obs, reward, terminated, truncated, info = self.world.step(torch.as_tensor(np.asarray(actions)))
        success = info["success"]
        if self.terminate_on_success:
            terminated = terminated | success
            truncated = truncated & ~success
        ended = terminated | truncated
        self._returns += reward.double()
        self._lengths += 1
        final = {
            "episode": {"r": self._returns.cpu().numpy().copy(), "l": self._lengths.cpu().numpy().copy()},
            "success": success.cpu().numpy(),
        }
        told: dict[str, Any] = {"success": final["success"], "final_obs": obs.cpu().numpy().copy()}
        told |= {"final_info": final, "_final_info": ended.cpu().numpy(), "_final_obs": ended.cpu().numpy()}
        if bool(ended.any()):
            obs, _ = self.world.reset(options={"reset_mask": ended})
            self._returns.masked_fill_(ended, 0.0)
            self._lengths.masked_fill_(ended, 0)
        arrays = (value.cpu().numpy() for value in (obs, reward, terminated, truncated))
        return (*arrays, told)  # type: ignore[return-value]

    def toggle_terminate_on_success(self, on: bool) -> None:
        """Whether an episode ends at its first success."""
        self.terminate_on_success = bool(on)

    def toggle_sample_tasks_on_reset(self, on: bool) -> None:
        """Rows keep their tasks until ``sample_tasks``.

        Raises:
            BidexError: Asked to draw tasks at each reset.
        """
        if on:
            raise BidexError("Rows keep their tasks until sample_tasks(), which is what Meta-World's evaluation asks.")

    def sample_tasks(self) -> None:
        """The next tasks of each pool, one for each row, round and round; they hold from the next reset on."""
        chosen = {}
        for name, pool, rows in zip(self.world.task_names, self._pools, self.world.slot_rows, strict=True):
            count = rows.stop - rows.start
            chosen[name] = pool[(self._samples * count + np.arange(count)) % len(pool)]
        self.world.set_tasks(chosen)
        self._samples += 1

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute for each row."""
        value = getattr(self, name)
        return tuple(value) if name == "task_name" else (value,) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method (or reads an attribute) once, and returns the result for each row."""
        value = getattr(self, name)
        return (value(*args, **kwargs),) * self.num_envs if callable(value) else self.get_attr(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Sets an attribute."""
        setattr(self, name, values)

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the world."""
        self.world.close()
