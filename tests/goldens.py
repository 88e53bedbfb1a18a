"""Golden trajectories: what each class did over fifty steps when the file ``tests/data/goldens.npz`` was written.

``make goldens`` (``python -m tests.goldens write``) writes it anew; that is a change of results and stands in
CHANGELOG.md. ``python -m tests.goldens show`` compares without a test, class by class (docs/reliability.md).

Where bits differ, the tolerance of a step is ``PLAIN``, plus ``FACTOR`` times what a change in the last digits of all
positions at the start came to by then: that was measured as the file was written and stands in it.
"""

import hashlib
import platform
import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.models import model_identity
from bidex_meta.tasks import registry
from bidex_meta.world import World

FILE = Path(__file__).parent / "data" / "goldens.npz"
STEPS, ROWS = 50, 2
KEPT = (1, 2, 3, 4, 5, 7, 10, 14, 20, 27, 35, 42, 50)
"""Steps whose values are kept; of all others a digest."""
NUDGES = (2.3e-16, -2.3e-16, 1e-15, 1e-14)
"""Relative changes of the positions at the start: one bit up and down, and a few."""
PLAIN, FACTOR = 1e-4, 10.0
"""Of the tolerance; relative to a value, or to 1 where it is smaller."""
VARIANTS = [(name, None) for name in registry.names()] + [("HandOver", True)]
"""Every class as it is alone, HandOver (the only one whose base is fixed there) with a moving base too."""


@dataclass(frozen=True)
class Trajectory:
    """What one class did.

    Attributes:
        physics: MuJoCo's version, ``model_identity`` of the scene and the number of substeps.
        build: What may change the last digits: versions of torch, numpy and the C library, and the processor's kind.
        names: Of the quantities: the blocks of the observation, ``reward``, ``ended``.
        values: (kept steps, rows, quantities), float32; of a block the sum of its entries, each with a weight of its
            own between -1 and 1, over the root of their number.
        digests: Of each step all bits of observations, rewards, ends and of the engine's positions and velocities.
        spread: (kept steps,), how far the changed starts' values were from these by then, relative as the tolerance.
    """

    physics: str
    build: str
    names: list[str]
    values: np.ndarray
    digests: list[str]
    spread: np.ndarray


def title(name: str, moving: bool | None) -> str:
    """A variant's name in files and messages."""
    return name if moving is None else f"{name} ({'moving' if moving else 'fixed'} base)"


