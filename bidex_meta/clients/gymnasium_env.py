"""One row of a world as a plain `gymnasium.Env` with NumPy arrays, for `gymnasium.make("bidex-meta/CatchUnderarm-v1")`.

For trying things out and for libraries that know single environments only; for speed use the world itself. Its copies
and pickles go on where it was.
"""

import gymnasium
import numpy as np
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.clients.gymnasium_ids import check_render_mode
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import Info, Options


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
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.world = make_task_world(
            task_name, num_envs=1, device=device, seed=seed, autoreset_mode="DISABLED", task_sampling="uniform"
        )
        self.observation_space = self.world.single_observation_space
        self.action_space = self.world.single_action_space

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Starts an episode; with a seed, the same one every time.

        Returns:
            The observation, shape (d,), float32, and an empty info.

        Raises:
            BidexError: An option: there are none.
        """
        super().reset(seed=seed, options=options)
        if options:
            raise BidexError(f"Expected no reset options, got {', '.join(map(str, options))}.")
        obs, _ = self.world.reset(seed=seed)
        return _array(obs), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One control step of 1/60 s.

        Args:
            action: Shape (a,), in [-1, 1].

        Returns:
            Observation (d,) float32, reward, terminated, truncated, and info: ``success`` (of this state),
            ``unstable`` and ``reward_terms``; at the end of an episode also ``is_success``: at any of its steps.
        """
        obs, reward, terminated, truncated, told = self.world.step(torch.as_tensor(action)[None])
        info: Info = {"success": bool(told["success"][0]), "unstable": bool(told["unstable"][0])}
        info["reward_terms"] = {name: float(term[0]) for name, term in told["reward_terms"].items()}
        if terminated[0] or truncated[0]:
            info["is_success"] = bool(told["so_far"]["success"][0])
        return _array(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The picture of this row, shape (height, width, 3), uint8; None without a render mode."""
        return None if self.render_mode is None else self.world.render()

    def close(self) -> None:
        """Frees the world."""
        self.world.close()


def _array(batch: torch.Tensor) -> np.ndarray:
    return batch[0].cpu().numpy()
