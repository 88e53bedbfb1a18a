"""Which engine a device gets."""

import torch

from bidex_meta.engine.protocol import EngineMaker
from bidex_meta.errors import BidexError, shortened
from bidex_meta.validation import whole_number

ENGINES = ("auto", "c", "warp")
_MOST_THREADS = 1024


def choose_engine(
    device: str | torch.device, engine: str = "auto", threads: int | None = None
) -> tuple[torch.device, EngineMaker]:
    """The device and what makes engines there.

    Args:
        device: "cpu" or a CUDA device.
        engine: "c", "warp" or "auto": C MuJoCo on the CPU, mujoco_warp on a GPU.
        threads: Threads of C MuJoCo; None takes all CPUs.

    Raises:
        BidexError: Unknown engine, a device that is not there, C MuJoCo on a GPU, or an impossible number of threads.
    """
    if threads is not None:
        threads = whole_number("threads", threads, 1, _MOST_THREADS)
    place = _device(device)
    if not isinstance(engine, str) or engine not in ENGINES:
        raise BidexError(f"Expected an engine among {', '.join(ENGINES)}, got {shortened(engine)}.")
    if engine == "c" and place.type != "cpu":
        raise BidexError(f"Expected device 'cpu' for the C engine, got {str(device)!r}; leave engine at 'auto'.")
    if engine == "warp" or (engine == "auto" and place.type == "cuda"):
        from bidex_meta.engine.warp import WarpEngine

        return place, lambda models, rows, room: WarpEngine(models, rows, room, device=str(place))
    from bidex_meta.engine.cpu import CpuEngine

    return place, lambda models, rows, room: CpuEngine(models, rows, threads)


def _device(device: str | torch.device) -> torch.device:
    try:
        place = torch.device(device)
    except (RuntimeError, TypeError):
        place = None
    if place is None or place.type not in ("cpu", "cuda"):
        raise BidexError(f"Expected device 'cpu' or 'cuda:N', got {str(device)!r}.")
    if place.type == "cuda" and (place.index or 0) >= torch.cuda.device_count():
        raise BidexError(
            f"Expected one of {torch.cuda.device_count()} CUDA devices, got {str(device)!r}; "
            "use device 'cpu', or install a torch build with CUDA."
        )
    return torch.device("cuda", place.index or 0) if place.type == "cuda" else place
