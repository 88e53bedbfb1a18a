import io
from pathlib import Path
from typing import Any

import pytest
import torch

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.cli import main
from bidex_meta.engine.choice import choose_engine
from bidex_meta.experiments.policies import load_checkpoint
from bidex_meta.runs import RunFolder
from bidex_meta.world import World
from bidex_meta.world import world as world_module
from bidex_meta.worlds import open_worlds
from tests.world.play import (
    assert_same,
    class_world,
    engine_state,
    number_of_ends,
    play,
    random_actions,
    suite_world,
    world_at,
)


def test_one_and_two_threads_give_the_same_bits_over_150_steps() -> None:
    played, states = [], []
    for threads in (1, 2):
        world = suite_world("MT4", 12, threads=threads)
        world.reset(seed=0)
        played.append(play(world, random_actions(world, 150)))
        states.append(engine_state(world))
    assert number_of_ends(played[0]) > 12
    assert_same(*played)
    for a, b in zip(*states, strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)


def test_torchs_threads_change_nothing() -> None:
    played = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        world = suite_world("MT4", 64)
        world.reset(seed=0)
        played.append(play(world, random_actions(world, 12)))
        assert torch.get_num_threads() == threads
    assert_same(*played)


SIZES = [
    *((name, 40, 8) for name in ("HandOver", "TwoCatchUnderarm", "DoorCloseInward", "BottleCap-v2")),
    *(("TwoCatchUnderarm", 20, rows) for rows in (1, 3)),
]


@pytest.mark.parametrize(("name", "steps", "small"), [*SIZES, ("CatchOver2Underarm", 120, 8)])
def test_a_rows_trajectory_does_not_depend_on_the_number_of_rows(name: str, steps: int, small: int) -> None:
    played = []
    for rows in (small, 24):
        world = class_world(name, rows)
        world.reset(seed=0)
        played.append(play(world, random_actions(world, steps, rows=24)))
    assert number_of_ends(played[1]) > 2
    assert_same(*played, rows_a=slice(None), rows_b=slice(small))


@pytest.mark.parametrize("name", ["TwoCatchUnderarm", "BottleCap", "DoorCloseInward", "DoorCloseInward-v2"])
def test_resets_equal_fresh_worlds(name: str) -> None:
    used = class_world(name, 32, "DISABLED", moving_base=True)
    used.reset(seed=0)
    odd, actions = torch.arange(32) % 2 == 1, random_actions(used, 30)
    play(used, actions[:10])
    used.reset(options={"reset_mask": odd})
    play(used, actions[:5])  # the odd rows are reset in the midst of an episode, after few steps and after many
    used.reset(options={"reset_mask": ~odd})
    used.reset(options={"reset_mask": odd})
    assert torch.equal(used.episodes.number, torch.where(odd, 2, 1))
    fresh = world_at(used)
    obs, _ = fresh.reset()
    assert torch.equal(obs, used._obs)
    same_engines(used, fresh)
    assert_same(play(used, actions[10:]), play(fresh, actions[10:]))
    same_engines(used, fresh)


def same_engines(a: World, b: World) -> None:
    for mine, its in zip(a.parts, b.parts, strict=True):
        assert torch.equal(mine.group.engine.sensordata, its.group.engine.sensordata)
    for x, y in zip(engine_state(a), engine_state(b), strict=True):
        assert all(torch.equal(x[key], y[key]) for key in x)


def test_a_loaded_world_of_other_tasks_continues_bit_for_bit_over_several_episodes() -> None:
    world, other = (suite_world("MT4-v2", 12, seed=seed) for seed in (0, 9))
    other.slots = world.slots  # the seed of a benchmark chooses the tasks, too
    other.set_tasks({slot.name: slot.tasks for slot in world.slots})
    actions, before = random_actions(world, 157), 57
    world.reset(seed=4)
    play(world, actions[:before])
    kept, file = world.state_dict(), io.BytesIO()
    torch.save(kept, file)
    file.seek(0)
    unbroken = play(world, actions[before:])
    other.load_state_dict(torch.load(file, weights_only=True))
    assert_same(unbroken, play(other, actions[before:]))
    assert number_of_ends(unbroken) >= 10
    world.load_state_dict(kept)  # also into a world that went on
    assert_same(unbroken, play(world, actions[before:]))


@pytest.mark.parametrize(("deterministic", "switches"), [(False, ""), (True, "incremental")])
@pytest.mark.parametrize("kind", ["suite", "others", "class", "worlds of a suite", "worlds of a class"])
def test_every_way_to_make_a_world_asks_the_engine_to_repeat_and_for_switches(
    kind: str, deterministic: bool, switches: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[bool, str]] = []

    def choose(device: str, engine: str, threads: int | None, repeat: bool, switches: str) -> Any:
        asked.append((repeat, switches))
        return choose_engine("cpu", engine, threads)

    monkeypatch.setattr(world_module, "choose_engine", choose)
    config = {"threads": 1, "deterministic": deterministic, "switches": switches}
    if kind in ("suite", "others"):
        Benchmark("MT1").make_world({"suite": "train"}.get(kind, kind), 4, "cpu", **config).close()
    elif kind == "class":
        make_task_world("HandOver", 4, "cpu", **config).close()
    else:
        named = {"suite": "MT1"} if kind.endswith("suite") else {"task": "HandOver"}
        open_worlds({**named, **config}).world("train", 4).close()
    assert asked == [(deterministic, switches)]


@pytest.mark.gpu
@pytest.mark.slow
def test_a_deterministic_run_on_a_gpu_repeats(tmp_path: Path) -> None:
    """Two runs of 2,000 steps of each environment, with learning, have equal weights."""
    digests = []
    for number in range(2):
        out = str(tmp_path / str(number))
        argv = ["run", "--suite", "MT20", "--algo", "mtppo", "--device", "cuda:0", "--num-envs", "100"]
        argv += ["--steps", "200000", "--deterministic", "--logger", "none", "--no-evaluate", "--run-dir", out]
        assert main(argv) == 0
        state, _ = load_checkpoint(RunFolder.open(out))
        digests.append(content_of(state["learner"]))
    assert digests[0] == digests[1]


def content_of(state: object) -> bytes:
    """All bits of a learner's state."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()
