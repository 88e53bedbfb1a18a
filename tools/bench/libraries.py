"""What oneDNN's products are worth (:mod:`bidex_algos.nets.products`): MT-PPO's learning with and without, in turns."""

import statistics
from dataclasses import replace
from typing import Any

import torch

from bidex_algos.nets.products import is_faster_here
from bidex_algos.onpolicy.mtppo import PRESETS
from tools.bench.learner import Noise, Ours

ARCHITECTURES = ("shared", "soft_modules", "paco", "moore")


def libraries(
    preset: str = "laptop",
    num_envs: int = 1024,
    repeats: int = 5,
    threads: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Seconds of MT-PPO from a full rollout of random numbers to new weights, by either library, in turns.

    Args:
        preset: Of MT-PPO.
        num_envs: Rows.
        repeats: Of which medians are reported; one before them warms up.
        threads: Threads of torch; None leaves them as they are.
        seed: Of weights and rollouts.

    Returns:
        ``chosen``: whether this machine takes oneDNN; ``table``: for each architecture the seconds of both and their
        ratio, above 1 where oneDNN is faster. Where it is not chosen both are the same, and the ratio is noise.
    """
    before, table = torch.get_num_threads(), []
    torch.set_num_threads(threads or before)
    try:
        for architecture in ARCHITECTURES:
            config = replace(PRESETS[preset], architecture=architecture, autocast="off")
            side = Ours(Noise(num_envs, 450, 52, 4, seed), config, seed)
            took: dict[bool, list[float]] = {True: [], False: []}
            for repeat in range(repeats + 1):
                for own in (True, False) if repeat % 2 else (False, True):
                    with torch.backends.mkldnn.flags(enabled=own):
                        seconds = side.seconds()[0]
                    took[own] += [seconds] * bool(repeat)
            table.append(_row(architecture, took[True], took[False]))
    finally:
        torch.set_num_threads(before)
    return {"chosen": is_faster_here(), "preset": preset, "num_envs": num_envs, "table": table}


def _row(architecture: str, with_it: list[float], without: list[float]) -> dict[str, Any]:
    ratio = statistics.median(slow / fast for fast, slow in zip(with_it, without, strict=True))
    seconds = {"oneDNN": with_it, "without": without}
    return {"architecture": architecture, "ratio": round(ratio, 2)} | {
        name: round(statistics.median(each), 3) for name, each in seconds.items()
    }
