"""Where bfloat16 pays: the one place that decides whether hidden layers run under autocast."""

import torch

from bidex_algos.choices import Autocast


def use_bfloat16(setting: Autocast, device: torch.device) -> bool:
    """Whether to run hidden layers in bfloat16: "auto" means on a CUDA device or a CPU with AMX tiles.

    Without AMX, bfloat16 matrix products on a CPU are emulated and slower than float32.
    """
    if setting != "auto":
        return setting == "on"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    amx = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return device.type == "cpu" and amx is not None and bool(amx())


def autocast(device: torch.device, enabled: bool) -> torch.autocast:
    """The autocast context for ``device``; does nothing unless ``enabled``."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)
