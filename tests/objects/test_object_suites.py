"""Several objects in one suite: names, goals, rows, held-out objects, results by object; and the default untouched."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bidex_meta import Benchmark, make_task_world
from bidex_meta.cli import main
from bidex_meta.evaluation.play import RandomAgent, evaluate
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.worlds import open_worlds

FOUR = ["CatchUnderarm-egg", "CatchUnderarm-block", "CatchUnderarm-gelatin_box", "CatchUnderarm-tennis_ball"]


def body(geom: str) -> str:
    return f"<mujoco><worldbody><body><geom {geom}/></body></worldbody></mujoco>"


def test_four_objects_share_a_world_and_are_told_apart() -> None:
    benchmark = Benchmark("MT1-objects", seed=0)
    assert list(benchmark.train_classes) == FOUR and len(benchmark.train_tasks) == 200
    world = benchmark.make_world(num_envs=8, device="cpu", threads=1)
    assert world.task_names == FOUR and world.reset(seed=0)[0].shape == (8, 422 + 4)
    members = [member for part in world.parts for member in part.group.members]
    masses = {world.task_names[m.slot]: float(m.scene.model.body("object/object").mass[0]) for m in members}
    assert masses == pytest.approx(dict(zip(FOUR, (0.0754, 0.0709, 0.097, 0.058), strict=True)), abs=1e-4)
    assert len(world.parts) == 3  # block and box differ in numbers alone and share an engine


def test_all_objects_have_the_goals_of_the_class() -> None:
    """Those of MT4, so that success compares objects and nothing else."""
    by_name: dict[str, list[bytes]] = {}
    for task in [*Benchmark("MT1-objects").train_tasks, *Benchmark("MT4").train_tasks]:
        by_name.setdefault(task.env_name, []).append(task.data)
    for name in FOUR:
        assert by_name[name] == by_name["CatchUnderarm"]


def test_a_held_out_object_is_a_test_split() -> None:
    benchmark = Benchmark("ML1-objects")
    assert list(benchmark.train_classes) == FOUR[:3] and list(benchmark.test_classes) == FOUR[3:]
    env = benchmark.test_classes[FOUR[3]]()
    env.set_task(benchmark.test_tasks[0])
    obs, _ = env.reset(seed=0)
    assert obs.shape == (422,) and env.task_name == FOUR[3]
    assert not obs[env.task_class.layout.goal_indices()].any()


def test_success_is_told_by_object(tmp_path: Path) -> None:
    text = load_suite("MT1-objects").file.read_text()
    (tmp_path / "one.toml").write_text(text.replace("tasks_per_class = 50", "tasks_per_class = 1"))
    source = open_worlds({"suite": str(tmp_path / "one.toml"), "threads": 1})
    assert list(source.tasks("train")) == FOUR
    world = source.world("train", 4)
    found = evaluate(RandomAgent(world.action_space), world, 1, seed=0, references=source.references())
    classes = found.to_json()["classes"]
    assert list(classes) == FOUR and all(classes[name]["episodes"] == 1 for name in FOUR)


def test_a_class_on_its_own_with_an_object_trains_and_is_evaluated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "puck.xml").write_text(body('type="cylinder" size="0.03 0.01" mass="0.1"'))
    run = ["run", "--task", "catchunderarm", "--object", "puck.xml", "--algo", "ppo", "--num-envs", "4"]
    assert main([*run, "--steps", "64", "--threads", "1", "--no-evaluate", "--logger", "none"]) == 0
    (folder,) = (tmp_path / "runs" / "CatchUnderarm-puck" / "ppo").iterdir()
    monkeypatch.chdir(folder)  # the config has the file's whole path
    assert main(["evaluate", str(folder), "--episodes", "1", "--json"]) == 0
    assert "CatchUnderarm-puck" in capsys.readouterr().out
    more = ["run", "--resume", str(folder), "--steps", "128", "--no-evaluate"]
    assert main(more) == 0
    assert main([*more, "--object", "mug"]) == 2
    assert "a resumed run keeps its config" in capsys.readouterr().err


def test_a_suite_names_files_beside_it(tmp_path: Path) -> None:
    text = (load_suite("MT1-objects").file).read_text().replace('"tennis_ball"', '"own/stone.xml"')
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "stone.xml").write_text(body('type="sphere" size="0.03"'))
    (tmp_path / "stones.toml").write_text(text)
    assert list(Benchmark(tmp_path / "stones.toml").train_classes)[3] == "CatchUnderarm-stone"


@pytest.mark.parametrize(
    "name", ["HandOver", "CatchUnderarm", "CatchOver2Underarm", "CatchAbreast", "TwoCatchUnderarm"]
)
def test_every_throwing_class_takes_an_object_and_the_egg_is_the_default(name: str) -> None:
    usual, named, other = (registry.get(name, True, **more) for more in ({}, {"object": "Egg"}, {"object": "mug"}))
    assert usual.scene_key == named.scene_key != other.scene_key
    assert usual.needs == named.needs and usual.needs.contacts < other.needs.contacts
    assert usual.layout == other.layout
    model, same = compile_scene(usual).model, compile_scene(named).model
    np.testing.assert_array_equal(model.geom_size, same.geom_size)
    world = make_task_world(name, 6, "cpu", threads=1, moving_base=True, object="mug")
    world.reset(seed=0)
    assert torch.isfinite(world.step(torch.zeros(6, 52))[1]).all()
    assert world.task_names == [f"{name}-mug"]
    assert make_task_world(name, 1, "cpu", threads=1, object="MUG").task_names == [f"{name}-mug"]
