"""The choice of an engine for a device."""

import torch

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.engine.protocol import EngineMaker
from bidex_meta.engine.switches import Switches
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.utils.validation import whole_number

ENGINES = ("auto", "c", "warp")


def choose_engine(
    device: str | torch.device, engine: str = "auto", threads: int | None = None, deterministic: bool = False,
    switches: str = ""
) -> tuple[torch.device, EngineMaker]:  # fmt: skip
    """Return the torch device, and a function that builds a physics engine on this device.

    ``engine`` is "c" (C MuJoCo), "warp" (mujoco_warp) or "auto", which selects C MuJoCo on the CPU and mujoco_warp on
    a GPU. ``threads`` is the number of threads of C MuJoCo, by default one per CPU. ``deterministic`` makes results of
    mujoco_warp on a GPU reproducible bit for bit; results of C MuJoCo always are. ``switches`` names experimental
    changes of the physics, see ``Switches``. Raises BidexError for an unknown engine or switch, a missing device, C
    MuJoCo on a GPU, or an impossible number of threads.
    """
    if threads is not None:
        threads = whole_number("threads", threads, 1, 1024)
    place = checked_device(device)
    engine = known_name("engine", engine, ENGINES)
    on = Switches.of(switches)
    if engine == "c" and place.type != "cpu":
        raise BidexError(f"Expected device 'cpu' for the C engine, got {str(device)!r}; leave engine at 'auto'.")
    if engine == "warp" or (engine == "auto" and place.type == "cuda"):
        from bidex_meta.engine.warp import WarpEngine  # mujoco_warp takes seconds to import

        return place, lambda models, rows, room: WarpEngine(
            on.models(models), rows, on.room(models[0], room), str(place), deterministic, on.incremental
        )
    return place, lambda models, rows, room: CpuEngine(on.models(models), rows, threads)


def known_device(device: str | torch.device) -> torch.device:
    """Return the device with this name, even if this machine lacks it; raise BidexError if it is not CPU or CUDA."""
    try:
        place = torch.device(device)
    except (RuntimeError, TypeError, ValueError):
        place = None
    if place is None or place.type not in ("cpu", "cuda") or (place.type == "cpu" and place.index):
        raise BidexError(
            f"device: expected auto, cpu, cuda or cuda:N, got {shortened(device)}. The physics runs on a CPU or on an "
            "NVIDIA GPU."
        )
    return place


def checked_device(device: str | torch.device) -> torch.device:
    """Return the device with this name; ``"auto"`` selects a GPU if there is one, otherwise the CPU.

    Raises BidexError if this machine has no such device.
    """
    if isinstance(device, str) and device == "auto":
        if torch.cuda.is_available():
            device = "cuda"
        else:
            device = "cpu"
    place = known_device(device)
    if place.type == "cpu":
        return place
    if (place.index or 0) >= torch.cuda.device_count():
        raise BidexError(
            f"device: expected one of {torch.cuda.device_count()} CUDA devices, got {shortened(device)}. Use cpu or "
            "auto, or install a torch build with CUDA."
        )
    return torch.device("cuda", place.index or 0)
