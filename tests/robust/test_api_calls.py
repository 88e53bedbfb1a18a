"""Odd arguments of the public functions, drawn by hypothesis: a result, or one line that says what is wrong."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta import Benchmark
from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import ZeroAgent, evaluate
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks.task import Task
from tests.fakes import ToyWorld
from tests.robust import damage

ROWS = 2
NAN = float("nan")
ODD = (
    None, True, -1, 0, 1, 2.5, NAN, 1e308, 10**30, "", "x" * 300, "\0", "cpu", "cuda:7", "MT4", "a\nb", b"x", [],
    [1, "a"], {}, {"a": 1}, (), object(), np.zeros(3), np.full((ROWS, 2), NAN), torch.zeros(0),
    torch.full((ROWS, 3), NAN), torch.ones(ROWS, 40), torch.full((ROWS, 40), NAN),
    torch.zeros(ROWS, 40, requires_grad=True), torch.zeros(ROWS, 40, dtype=torch.int8), range(3), np.float32(1),
    np.int64(2), np.array("x"), [NAN], [[0.0] * 40] * ROWS,
)  # fmt: skip


@pytest.fixture(scope="module")
def world():
    made = make_task_world("HandOver", ROWS, "cpu", autoreset_mode="DISABLED", threads=1)
    made.reset(seed=0)
    yield made
    made.close()


def draws(count: int, check: Callable[..., None], *strategies: st.SearchStrategy[Any]) -> None:
    damage.draws(count, st.tuples(*strategies), lambda drawn: damage.one_line_or(partial(check, *drawn)))


odd = st.sampled_from(ODD)


def test_benchmarks_and_suites() -> None:
    draws(100, lambda name, seed: Benchmark(name, seed=seed), odd, odd)
    draws(60, lambda seed: Benchmark("MT1", seed=seed), odd)
    draws(40, load_suite, odd)


def test_making_worlds() -> None:
    names = ("num_envs", "device", "seed", "autoreset_mode", "threads", "engine", "split")
    benchmark = Benchmark("MT1")

    def make(name: str, value: Any) -> None:
        given = {"num_envs": 5, "device": "cpu", "threads": 1, name: value}
        if (type(value) in (int, np.int64) and name == "num_envs" and 0 < value < 100) or value in (None, True):
            return
        benchmark.make_world(**given).close()

    def safe(name: str, value: Any) -> None:
        if isinstance(value, np.ndarray | torch.Tensor) or value is None:
            value = str(value)
        make(name, value)

    draws(80, safe, st.sampled_from(names), odd)
    draws(40, lambda name: make_task_world(name, 1, "cpu", threads=1).close(), odd)


NOT_TRUE_OR_FALSE = [value for value in ODD if value is not None and not isinstance(value, bool)]


@pytest.mark.parametrize("name, values", [
    ("moving_base", NOT_TRUE_OR_FALSE),
    ("stagger", NOT_TRUE_OR_FALSE),
    ("touch", NOT_TRUE_OR_FALSE),
    ("points", [value for value in ODD if type(value) not in (int, np.int64)] + [-1, 10**6]),
    ("task_sampling", [value for value in ODD if value is not None]),
    ("object", [value for value in ODD if value is not None]),
])  # fmt: skip
def test_no_odd_argument_of_a_task_world_is_taken(name: str, values: list[Any]) -> None:
    given = {"num_envs": 1, "device": "cpu", "threads": 1}
    for make in (partial(make_task_world, "HandOver"), partial(gymnasium.make_vec, "bidex-meta/HandOver-v1")):
        for value in values:
            with pytest.raises(BidexError) as raised:
                make(**given, **{name: value})
            assert "\n" not in str(raised.value)


def test_render_modes() -> None:
    for value in NOT_TRUE_OR_FALSE:
        with pytest.raises(BidexError, match="render_mode"):
            gymnasium.make_vec("bidex-meta/MT1-v1", num_envs=5, render_mode=value)


def test_steps_resets_and_pools(world: Any) -> None:
    draws(150, lambda actions: world.step(actions), odd)
    draws(80, lambda seed: world.reset(seed=seed), odd)
    draws(50, lambda options: world.reset(seed=0, options=options), odd)
    draws(120, lambda tasks: world.set_tasks(tasks), odd)
    draws(60, lambda tasks: world.set_tasks([tasks]), odd)
    world.reset(seed=0)
    obs, reward, *_ = world.step(torch.zeros(ROWS, 40))
    assert torch.isfinite(obs).all() and torch.isfinite(reward).all()


@pytest.mark.parametrize("call", ["make", "reset", "step", "evaluate", "learn"])
def test_another_default_precision_is_refused(call: str, world: Any) -> None:
    toy = ToyWorld(6, "SAME_STEP")
    world.reset(seed=0)
    calls: dict[str, Callable[[], object]] = {
        "make": lambda: make_task_world("HandOver", ROWS, device="cpu", threads=1),
        "reset": lambda: world.reset(seed=0),
        "step": lambda: world.step(torch.zeros(ROWS, 40)),
        "evaluate": lambda: evaluate(ZeroAgent(world.action_space), world, 1),
        "learn": lambda: MTPPO(toy, MTPPOConfig(hidden=(8,), rollout_steps=4), 0),
    }
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(BidexError, match=r"torch\.float32, got torch\.float64"):
            calls[call]()
    finally:
        torch.set_default_dtype(torch.float32)


def test_saved_states(world: Any) -> None:
    world.reset(seed=0)
    good = world.state_dict()

    def load(which: float, value: Any, gone: bool) -> None:
        state = copy.deepcopy(good)
        places = list(damage.places_in(state))
        inside, key = places[int(which * len(places))]
        if gone and isinstance(inside, dict):
            del inside[key]
        else:
            inside[key] = value
        world.load_state_dict(state)

    draws(150, load, st.floats(0, 1, exclude_max=True), odd, st.booleans())
    draws(30, world.load_state_dict, odd)
    world.load_state_dict(good)
    assert torch.isfinite(world.step(torch.zeros(ROWS, 40))[0]).all()


def test_evaluations_and_tasks(world: Any) -> None:
    agent = ZeroAgent(world.action_space)
    draws(40, lambda n: evaluate(agent, world, n), odd.filter(_no_real_count))
    draws(40, lambda seed: evaluate(agent, object(), 1, seed=seed), odd)
    draws(40, lambda data: Task("HandOver", data).variation, odd)


def _no_real_count(value: Any) -> bool:
    return not isinstance(value, int | np.integer)
