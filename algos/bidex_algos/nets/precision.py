"""Where bfloat16 pays: the one place that decides whether hidden layers run under autocast."""

import torch

from bidex_algos.choices import Autocast


def use_bfloat16(setting: Autocast, device: torch.device) -> bool:
    """Whether to run hidden layers in bfloat16: "auto" means on a CUDA device or a CPU that multiplies it.

    CPUs with AMX tiles or AVX-512's BF16 do; on others such products are emulated and slower than float32.
    """
    if setting != "auto":
        return setting == "on"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and any(_cpu_tells(name) for name in ("amx_tile", "avx512_bf16"))


def _cpu_tells(name: str) -> bool:
    """Whether PyTorch finds this in the processor; False of what its version cannot tell."""
    told = getattr(torch.cpu, f"_is_{name}_supported", None)
    return told is not None and bool(told())


def autocast(device: torch.device, enabled: bool) -> torch.autocast:
    """The autocast context for ``device``; does nothing unless ``enabled``."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)
