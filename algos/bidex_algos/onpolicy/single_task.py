"""PPO on a single task class: MT-PPO with the presets of the Bi-DexHands appendix for single tasks (B.1)."""

from dataclasses import replace

from bidex_algos.nets.architecture import Options
from bidex_algos.onpolicy.mtppo import MTPPO, PRESETS, MTPPOConfig

# These values are from Table 42, column "Other Tasks", and the others from Table 47.
_PAPER = replace(PRESETS["paper"], hidden=(1024, 1024, 512), gamma=0.96)
# These values are from Table 50. The others are from Table 47 (``paper``) or from the preset for hands (``laptop``,
# with narrower layers).
_TABLE_50: Options = {
    "rollout_steps": 32, "epochs": 5, "num_minibatches": 4, "clip": 0.1, "learning_rate": 3e-4, "gamma": 0.99,
    "lam": 0.95, "init_std": 1.0, "desired_kl": 0.01,
}  # fmt: skip
TASK_PRESETS: dict[str, dict[str, MTPPOConfig]] = {
    # These values are from Table 42's own columns.
    "LiftUnderarm": {"paper": replace(_PAPER, rollout_steps=20, epochs=10)},
    "StackBlock": {"paper": replace(_PAPER, num_minibatches=8, epochs=2, gamma=0.9)},
    "gymnasium/Humanoid-v5": {
        "paper": replace(PRESETS["paper"], hidden=(1024, 1024, 1024), **_TABLE_50),
        "laptop": replace(PRESETS["laptop"], hidden=(256, 256, 256), **_TABLE_50),
    },
}


class PPO(MTPPO):
    """Single-task PPO (Schulman et al. 2017, arXiv 1707.06347) on a batched world.

    The class is MT-PPO with the presets of the Bi-DexHands appendix for a single task (B.1).
    """

    presets = PRESETS | {"paper": _PAPER}
    task_presets = TASK_PRESETS
