"""What is no seed, action, pool, state or size is refused in one line that says what was expected; nothing changes."""

from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import World
from tests.world.play import engine_state, flat, suite_world

NAN, INF = float("nan"), float("inf")
ROWS = 4


@pytest.fixture(scope="module")
def shared() -> World:
    return suite_world("MT4", ROWS)


@pytest.fixture
def world(shared: World) -> World:
    shared.reset(seed=0)
    return shared


def refused(call: Any, *arguments: Any, **named: Any) -> str:
    with pytest.raises(BidexError) as caught:
        call(*arguments, **named)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    assert "xpected" in message or message.startswith("Unknown ")
    return message


def unchanged(world: Any, before: dict[str, Any]) -> bool:
    def same(a: Any, b: Any) -> bool:
        if isinstance(a, dict):
            return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
        if isinstance(a, list):
            return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
        return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b

    return same(world.state_dict(), before)


@pytest.mark.parametrize(
    "seed", [-1, 1.9, "1", True, [0], np.array([1, 2]), 10**5000, NAN], ids=lambda s: type(s).__name__
)
def test_seeds(world: World, seed: Any) -> None:
    before = world.state_dict()
    assert "seed" in refused(world.reset, seed=seed)
    assert unchanged(world, before)
    fine: Any = np.int64(3)
    world.reset(seed=fine)
    assert world.seed == 3 and type(world.seed) is int