def actions(step: int, size: int) -> torch.Tensor:
    """Actions (rows, size) of a step, held for five: multiples of 1/32, so exact on every machine; in [-1, 1]."""
    row, column = torch.arange(ROWS)[:, None], torch.arange(size)[None, :]
    return ((31 * column + 7 * column**2 + 101 * row + 17 * (step // 5) ** 2) % 65 - 32) / 32.0


def record(name: str, moving: bool | None, nudge: float = 0.0) -> Trajectory:
    """Plays a class.

    Args:
        name: The class.
        moving: Whether its base moves; None: as it is alone.
        nudge: Factor on all positions after the reset, less 1.
    """
    world = make_task_world(
        name, ROWS, "cpu", seed=0, threads=1, moving_base=moving, engine="c", stagger=False, autoreset_mode="SAME_STEP"
    )
    world.reset(seed=0)
    part = world.parts[0]
    engine = part.group.engine
    engine.qpos *= 1.0 + nudge
    values, digests = [], []
    for step in range(STEPS):
        obs, reward, terminated, truncated, _ = world.step(actions(step, world.action_size))
        ended = terminated | truncated
        digest = hashlib.sha256()
        for tensor in (obs, reward, ended, engine.qpos, engine.qvel):
            digest.update(tensor.contiguous().numpy().tobytes())
        digests.append(digest.hexdigest()[:12])
        if step + 1 in KEPT:
            values.append(_values(world, obs, reward, ended))
    blocks = [block.name for block, _ in world.slots[0].task_class.layout]
    physics = f"MuJoCo {mujoco.__version__}, {model_identity(part.group.members[0].scene.model)} x {part.substeps}"
    world.close()
    names = [*blocks, "reward", "ended"]
    return Trajectory(physics, build(), names, np.stack(values), digests, np.zeros(len(KEPT)))


def build() -> str:
    """What may change the last digits here; processors with AVX2 and with AVX-512 gave the same bits."""
    fused = "FMA" if torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512") else "no FMA"
    libraries = f"torch {torch.__version__.partition('+')[0]}, numpy {np.__version__}, {' '.join(platform.libc_ver())}"
    return f"{libraries}, {platform.machine()}, {fused}"


def distance(golden: Trajectory, new: Trajectory) -> np.ndarray:
    """How far values are apart, relative to the golden ones, or to 1 where they are smaller. Infinite where NaN."""
    was = golden.values.astype(np.float64)
    return np.nan_to_num(np.abs(new.values - was) / np.maximum(1.0, np.abs(was)), nan=np.inf)


def _values(world: World, obs: torch.Tensor, reward: torch.Tensor, ended: torch.Tensor) -> np.ndarray:
    columns = []
    for block, where in world.slots[0].task_class.layout:
        weights = torch.tensor([((37 * i) % 64 - 31.5) / 32.0 for i in range(block.size)], dtype=torch.float64)
        columns.append(obs[:, where].double() @ weights / block.size**0.5)
    return torch.stack([*columns, reward.double(), ended.double()], dim=1).float().numpy()


def difference(golden: Trajectory, new: Trajectory) -> str | None:
    """The first kept step beyond its tolerance, and in it the quantity that differs most; None where all agree."""
    gap, tolerance = distance(golden, new), PLAIN + FACTOR * golden.spread
    late = np.flatnonzero(gap.max(axis=(1, 2)) > tolerance)
    if len(late) == 0:
        return None
    place = late[0]
    row, quantity = np.unravel_index(gap[place].argmax(), gap.shape[1:])
    was, now = (float(each.values[place, row, quantity]) for each in (golden, new))
    return (
        f"step {KEPT[place]}, {golden.names[quantity]} of row {row}: {was:.9g} then, {now:.9g} now, "
        f"{gap[place].max():.2g} apart with a tolerance of {tolerance[place]:.2g}"
    )


def first_bits(golden: Trajectory, new: Trajectory) -> int | None:
    """The first step whose bits differ; None where all are the same."""
    return next(
        (i + 1 for i, pair in enumerate(zip(golden.digests, new.digests, strict=True)) if len(set(pair)) > 1), None
    )


def write(path: Path = FILE) -> None:
    """Records every class anew, and how far changed starts lead."""
    found = {}
    for variant in VARIANTS:
        new, key = record(*variant), title(*variant)
        gaps = [distance(new, record(*variant, nudge)).max(axis=(1, 2)) for nudge in NUDGES]
        found |= {f"{key}|values": new.values, f"{key}|spread": np.maximum.accumulate(np.max(gaps, axis=0))}
        texts = {"digests": new.digests, "names": new.names, "stamp": [new.physics, new.build]}
        found |= {f"{key}|{name}": np.array(value) for name, value in texts.items()}
    np.savez_compressed(path, **found)


def load(name: str, moving: bool | None, path: Path = FILE) -> Trajectory:
    """What was recorded of a class."""
    with np.load(path, allow_pickle=False) as file:
        got = {
            part: file[f"{title(name, moving)}|{part}"] for part in ("stamp", "names", "values", "digests", "spread")
        }
    texts = {part: list(map(str, got[part])) for part in ("stamp", "names", "digests")}
    return Trajectory(*texts["stamp"], texts["names"], got["values"], texts["digests"], got["spread"])


def main(what: str) -> None:
    """``write`` or ``show``."""
    if what == "write":
        write()
        print(f"{FILE}: {FILE.stat().st_size:,} bytes. Say under Changes results in CHANGELOG.md what changed and why.")
        return
    for variant in VARIANTS:
        golden, new = load(*variant), record(*variant)
        bits = first_bits(golden, new)
        told = "the same bits" if bits is None else f"other bits from step {bits}"
        told += f", at most {distance(golden, new).max():.1e} apart; spread " if bits else "; spread "
        told += "  ".join(f"{golden.spread[KEPT.index(step)]:.0e} at {step}" for step in (1, 5, 20, 50))
        print(f"{title(*variant):24} {told}")


if __name__ == "__main__":
    main(sys.argv[1])
