"""Presets of PPO, TRPO and SAC: the multi-task learners on a world of one class, as the appendix's B.1 has them.

Imports no torch. ``PRESETS`` holds what is meant for any class, ``OF_TASK`` what the appendix gives for some alone.
"""

from dataclasses import replace
from typing import Any

from bidex_algos.multiagent import happo_config, hatrpo_config, ippo_config, mappo_config
from bidex_algos.multiagent.config import LIFT
from bidex_algos.offpolicy import mtsac_config
from bidex_algos.onpolicy import mtppo_config, mttrpo_config

# Table 42, column "Other Tasks". What it does not name is as in Table 47.
_PPO = replace(mtppo_config.PRESETS["paper"], hidden=(1024, 1024, 512), gamma=0.96)

PRESETS: dict[str, dict[str, Any]] = {
    "ppo": {**mtppo_config.PRESETS, "paper": _PPO},
    # There is no table for TRPO: networks of Table 42, the rest as for MT-TRPO.
    "trpo": {**mttrpo_config.PRESETS, "paper": replace(mttrpo_config.PRESETS["paper"], hidden=(1024, 1024, 512))},
    # The multi-task preset is made of Table 43, SAC's own.
    "sac": mtsac_config.PRESETS,
}
"""Presets by learner and name."""

HUMANOID = "gymnasium/Humanoid-v5"
# Table 50. What it does not name is as in Table 47 (``paper``) or as for hands (``laptop``, of narrower layers).
_PPO_50: dict[str, Any] = {
    "rollout_steps": 32, "epochs": 5, "num_minibatches": 4, "clip": 0.1, "learning_rate": 3e-4, "gamma": 0.99,
    "lam": 0.95, "init_std": 1.0, "desired_kl": 0.01, "max_grad_norm": 1.0, "entropy_weight": 0.0,
}  # fmt: skip
# Table 49; its 2 epochs of one mini-batch are made after every vector step, as in MT-SAC's ``paper``. Its replay of
# 40,000 counts vector steps, as everywhere here, and ends where ``replay_memory`` does.
_SAC_49: dict[str, Any] = {
    "replay_steps": 40_000, "steps_per_iteration": 32, "updates_per_step": 2, "batch_per_task": 64, "gamma": 0.99,
    "tau": 0.005, "learning_rate": 3e-4, "critic_learning_rate": 3e-4, "init_alpha": 0.2, "max_grad_norm": 1.0,
}  # fmt: skip

OF_TASK: dict[str, dict[str, dict[str, Any]]] = {
    # Table 42's own columns; SAC's Table 43 has the same numbers in all of its columns.
    "ppo": {
        "LiftUnderarm": {"paper": replace(_PPO, rollout_steps=20, epochs=10)},
        "StackBlock": {"paper": replace(_PPO, num_minibatches=8, epochs=2, gamma=0.9)},
        HUMANOID: {
            "paper": replace(mtppo_config.PRESETS["paper"], hidden=(1024, 1024, 1024), **_PPO_50),
            "laptop": replace(mtppo_config.PRESETS["laptop"], hidden=(256, 256, 256), **_PPO_50),
        },
    },
    "sac": {
        HUMANOID: {
            "paper": replace(mtsac_config.PRESETS["paper"], hidden=(1024, 1024, 1024), **_SAC_49),
            "laptop": replace(mtsac_config.PRESETS["laptop"], hidden=(256, 256, 256), **_SAC_49),
        },
    },
    # Tables 44 and 45, whose column for StackBlock is that for other tasks.
    "happo": {"LiftUnderarm": {"paper": replace(happo_config.PRESETS["paper"], **LIFT)}},
    "mappo": {"LiftUnderarm": {"paper": replace(mappo_config.PRESETS["paper"], **LIFT)}},
    "ippo": {"LiftUnderarm": {"paper": replace(ippo_config.PRESETS["paper"], **LIFT)}},
    "hatrpo": {
        "LiftUnderarm": {
            "paper": replace(hatrpo_config.PRESETS["paper"], rollout_steps=LIFT["rollout_steps"], critic_epochs=10)
        }
    },
}
"""Presets that hold for one class alone, by learner, class and name."""
