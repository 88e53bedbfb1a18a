"""What the tests of the world share: small worlds, actions chosen by row, steps as flat dicts of tensors."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from bidex_meta import Benchmark
from bidex_meta.benchmark import make_task_world
from bidex_meta.world import World, WorldConfig

THROWN = ["HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm", "CatchAbreast"]
"""The classes that end early, when something is dropped."""
CLASSES = [*THROWN, "DoorCloseInward", "BottleCap"]
"""What a world does is seen in these: one and two free objects, a movable fixture, an object with joints."""

ENDS = ("episode", "_episode", "final_info", "_final_info")


def suite_world(
    name: str, rows: int, mode: str = "SAME_STEP", split: str = "train", seed: int = 0, threads: int = 1,
    tasks_per_class: int | None = None,
):  # fmt: skip
    return Benchmark(name, tasks_per_class=tasks_per_class).make_world(
        split, num_envs=rows, device="cpu", seed=seed, autoreset_mode=mode, threads=threads
    )


def class_world(name: str, rows: int, mode: str = "SAME_STEP", moving_base: bool | None = None) -> World:
    return make_task_world(name, num_envs=rows, device="cpu", autoreset_mode=mode, threads=1, moving_base=moving_base)


def random_actions(world: World, steps: int, rows: int | None = None, seed: int = 0) -> Tensor:
    """Uniform actions (steps, num_envs, a). Row i's do not depend on num_envs if ``rows`` is the same."""
    generator = torch.Generator().manual_seed(seed)
    shape = steps, rows or world.num_envs, world.action_size
    return (2.0 * torch.rand(shape, generator=generator) - 1.0)[:, : world.num_envs]


def flat(result: tuple[Any, ...]) -> dict[str, Tensor]:
    """The tensors of a step by name, those of info and of its dicts included.

    Left out is what Gymnasium adds where rows ended: it repeats the others, but for the time on the clock.
    """
    names = ("obs", "reward", "terminated", "truncated")
    info = {name: value for name, value in result[-1].items() if name not in ENDS}
    return dict(zip(names, result, strict=False)) | _flat(info, "info")


def _flat(info: dict[str, Any], prefix: str) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for name, value in info.items():
        found.update(_flat(value, f"{prefix}/{name}") if isinstance(value, dict) else {f"{prefix}/{name}": value})
    return found


def play(world: World, actions: Iterable[Tensor]) -> list[dict[str, Tensor]]:
    return [flat(world.step(action)) for action in actions]


def assert_same(a: list[dict[str, Tensor]], b: list[dict[str, Tensor]], rows_a: Any = slice(None), rows_b: Any = None):
    """Bit-equal rows in every tensor of every step."""
    rows_b = rows_a if rows_b is None else rows_b
    assert len(a) == len(b)
    for step, (x, y) in enumerate(zip(a, b, strict=True)):
        assert x.keys() == y.keys()
        for name in x:
            assert torch.equal(x[name][rows_a], y[name][rows_b]), f"step {step}: {name}"


def number_of_ends(steps: list[dict[str, Tensor]]) -> int:
    return sum(int(step["info/_final_obs"].sum()) for step in steps)


def engine_state(world: World) -> list[dict[str, Tensor]]:
    return [part.group.engine.state_dict() for part in world.parts]


def engine_place(world: World, row: int) -> tuple[Any, int]:
    """A row's engine and its place there."""
    part = next(p for p in world.parts if int(p.engine_rows[row]) >= 0)
    return part.group.engine, int(part.engine_rows[row])


def world_at(world: World, mode: str = "DISABLED") -> World:
    """A new world of the same slots whose rows start the very episodes that ``world``'s rows are in, not staggered."""
    config = WorldConfig(
        num_envs=world.num_envs,
        seed=world.seed,
        autoreset_mode=mode,
        observation="one-hot" if world.num_id_columns else "plain",
        pad_to=world.observation_size - world.num_id_columns,
        task_sampling=world._config.task_sampling,
        threads=1,
    )
    new = World(world.slots, config)
    new.episodes.number = world.episodes.number - 1
    return new
