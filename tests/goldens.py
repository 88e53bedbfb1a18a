"""Golden trajectories: what each class did over fifty steps when the file ``tests/data/goldens.npz`` was written.

``make goldens`` (``python -m tests.goldens write``) writes it anew; that is a change of results and stands in
CHANGELOG.md. ``python -m tests.goldens show`` compares without a test, class by class; ``python -m tests.goldens
spread`` shows how a change of the last digit grows, which is where the tolerances come from (docs/reliability.md).
"""

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.identity import model_identity
from bidex_meta.tasks import registry
from bidex_meta.world import World

FILE = Path(__file__).parent / "data" / "goldens.npz"
STEPS, ROWS = 50, 2
KEPT = (1, 2, 3, 4, 5, 7, 10, 14, 20, 27, 35, 42, 50)
"""Steps whose values are kept; of all others a digest."""
VARIANTS = [(name, None) for name in registry.names()] + [("HandOver", True)]
"""Every class as it is alone, HandOver (the only one whose base is fixed there) with a moving base too."""


@dataclass(frozen=True)
class Trajectory:
    """What one class did.

    Attributes:
        mujoco: MuJoCo's version.
        physics: ``model_identity`` of the scene and the number of substeps.
        names: Of the quantities: the blocks of the observation, ``reward``, ``ended``.
        values: (kept steps, rows, quantities), float32; of a block the sum of its entries, each with a weight of its
            own between -1 and 1, over the root of their number.
        digests: Of each step all bits of observations, rewards, ends and of the engine's positions and velocities.
    """

    mujoco: str
    physics: str
    names: list[str]
    values: np.ndarray
    digests: list[str]


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
    physics = f"{model_identity(part.group.members[0].scene.model)} x {part.substeps}"
    world.close()
    return Trajectory(mujoco.__version__, physics, [*blocks, "reward", "ended"], np.stack(values), digests)


def _values(world: World, obs: torch.Tensor, reward: torch.Tensor, ended: torch.Tensor) -> np.ndarray:
    columns = []
    for block, where in world.slots[0].task_class.layout:
        weights = torch.tensor([((37 * i) % 64 - 31.5) / 32.0 for i in range(block.size)], dtype=torch.float64)
        columns.append(obs[:, where].double() @ weights / block.size**0.5)
    return torch.stack([*columns, reward.double(), ended.double()], dim=1).float().numpy()


def difference(golden: Trajectory, new: Trajectory, absolute: float, relative: float) -> str | None:
    """The first step and, in it, the quantity that differs most for its tolerance; None where all agree."""
    gap = np.abs(new.values.astype(np.float64) - golden.values)
    excess = gap / (absolute + relative * np.abs(golden.values))
    excess = np.where(np.isnan(excess), np.inf, excess)
    late = np.flatnonzero((excess > 1.0).any(axis=(1, 2)))
    if len(late) == 0:
        return None
    place = late[0]
    row, quantity = np.unravel_index(excess[place].argmax(), excess.shape[1:])
    was, now = (float(each.values[place, row, quantity]) for each in (golden, new))
    return (
        f"step {KEPT[place]}, {golden.names[quantity]} of row {row}: {was:.9g} then, {now:.9g} now "
        f"({abs(now - was):.3g} apart)"
    )


def first_bits(golden: Trajectory, new: Trajectory) -> int | None:
    """The first step whose bits differ; None where all are the same."""
    return next(
        (i + 1 for i, pair in enumerate(zip(golden.digests, new.digests, strict=True)) if len(set(pair)) > 1), None
    )


def write(path: Path = FILE) -> None:
    """Records every class anew."""
    found = {}
    for variant in VARIANTS:
        new, key = record(*variant), title(*variant)
        found |= {f"{key}|values": new.values, f"{key}|digests": np.array(new.digests)}
        found |= {f"{key}|names": np.array(new.names), f"{key}|stamp": np.array([new.mujoco, new.physics])}
    np.savez_compressed(path, **found)


def load(name: str, moving: bool | None, path: Path = FILE) -> Trajectory:
    """What was recorded of a class."""
    with np.load(path, allow_pickle=False) as file:
        values, digests, names, stamp = (
            file[f"{title(name, moving)}|{part}"] for part in ("values", "digests", "names", "stamp")
        )
    return Trajectory(str(stamp[0]), str(stamp[1]), list(map(str, names)), values, list(map(str, digests)))


def main(what: str) -> None:
    """``write``, ``show`` or ``spread``."""
    if what == "write":
        write()
        print(
            f"{FILE}: {FILE.stat().st_size:,} bytes. Say in CHANGELOG.md, under Changes results, what changed and why."
        )
        return
    for variant in VARIANTS:
        if what == "show":
            golden, new = load(*variant), record(*variant)
            bits = first_bits(golden, new)
            gap = np.abs(new.values.astype(np.float64) - golden.values).max()
            told = "the same bits" if bits is None else f"other bits from step {bits}, at most {gap:.2g} apart"
            print(f"{title(*variant):24} {told}")
        else:
            base, *others = (record(*variant, nudge) for nudge in (0.0, 2.3e-16, -2.3e-16, 1e-14))
            gaps = [np.abs(base.values.astype(np.float64) - each.values) / (1 + np.abs(base.values)) for each in others]
            told = "  ".join(
                " ".join(f"{gap[KEPT.index(s)].max():7.1e}" for s in (1, 5, 10, 20, 35, 50)) for gap in gaps
            )
            print(f"{title(*variant):24} {told}")


if __name__ == "__main__":
    main(sys.argv[1])