POOL = np.full((2, 5), 0.1)
BAD_POOLS = {
    "a NaN": (np.where(np.eye(2, 5) > 0, NAN, 0.1), r"goal_x = nan in row 0"),
    "an infinity": (np.where(np.eye(2, 5) > 0, -INF, 0.1), "= -inf in row 0"),
    "a size that single precision cannot square": (np.full((1, 5), 1e300), r"1e\+300"),
    "text": (np.full((1, 5), "a"), "no array of real numbers"),
    "none": (None, "no array of real"),
    "ragged": ([[1.0], [1.0, 2.0]], "no array of real numbers"),
    "complex": (np.full((1, 5), 1j), "no array of real"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", BAD_POOLS)
def test_pools(world: World, kind: str) -> None:
    bad, message = BAD_POOLS[kind]
    before = world.state_dict()
    with pytest.raises(BidexError, match=message):
        world.set_tasks({"HandOver": POOL, "CatchUnderarm": bad})
    assert unchanged(world, before)


def test_pools_by_slot() -> None:
    world = suite_world("MT4", ROWS)
    assert "dict" in refused(world.set_tasks, [POOL])
    assert "got 3" in refused(world.set_tasks, {3: POOL})


def test_the_world_keeps_no_array_of_the_callers() -> None:
    mine, made = suite_world("MT4", ROWS, "DISABLED"), suite_world("MT4", ROWS, "DISABLED")
    space = mine.slots[0].task_class.variation_space
    pool = space.sample(np.random.default_rng(0), 3)
    for each in (mine, made):
        each.set_tasks({mine.task_names[0]: pool.copy() if each is made else pool})
    pool[:] = NAN
    mine.pools[0][:] = NAN
    assert torch.equal(mine.reset(seed=0)[0], made.reset(seed=0)[0])
    slots = mine.slots
    built = World(slots, ROWS, seed=0, autoreset_mode="DISABLED", threads=1)
    expected = built.reset(seed=1)[0]
    slots[0].tasks[:] = NAN
    assert torch.equal(built.reset(seed=1)[0], expected)
    assert "numbers within" in refused(World, slots, ROWS, threads=1)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "action",
    [None, "left", torch.zeros(ROWS), torch.zeros(ROWS, 51), torch.zeros(ROWS + 1, 52), torch.zeros(ROWS, 52, 1),
     torch.zeros(ROWS, 52, dtype=torch.complex64), torch.zeros(ROWS, 52).to_sparse(), np.full((ROWS, 52), "0.1"),
     np.full((ROWS, 52), None), [[0.0] * 52] * 3 + [[0.0]], torch.zeros(ROWS, 52, device="meta"),
     {"action": torch.zeros(ROWS, 52)}],
    ids=lambda value: f"{type(value).__name__} {tuple(getattr(value, 'shape', ()))}"
)  # fmt: skip
def test_actions(world: World, action: Any) -> None:
    before = world.state_dict()
    assert "actions of shape (4, 52), got " in refused(world.step, action)
    assert unchanged(world, before)


def test_actions_of_other_types_are_taken_without_a_gradient() -> None:
    plain = 0.25 * torch.ones(ROWS, 52)
    leaf = plain.clone().requires_grad_()
    given: Any = (plain, plain.double(), plain.numpy(), plain.tolist(), plain.half(), leaf, 2 * leaf - plain)
    made = []
    for action in given:
        world = suite_world("MT4", ROWS)
        world.reset(seed=0)
        made.append(flat(world.step(action)))
        assert not any(value.requires_grad for value in made[-1].values())
    for step in made[1:]:
        assert all(torch.equal(step[name], value) for name, value in made[0].items())
    assert leaf.grad is None


def _with(state: dict[str, Any], path: str, change: Any) -> dict[str, Any]:
    *outer, last = [int(key) if key.isdigit() else key for key in path.split("/")]
    inner: Any = state
    for key in outer:
        inner = inner[key]
    if change is None:
        del inner[last]
    else:
        inner[last] = change(inner[last])
    return state


def _spoilt(value: torch.Tensor) -> torch.Tensor:
    value = value.clone()
    value.view(-1)[0] = NAN
    return value


BAD_STATES: dict[str, tuple[str, Any]] = {
    "no seed": ("seed", None),
    "a negative seed": ("seed", lambda _: -1),
    "other slots": ("slots", lambda slots: [*slots[1:], "x"]),
    "no engines": ("engines", None),
    "fewer engines": ("engines", lambda engines: engines[1:]),
    "an engine's field missing": ("engines/0/qpos", None),
    "an engine's field of another shape": ("engines/0/qpos", lambda value: value[:, 1:]),
    "an engine's field of numbers": ("engines/0/qvel", lambda value: value.tolist()),
    "NaN in an engine": ("engines/1/qvel", _spoilt),
    "NaN time": ("engines/1/time", _spoilt),
    "NaN tasks": ("tasks/0", _spoilt),
    "tasks of another width": ("tasks/0", lambda value: value[:, 1:]),
    "fewer pools": ("tasks", lambda tasks: tasks[1:]),
    "no episodes": ("episodes", lambda _: None),
    "an episode's counter missing": ("episodes/elapsed", None),
    "an episode's counter of another type": ("episodes/elapsed", lambda value: value.double()),
    "NaN observation": ("observation", _spoilt),
    "a longer observation": ("observation", lambda value: torch.cat((value, value), dim=1)),
    "NaN action": ("action", _spoilt),
    "a task beyond the pool": ("task_index", lambda value: value + 50),
    "a negative task": ("task_index", lambda value: value - 50),
    "an episode of negative length": ("episodes/length", lambda value: value - 50),
    "an action without numbers": ("action", lambda value: value.to("meta")),
    "a sparse observation": ("observation", lambda value: value.to_sparse()),
    "an engine's field without numbers": ("engines/0/qpos", lambda value: value.to("meta")),
    "a sparse field of an engine": ("engines/0/qpos", lambda value: value.to_sparse()),
    "an engine's field of complex numbers": ("engines/0/qpos", lambda value: value.to(torch.complex128)),
    "an engine's field of whole numbers": ("engines/0/qvel", lambda value: value.long()),
}


@pytest.mark.parametrize("kind", BAD_STATES)
def test_states(world: World, kind: str) -> None:
    world.step(torch.zeros(ROWS, 52))
    before, engines = world.state_dict(), engine_state(world)
    path, change = BAD_STATES[kind]
    refused(world.load_state_dict, _with(world.state_dict(), path, change))
    assert unchanged(world, before), "all of it or nothing"
    assert all(torch.equal(a[n], b[n]) for a, b in zip(engines, engine_state(world), strict=True) for n in a)
    world.load_state_dict(before)
    world.step(torch.zeros(ROWS, 52))


def test_foreign_states(world: World) -> None:
    other = suite_world("MT4", ROWS + 1)
    other.reset(seed=0)
    for state in (other.state_dict(), {}, None, [], "state", {"seed": 0}):
        refused(world.load_state_dict, state)


BAD_MASKS = {
    "none": lambda: torch.ones(ROWS),
    "whole numbers": lambda: np.ones(ROWS, int),
    "NaN": lambda: torch.full((ROWS,), NAN),
    "a row short": lambda: [True] * (ROWS - 1),
    "a column": lambda: torch.ones(ROWS, 1, dtype=torch.bool),
    "text": lambda: "all",
    "texts": lambda: np.full(ROWS, "True"),
    "objects": lambda: np.array([True, None, True, True], object),
    "ragged": lambda: [[True], [True, False]],
    "a dict": lambda: {"rows": [0]},
    "a slice": lambda: slice(2),
    "a number beyond any": lambda: 10**30,
    "without numbers": lambda: torch.ones(ROWS, dtype=torch.bool, device="meta"),
    "sparse": lambda: torch.ones(ROWS, dtype=torch.bool).to_sparse(),
}


@pytest.mark.parametrize("kind", BAD_MASKS)
def test_masks(world: World, kind: str) -> None:
    before = world.state_dict()
    assert "reset_mask of shape (4,)" in refused(world.reset, options={"reset_mask": BAD_MASKS[kind]()})
    assert unchanged(world, before)


def test_masks_of_other_types_start_the_same_rows() -> None:
    mask = [True, False, False, True]
    backwards = np.array(mask[::-1])[::-1]
    made = []
    for given in (torch.tensor(mask), np.array(mask), mask, tuple(mask), backwards):
        world = suite_world("MT4", ROWS, "DISABLED")
        world.reset(seed=0)
        world.step(0.5 * torch.ones(ROWS, 52))
        made.append(world.reset(options={"reset_mask": given})[0])
        assert world.episodes.elapsed.tolist() == [0, 1, 1, 0]
    assert all(torch.equal(obs, made[0]) for obs in made)


def test_states_of_worlds_of_others() -> None:
    from bidex_meta.worlds.humanoid import HumanoidWorld

    world = HumanoidWorld(2, threads=1)
    world.reset(seed=0)
    good = world.state_dict()
    for path, change in {
        "seed": None,
        "x": lambda x: x[:1],
        "contact": lambda _: 3,
        "tasks": lambda _: -1,
        "engine/qpos": None,
        "episodes/elapsed": lambda value: value.double(),
        "observation": _spoilt,
    }.items():
        refused(world.load_state_dict, _with(world.state_dict(), path, change))
        assert unchanged(world, good)
    refused(world.load_state_dict, None)
    world.load_state_dict(good)


@pytest.mark.parametrize("threads", [0, -1, [], 1.5, "2", True, 10**9])
def test_threads(world: World, threads: Any) -> None:
    assert refused(World, world.slots, ROWS, threads=threads).startswith("threads: ")


@pytest.mark.parametrize(
    "options",
    [{"num_envs": 3}, {"num_envs": 4.0}, {"num_envs": 10**12}, {"observation": "one hot"}, {"pad_to": 1.5},
     {"pad_to": 400}, {"pad_to": 10**9}, {"task_sampling": []}, {"task_sampling": np.zeros(3)}, {"stagger": 2},
     {"stagger": np.zeros(3)}, {"points": 64}, {"points": (64, True)}, {"engine": []}, {"device": 3.5},
     {"device": f"cuda:{torch.cuda.device_count()}"}, {"seed": -2}],
    ids=str
)  # fmt: skip
def test_worlds(world: World, options: dict[str, Any]) -> None:
    refused(World, world.slots, **({"num_envs": ROWS, "threads": 1} | options))


@pytest.mark.parametrize(
    "options",
    [{"width": -1}, {"width": 0}, {"height": 1.5}, {"row": -1}, {"row": 4}, {"row": None}, {"camera": ["top"]},
     {"camera": 0}],
    ids=str
)  # fmt: skip
def test_pictures(world: World, options: dict[str, Any]) -> None:
    assert next(iter(options)) in refused(world.render, **options)


def test_whole_numbers() -> None:
    assert whole_number("n", np.int32(5), 1, 5) == 5 and whole_number("n", torch.tensor(3), 0) == 3
    assert refused(whole_number, "n", 6, 1, 5) == "n: expected a whole number from 1 to 5, got 6."
    assert refused(whole_number, "n", 10**5000, 0, 9).endswith("got a int that cannot be printed.")
