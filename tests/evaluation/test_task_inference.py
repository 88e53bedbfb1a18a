"""Whether there is something to learn about tasks: what needs no training, and that a broken class is found out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta import Benchmark
from bidex_meta.cli import main
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import task_inference
from bidex_meta.evaluation.results import ClassResult
from bidex_meta.evaluation.task_inference import Alignment, alignment, blind_ceiling, identifiability, listed_ceiling
from bidex_meta.experiments import suite_validity
from bidex_meta.experiments.run_config import resolve
from bidex_meta.runs import RunFolder
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks import registry
from bidex_meta.tasks.aligned import Error
from bidex_meta.world import World
from bidex_meta.worlds import WorldsConfig, open_worlds
from tests.tasks.worlds import scene_of, world_of


def test_blind_policies_cannot_do_much_in_version_2() -> None:
    benchmark = Benchmark("ML20-v2")
    classes = benchmark.task_classes("train") | benchmark.task_classes("test")
    found = {name: blind_ceiling(task, 2000) for name, task in classes.items()}
    assert len(found) == 20 and max(found.values()) <= 0.25 and np.mean(list(found.values())) <= 0.15, found
    # The expected value is the tolerance divided by the range.
    assert (found["BottleCap"], found["SwingCup"]) == pytest.approx((0.2, 16 / 135), abs=0.03)
    known = {"CatchUnderarm": 0.52, "StackBlock": 0.79, "DoorOpenOutward": 1.0}
    version_1 = {name: blind_ceiling(registry.get(name, True)) for name in known}
    assert version_1 == pytest.approx(known, abs=0.015)


def test_a_blind_ceiling_is_not_biased_by_its_choice() -> None:
    """A cap within 5 mm of 1 to 6 cm is exactly a fifth; the best of a thousand states looked better."""
    task = registry.get("BottleCap-v2", True)
    found = np.array([blind_ceiling(task, 1000, seed) for seed in range(10)])
    error = found.std() / np.sqrt(len(found))
    assert error < 0.002 and abs(found.mean() - 0.2) < 3.0 * error


@pytest.mark.parametrize(
    ("suite", "share"),
    [("ML1-Switch-choice2", 0.5), ("ML1-DoorOpenOutward-choice4", 0.25), ("ML1-DoorOpenOutward-shared", 0.28)],
)
def test_the_ceiling_of_listed_tasks_knows_which_goals_they_have(suite: str, share: float) -> None:
    """Of 50 angles over 1.1 rad, 14 lie within 0.15 rad of one angle: they are 0.022 rad apart."""
    benchmark = Benchmark(suite)
    (task,) = benchmark.task_classes("test").values()
    tasks = np.stack([each.variation for each in benchmark.test_tasks])
    assert listed_ceiling(task, tasks) == pytest.approx(share)
    hidden = [name for part in task.hides() for name in part.names]
    columns = [task.variation_space.names.index(name) for name in hidden]
    assert listed_ceiling(task, tasks[:1]) == 1.0
    apart = tasks.copy()
    apart[:, columns] = np.linspace(0.0, 100.0, len(tasks))[:, None]
    assert listed_ceiling(task, apart) == pytest.approx(1.0 / len(tasks)), "a state midway solves neither"


@pytest.mark.parametrize("name", ["CatchUnderarm", "BottleCap"])
def test_rewards_of_one_episode_tell_what_is_hidden_and_a_broken_class_is_found_out(name: str) -> None:
    world = world_of(f"{name}-v2", True, 4, tasks=4)
    found = identifiability(world)
    assert found.share == 1.0 and (found.errors < 0.1).all()
    task = scene_of(world).task
    task.errors = lambda state: [Error(state["left/palm_position"].norm(dim=1), 0.1)]  # type: ignore[method-assign]
    found = identifiability(world)
    assert found.share <= 0.5 and found.errors.max() > 1.0


def test_an_episode_that_breaks_in_its_first_step_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    explore = task_inference._explore

    def broken(*given: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        sensors, rewards, alive = explore(*given)
        alive[:, 0] = False
        return sensors, rewards, alive

    monkeypatch.setattr(task_inference, "_explore", broken)
    found = identifiability(world_of("BottleCap-v2", True, 2, tasks=2))
    assert found.errors[0] == np.inf and found.share == 0.5


def test_the_command_measures_a_suite_and_replays_witnesses(tmp_path: Path) -> None:
    text = load_suite("MT1-v2").file.read_text().replace("CatchUnderarm", "BottleCap").replace("= 50", "= 4")
    (tmp_path / "own.toml").write_text(text)
    suite, out = str(tmp_path / "own.toml"), str(tmp_path / "v.json")
    assert main(["validity", "--suite", suite, "--threads", "1", "--out", out]) == 0
    (row,) = json.loads((tmp_path / "v.json").read_text())["classes"].values()
    assert row["hidden"] == ["cap_slide"] and 0.18 < row["blind"] < 0.25 and row["identified"] == 1.0
    assert row["uniform"] == row["zero"] == 0.0 and row["witness"] <= 0.5 and row["held"] <= 0.25
    script, misled = row["policies"]["script"], row["policies"]["misled"]
    assert row["solved"] == script[0] >= 0.5 > misled[0] and script[1] > misled[1]
    aligned = row["alignment"]
    assert aligned["rank"] > 0.8 and aligned["solved"] > aligned["unsolved"] >= row["policies"]["zero"][1]


@pytest.mark.parametrize(("suite", "share"), [("ML1-BottleCap-v2", 0.2), ("ML1-Switch-choice4", 0.25)])
def test_validity_asks_a_suite_how_it_makes_its_tasks(suite: str, share: float) -> None:
    worlds = open_worlds(WorldsConfig(suite=suite, threads=1))
    world = worlds.world("test")
    assert isinstance(world, World)
    assert suite_validity.blind_share(world.slots[0], worlds) == pytest.approx(share, abs=0.01)
    world.close()


def result(returns: list[float], successes: list[float]) -> ClassResult:
    tasks = np.arange(len(returns))
    return ClassResult(np.array(returns), np.array(successes), np.ones(len(returns), np.int64), tasks, 0)


def test_alignment_counts_pairs_of_successful_and_other_episodes() -> None:
    found = alignment({"a": result([5.0, 2.0, 1.0], [1.0, 1.0, 0.0]), "b": result([2.0, 4.0], [0.0, 0.0])})
    # 5 is above 1, 2 and 4; 2 is above 1, ties with 2 and is below 4.
    assert found == Alignment(rank=pytest.approx((3 + 1 - 1) / 6), solved=3.5, unsolved=3.0)
    assert alignment({"a": result([1.0, 2.0], [1.0, 0.0])}) is None, "no policy always fails"
    assert alignment({"b": result([1.0, 2.0], [0.0, 0.0])}) is None, "nobody succeeds"


@pytest.mark.parametrize(
    ("suite", "name", "told"), [("ML1-v2", "mine", "which hides goals"), ("MT1-v2", "script", "already names a policy")]
)
def test_validity_refuses_policies_that_it_would_mislabel(suite: str, name: str, told: str, tmp_path: Path) -> None:
    RunFolder.create(resolve(RunConfig(suite=suite, algo="mtppo", device="cpu")), tmp_path / name)
    with pytest.raises(BidexError, match=told):
        suite_validity.validity_rows(open_worlds({"suite": "MT1-v2"}), [tmp_path / name])
