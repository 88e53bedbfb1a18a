"""Gymnasium's keys for what ended in a step: ``episode`` and ``final_info`` with their masks."""

import time
from typing import Any

import torch
from torch import Tensor

_FINAL = ("success", "unstable", "reward_unscaled")


def ended_info(info: dict[str, Any]) -> dict[str, Any]:
    """What Gymnasium's vector environments add on steps in which a row ended; rows outside a mask are zero, as theirs.

    Args:
        info: The contract's keys of the step.

    Returns:
        ``episode`` (r, l, success, unscaled of (N,)) and its mask ``_episode``: ended, and counts. ``final_info`` with
        the last step's values, ``episode`` once more, and a mask each; its own mask ``_final_info``: ended.
    """
    ended, counted = info["_final_obs"], info["counted"]
    episode = {name: value.masked_fill(~counted, 0) for name, value in info["so_far"].items()}
    final: dict[str, Any] = {name: info[name].masked_fill(~ended, 0) for name in _FINAL}
    final |= {f"_{name}": ended for name in _FINAL} | {"episode": dict(episode), "_episode": counted}
    return {"episode": episode, "_episode": counted, "final_info": final, "_final_info": ended}


class Clock:
    """Seconds that the rows' episodes have taken: ``t`` of ``episode``. They are no part of a world's state.

    Args:
        num: Rows.
        device: Where they live.
    """

    def __init__(self, num: int, device: torch.device) -> None:
        self._began = torch.full((num,), time.perf_counter(), dtype=torch.float64, device=device)

    def begin(self, mask: Tensor) -> None:
        """Episodes of the rows of a mask begin now."""
        self._began = torch.where(mask, time.perf_counter(), self._began)

    def stamp(self, info: dict[str, Any]) -> None:
        """Adds ``t``, float32 (N,), where ``info`` tells ended episodes."""
        if "episode" in info:
            took = torch.where(info["_episode"], time.perf_counter() - self._began, 0).float()
            info["episode"]["t"], info["final_info"]["episode"]["t"] = took, took.clone()
