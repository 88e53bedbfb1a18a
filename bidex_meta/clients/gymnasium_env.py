"""A single environment as `gymnasium.Env` with NumPy arrays; its copies and pickles continue as the original would."""

import gymnasium
import numpy as np
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.clients.gymnasium_ids import both_seeds, check_render_mode
from bidex_meta.errors import BidexError
from bidex_meta.world.checked import one_row
from bidex_meta.world.contract import Info, Options
from bidex_meta.world.episodes import check_single_reset


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task class as a single environment: goal visible, one of 50 tasks drawn each episode.

    `seed` chooses the 50 tasks. It also seeds the starts, until `reset(seed=...)` sets another seed. Without `seed`,
    the tasks are those of seed 0, and the starts differ from environment to environment. With `touch`, observations
    show touch sensors. Raises BidexError for an unknown task class or a render mode other than None and `"rgb_array"`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012  (Gymnasium's own convention)

    def __init__(
        self, task_name: str, render_mode: str | None = None, seed: int | None = None,
        device: str | torch.device = "cpu", touch: bool = False
    ) -> None:  # fmt: skip
        check_render_mode(render_mode)
        self.render_mode = render_mode
        task_seed, start_seed = both_seeds(seed)
        self.world = make_task_world(
            task_name,
            num_envs=1,
            device=device,
            seed=start_seed,
            autoreset_mode="DISABLED",
            task_sampling="uniform",
            task_seed=task_seed,
            touch=touch,
        )
        self.observation_space = self.world.single_observation_space
        self.action_space = self.world.single_action_space
        self._over = True

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Start an episode; return the observation (d,), float32, and an empty info.

        The same seed always gives the same episode. There are no options.
        """
        check_single_reset(seed, options)
        super().reset(seed=seed, options=options)
        obs, _ = self.world.reset(seed=seed)
        self._over = False
        return obs[0].cpu().numpy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Advance the environment by 1/60 s with an action (a,) in [-1, 1].

        Returns observation (d,) float32, reward, terminated, truncated and info. `info` has ``unstable``,
        ``reward_terms`` and ``success``: whether the present state meets the goal, or, in version 2, whether the goal
        has been held for 0.25 s. ``is_success`` is the success of the episode if it ends at this step: in version 1
        whether the goal was met at any step, in version 2 whether it is held now. It is given in every step, because a
        wrapper may end an episode earlier than this environment.
        BidexError is raised if no episode is running, because otherwise the end of the last episode would count twice.
        """
        if self._over:
            raise BidexError("Expected reset() before step(): there is no running episode.")
        obs, reward, terminated, truncated, batch = self.world.step(one_row(action, self.action_space))
        info: Info = {"success": bool(batch["success"][0]), "unstable": bool(batch["unstable"][0])}
        info["reward_terms"] = {name: float(term[0]) for name, term in batch["reward_terms"].items()}
        info["is_success"] = bool(batch["running"]["success"][0])
        self._over = bool(terminated[0] or truncated[0])
        return obs[0].cpu().numpy(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (height, width, 3), uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        return self.world.render()

    def close(self) -> None:
        """Free the world."""
        self.world.close()
