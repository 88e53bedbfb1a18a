"""Options of a batched world of hands."""

from dataclasses import dataclass

import torch
from gymnasium.vector import AutoresetMode

from bidex_meta.errors import BidexError, shortened
from bidex_meta.rules import Randomisation
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import checked
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.episodes import checked_mode
from bidex_meta.world.observations import Rule
from bidex_meta.world.rendering import MOST_PIXELS


@dataclass(frozen=True)
class WorldConfig:
    """Options of a world, independent of its slots.

    Attributes:
        num_envs: Number of environments, split evenly over slots; None: 1024 on the CPU, 8192 on an accelerator.
        device: "cpu", "auto" (CUDA if there is one) or a CUDA device, e.g. "cuda:0".
        engine: "c" (C MuJoCo, on the CPU), "warp" (mujoco_warp, on either) or "auto": the faster one on the device.
        deterministic: Make physics on a GPU repeat bit for bit; on a CPU it always does.
        switches: Changes of the physics that are on trial, such as "incremental" (``engine.switches.Switches``).
        seed: Seed of all random draws.
        autoreset_mode: SAME_STEP (training), NEXT_STEP (training by Gymnasium's tools) or DISABLED (evaluation), as a
            member or its name.
        observation: "plain", "one-hot" (task id appended) or "masked" (goal entries zero).
        pad_to: Number of observation entries before the task id; None: the number of the widest class.
        task_sampling: "uniform": each episode draws a task of the pool; "fixed": environment j keeps task j mod n;
            "fresh": each episode draws a new task of its class's space; in DISABLED mode this means "fixed".
        episodes_per_task: Number of consecutive episodes that play one task, if episodes draw tasks.
        threads: Engine threads; None: all CPUs. Trajectories do not depend on the number.
        stagger: If true, first episodes in SAME_STEP mode begin at random elapsed steps, so that they do not end
            together; they do not count in ``episode``. If false, first episodes begin at 0.
        points: Point cloud before the task id, in place of the objects' states; None: observations show the states.
        randomisation: Factors that are drawn for environments, and noise that is added; None: neither.
        pixels: Edge, in pixels, of the square pictures in ``info["pixels"]`` from the classes' cameras; 0: no pictures.

    Raises BidexError for an unknown sampling or observation, a seed below 0, pictures that are too large, or several
    episodes per task if environments keep their tasks.
    """

    num_envs: int | None = None
    device: str | torch.device = "cpu"
    engine: str = "auto"
    deterministic: bool = False
    switches: str = ""
    seed: int = 0
    autoreset_mode: str | AutoresetMode | None = None
    observation: Rule = "plain"
    pad_to: int | None = None
    task_sampling: str = "fixed"
    threads: int | None = None
    stagger: bool = True
    points: PointsRule | None = None
    randomisation: Randomisation | None = None
    pixels: int = 0
    episodes_per_task: int = 1

    def __post_init__(self) -> None:
        checked.choices(self.task_sampling, self.observation, self.points)
        checked.seed(self.seed)
        whole_number("pixels", self.pixels, 0, MOST_PIXELS)
        checked.episodes_per_task(self.episodes_per_task, self.task_sampling, checked_mode(self.autoreset_mode))
        if self.randomisation is not None and not isinstance(self.randomisation, Randomisation):
            mend = "Write Randomisation(friction=(0.7, 1.3)), of bidex_meta.rules."
            raise BidexError(f"randomisation: expected a Randomisation, got {shortened(self.randomisation)}. {mend}")
