"""One row of a world as a plain `gymnasium.Env` with NumPy arrays, for `gymnasium.make("bidex-meta/CatchUnderarm-v1")`.

For trying things out and for libraries that know single environments only; for speed use the world itself.
"""

from typing import Any

import gymnasium
import numpy as np
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task class as a single environment: goal visible, one of 50 tasks drawn each episode.

    Args:
        task_name: E.g. `"CatchUnderarm"`.
        render_mode: None or `"rgb_array"`.
        seed: Chooses the 50 tasks, and the starts until `reset(seed=...)` says otherwise.
        device: Where the physics runs; one row is fastest on the CPU.

    Raises:
        BidexError: Unknown task class or render mode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012  (Gymnasium's own convention)

    def __init__(
        self, task_name: str, render_mode: str | None = None, seed: int = 0, device: str | torch.device = "cpu"
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise BidexError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}.")
        self.render_mode = render_mode
        self.world = make_task_world(
            task_name, num_envs=1, device=device, seed=seed, autoreset_mode="DISABLED", task_sampling="uniform"
        )
        self.observation_space = self.world.single_observation_space
        self.action_space = self.world.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Starts an episode; with a seed, the same one every time.

        Returns:
            The observation, shape (d,), float32, and the world's info of this row.
        """
        super().reset(seed=seed, options=options)
        obs, info = self.world.reset(seed=seed, options=options or None)
        return _array(obs), _row(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One control step of 1/60 s.

        Args:
            action: Shape (a,), in [-1, 1].

        Returns:
            Observation (d,) float32, reward, terminated, truncated, and the world's info of this row.
        """
        obs, reward, terminated, truncated, info = self.world.step(torch.as_tensor(action)[None])
        return _array(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _row(info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The picture of this row, shape (height, width, 3), uint8; None without a render mode."""
        return None if self.render_mode is None else self.world.render()

    def close(self) -> None:
        """Frees the world."""
        self.world.close()


def _array(batch: torch.Tensor) -> np.ndarray:
    return batch[0].cpu().numpy()


def _row(info: dict[str, Any]) -> dict[str, Any]:
    """The first row of a batched info: numbers and flags as Python values, vectors as arrays."""
    row = {}
    for key, value in info.items():
        if isinstance(value, dict):
            row[key] = _row(value)
        elif isinstance(value, torch.Tensor):
            row[key] = value[0].item() if value.ndim == 1 else _array(value)
        else:
            row[key] = value
    return row
