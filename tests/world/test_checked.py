"""What is no seed, action, pool, state or size is refused in one line that says what was expected; nothing changes."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.rules import Randomisation
from bidex_meta.suite_files import load_suite
from bidex_meta.utils import paths
from bidex_meta.world import World, WorldConfig
from bidex_meta.worlds.humanoid import HumanoidWorld
from tests.world.play import engine_state, flat, suite_world

NAN = float("nan")
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


POOL = np.full((2, 5), 0.1)
BAD_POOLS = {
    "a NaN": (np.where(np.eye(2, 5) > 0, NAN, 0.1), r"goal_x = nan in row 0"),
    "a size that single precision cannot square": (np.full((1, 5), 1e300), r"1e\+300"),
    "text": (np.full((1, 5), "a"), "no array of real numbers"),
    "ragged": ([[1.0], [1.0, 2.0]], "no array of real numbers"),
    "complex": (np.full((1, 5), 1j), "no array of real"),
}


@pytest.mark.filterwarnings("error")
def test_pools(world: World) -> None:
    before = world.state_dict()
    for bad, message in BAD_POOLS.values():
        with pytest.raises(BidexError, match=message):
            world.set_tasks({"HandOver": POOL, "CatchUnderarm": bad})
        assert unchanged(world, before)
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
    built = World(slots, WorldConfig(ROWS, seed=0, autoreset_mode="DISABLED", threads=1))
    expected = built.reset(seed=1)[0]
    slots[0].tasks[:] = NAN
    assert torch.equal(built.reset(seed=1)[0], expected)
    assert "numbers within" in refused(World, slots, WorldConfig(ROWS, threads=1))


ACTIONS: tuple[Any, ...] = (
    "left", torch.zeros(ROWS), torch.zeros(ROWS, 51), torch.zeros(ROWS, 52, 1), [[0.0] * 52] * 3 + [[0.0]],
    torch.zeros(ROWS, 52, dtype=torch.complex64), torch.zeros(ROWS, 52).to_sparse(), np.full((ROWS, 52), "0.1"),
    np.full((ROWS, 52), None), torch.zeros(ROWS, 52, device="meta"), {"action": torch.zeros(ROWS, 52)},
)  # fmt: skip
MASKS: tuple[Any, ...] = (
    torch.ones(ROWS), np.ones(ROWS, int), [True] * (ROWS - 1), torch.ones(ROWS, 1, dtype=torch.bool), "all",
    np.array([True, None, True, True], object), [[True], [True, False]], {"rows": [0]}, 10**30,
    torch.ones(ROWS, dtype=torch.bool, device="meta"), torch.ones(ROWS, dtype=torch.bool).to_sparse(),
)  # fmt: skip


@pytest.mark.filterwarnings("error")
def test_actions_and_masks(world: World) -> None:
    before = world.state_dict()
    for action in ACTIONS:
        assert "actions of shape (4, 52), got " in refused(world.step, action)
        assert unchanged(world, before)
    for mask in MASKS:
        assert "reset_mask of shape (4,)" in refused(world.reset, options={"reset_mask": mask})
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


BAD_STATES: tuple[tuple[str, Any], ...] = (
    ("seed", None), ("seed", lambda _: -1), ("slots", lambda slots: [*slots[1:], "x"]),
    ("engines", None), ("engines", lambda engines: engines[1:]), ("engines/0/qpos", None),
    ("engines/0/qpos", lambda value: value[:, 1:]), ("engines/0/qvel", lambda value: value.tolist()),
    ("engines/1/qvel", _spoilt), ("engines/1/time", _spoilt), ("engines/0/qpos", lambda value: value.to("meta")),
    ("engines/0/qpos", lambda value: value.to_sparse()), ("engines/0/qvel", lambda value: value.long()),
    ("engines/0/qpos", lambda value: value.to(torch.complex128)),
    ("tasks/0", _spoilt), ("tasks/0", lambda value: value[:, 1:]), ("tasks", lambda tasks: tasks[1:]),
    ("episodes", lambda _: None), ("episodes/elapsed", None), ("episodes/elapsed", lambda value: value.double()),
    ("observation", _spoilt), ("observation", lambda value: torch.cat((value, value), dim=1)),
    ("observation", lambda value: value.to_sparse()), ("action", _spoilt), ("action", lambda value: value.to("meta")),
    ("task_index", lambda value: value + 50), ("task_index", lambda value: value - 50),
    ("episodes/length", lambda value: value - 50),
)  # fmt: skip
"""What is changed in a state, and how; None: it is missing."""


def test_states(world: World) -> None:
    world.step(torch.zeros(ROWS, 52))
    before, engines = world.state_dict(), engine_state(world)
    other = suite_world("MT4", ROWS + 1)
    other.reset(seed=0)
    foreign = [other.state_dict(), {}, None, [], "state", {"seed": 0}]
    for bad in [_with(world.state_dict(), *each) for each in BAD_STATES] + foreign:
        refused(world.load_state_dict, bad)
        assert unchanged(world, before), "all of it or nothing"
        assert all(torch.equal(a[n], b[n]) for a, b in zip(engines, engine_state(world), strict=True) for n in a)
    world.load_state_dict(before)
    world.step(torch.zeros(ROWS, 52))


ROUGH = Randomisation(friction=(0.5, 2.0))
PLAIN: dict[str, Any] = {"device": "cpu", "threads": 1, "randomisation": False}
OTHERS: dict[str, tuple[dict[str, Any], str]] = {
    "version": ({"suite": "MT4-v2"}, "19 differences: time limit of CatchUnderarm 225, here 75; reward of"),
    "randomisation": ({"randomisation": ROUGH}, "randomised friction (0.5, 2.0), here none"),
    "reward": ({"rules": {"reward": "v2"}}, "reward of CatchUnderarm v2, here paper"),
    "starts": ({"rules": {"starts": "jittered"}}, "starts of CatchUnderarm jittered, here plain"),
    "goals": ({"observation": "masked"}, "observation masked, here one-hot"),
}  # fmt: skip
"""How a world is made otherwise, with tensors of the same shapes, and what is said of it."""


def _made(suite: str = "MT4", rules: dict[str, Any] | None = None, observation: str | None = None, **named: Any) -> Any:
    given = load_suite(suite)
    given = replace(given, rules=replace(given.rules, **(rules or {})), observation=observation or given.observation)
    return Benchmark(given).make_world(num_envs=ROWS, **(PLAIN | named))


@pytest.mark.parametrize("other", OTHERS)
def test_states_of_worlds_that_were_made_otherwise(world: World, other: str) -> None:
    named, told = OTHERS[other]
    found = _made(**named)
    found.reset(seed=0)
    state = found.state_dict()
    state["observation"] = world.state_dict()["observation"]  # a plain and a masked one may be equally wide
    before = world.state_dict()
    assert told in refused(world.load_state_dict, state) and unchanged(world, before)
    found.load_state_dict(found.state_dict())


def test_states_of_classes_with_other_options(tmp_path: Path) -> None:
    text = (paths.suites_dir() / "MT1-v2.toml").read_text()
    made = []
    for options in ("water = 12", "water = 13", ""):
        changed = text.replace("CatchUnderarm", "PourWater")
        (tmp_path / "pour.toml").write_text(f"{changed}\noptions = {{ {options} }}\n")
        made.append(Benchmark(tmp_path / "pour.toml").make_world(num_envs=1, **PLAIN))
        made[-1].reset(seed=0)
    assert "water of PourWater 13, here 12" in refused(made[0].load_state_dict, made[1].state_dict())
    made[0].load_state_dict(made[2].state_dict())
    state = io.BytesIO()
    torch.save(made[0].state_dict(), state)
    state.seek(0)
    made[0].load_state_dict(torch.load(state, weights_only=True))
    for bad in ({}, None, 3, {"slots": torch.zeros(2)}):
        refused(made[0].load_state_dict, made[0].state_dict() | {"made": bad})


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


@pytest.mark.parametrize(
    "options",
    [{"num_envs": 3}, {"num_envs": 10**12}, {"observation": "one hot"}, {"pad_to": 1.5}, {"pad_to": 400},
     {"pad_to": 10**9}, {"task_sampling": np.zeros(3)}, {"stagger": np.zeros(3)}, {"points": (64, True)},
     {"engine": []}, {"device": f"cuda:{torch.cuda.device_count()}"}, {"threads": True}, {"threads": 10**9}],
    ids=str
)  # fmt: skip
def test_worlds(world: World, options: dict[str, Any]) -> None:
    given = {"num_envs": ROWS, "threads": 1} | options
    refused(lambda: World(world.slots, WorldConfig(**given)))


def test_pictures(world: World) -> None:
    for name, value in (
        ("width", 0),
        ("height", 1.5),
        ("env_id", -1),
        ("env_id", 4),
        ("env_id", 10**5000),
        ("camera", ["top"]),
    ):
        assert name in refused(world.render, **{name: value})
