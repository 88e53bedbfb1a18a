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

OF_TASK: dict[str, dict[str, dict[str, Any]]] = {
    # Table 42's own columns; SAC's Table 43 has the same numbers in all of its columns.
    "ppo": {
        "LiftUnderarm": {"paper": replace(_PPO, rollout_steps=20, epochs=10)},
        "StackBlock": {"paper": replace(_PPO, num_minibatches=8, epochs=2, gamma=0.9)},
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
