"""Ended episodes under the tags that Isaac Lab, mjlab and rsl-rl know."""

from typing import Any

from torch import Tensor

from bidex_meta.world.contract import VectorWorld


class EpisodeLog:
    """Collects sums of reward terms from a reset of all rows on.

    Args:
        world: Whose steps are told.
    """

    def __init__(self, world: VectorWorld) -> None:
        self._world = world
        self._terms: dict[str, Tensor] = {}

    def update(self, told: dict[str, Any], terminated: Tensor, truncated: Tensor) -> dict[str, Tensor]:
        """What ended in a step.

        Args:
            told: The step's info.
            terminated: Shape (N,), bool.
            truncated: Shape (N,), bool.

        Returns:
            Values of the rows that ended, (k,), float32, to be averaged; nothing where none did. Of episodes that
            count `Metrics/success_rate`, `Metrics/return`, `Metrics/length`, `Metrics/success/<task>` and, as sums over
            an episode, `Episode_Reward/<term>`; of all `Episode_Termination/terminated`, `time_out` and `unstable`.
        """
        ended, counted, world = told["_final_obs"], told["counted"], self._world
        for name, term in told.get("reward_terms", {}).items():
            self._terms[name] = self._terms.get(name, 0.0) + term
        if not bool(ended.any()):
            return {}
        unstable = told["unstable"]
        ends = {"terminated": terminated, "time_out": truncated & ~unstable, "unstable": unstable}
        log = {f"Episode_Termination/{name}": value[ended].float() for name, value in ends.items()}
        log |= {f"Episode_Reward/{name}": term[counted] for name, term in self._terms.items()}
        success = told["so_far"]["success"].float()
        log |= {"Metrics/success_rate": success[counted], "Metrics/return": told["so_far"]["r"][counted]}
        log["Metrics/length"] = told["so_far"]["l"][counted].float()
        for slot in world.task_id[counted].unique().tolist():
            log[f"Metrics/success/{world.task_names[slot]}"] = success[counted & (world.task_id == slot)]
        self._terms = {name: term.masked_fill(ended, 0.0) for name, term in self._terms.items()}
        return {name: value for name, value in log.items() if len(value)}
