"""Point clouds from the command line: trained on, evaluated, drawn, measured, refused."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.cli import main
from bidex_meta.evaluation import filming
from bidex_meta.experiments.policies import load_checkpoint
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.suite_files import load_suite
from tests.pages import ROOT

_SMALL = ["--num-envs", "8", "--threads", "1", "--device", "cpu", "--points", "24", "--logger", "none"]


def suite_file(folder: Path, table: str) -> Path:
    path = folder / "own.toml"
    path.write_text((ROOT / "suites" / "MT4.toml").read_text().replace("[[classes]]", f"{table}\n\n[[classes]]", 1))
    return path


@pytest.mark.parametrize("algo", ["ppo", "sac", "happo"])
def test_a_run_reads_clouds_and_is_evaluated_on_them(algo, tmp_path, capsys):
    flags = ["--task", "HandOver", "--algo", algo, *_SMALL, "--learner.point-widths", "4", "8", "--learner.hidden", "8"]
    flags += ["--learner.warmup-steps", "2"] if algo == "sac" else []
    assert main(["run", *flags, "--steps", "64", "--episodes", "1", "--run-dir", str(tmp_path / "a")]) == 0
    folder = RunFolder.open(tmp_path / "a")
    assert folder.config().points == 24 and read_metrics(folder.metrics_path)[-1]["step"] >= 64
    assert folder.evaluation().results.keys() == {"HandOver"}
    state, _ = load_checkpoint(folder, "last")
    shapes = [each.shape for name, each in state["learner"]["policy"]["weights"].items() if "shared.0.weight" in name]
    assert torch.Size([4, 3]) in shapes, "the actor has a PointNet"
    # Commands that show the run use its own points.
    assert main(["evaluate", str(tmp_path / "a"), "--episodes", "1"]) == 0
    capsys.readouterr()


def test_a_data_set_of_clouds_is_learned_from(tmp_path: Path) -> None:
    """Its points are the run's without being named."""
    pytest.importorskip("h5py", reason="needs the extra data")
    seen, learned = tmp_path / "seen", tmp_path / "learned"
    small = ["--learner.hidden", "8", "--no-evaluate"]
    record = ["--steps", "1200", "--record", "1200", "--run-dir", str(seen)]
    assert main(["run", "--task", "HandOver", "--algo", "ppo", *_SMALL, *small, *record]) == 0
    flags = ["--algo", "bc", "--steps", "2", "--threads", "1", "--device", "cpu", "--logger", "none", *small]
    assert main(["run", "--dataset", str(seen / "replay"), *flags, "--run-dir", str(learned)]) == 0
    config = RunFolder.open(learned).config()
    assert (config.task, config.points, config.learner["point_widths"]) == ("HandOver", 24, [32, 64])


def test_a_suite_file_asks_for_points(tmp_path: Path) -> None:
    for table, points in (
        ("[points]\ncount = 12\nkinds = true", (12, True)),
        ("[points]", (768, False)),
        ("", (0, False)),
    ):
        suite = load_suite(suite_file(tmp_path, table))
        assert (suite.points, suite.point_kinds) == points


def test_environments_of_a_suites_classes_show_its_points(tmp_path: Path) -> None:
    """As the rows of its worlds, before the one-hot."""
    benchmark = Benchmark(suite_file(tmp_path, "[points]\ncount = 12\nkinds = true"))
    world = benchmark.make_world(num_envs=4, device="cpu", threads=1)
    env = benchmark.train_classes["HandOver"]()
    env.set_task(benchmark.train_tasks[50])
    assert env.task_name == "HandOver" == benchmark.train_tasks[50].env_name
    obs, _ = env.reset(seed=0)
    assert world.single_observation_space.shape == (len(obs) + 4,)
    kinds = obs[-48:].reshape(12, 4)[:, 3]
    assert set(kinds.tolist()) <= {1.0, 0.0, -1.0}
    assert Benchmark("MT4").train_classes["HandOver"]().observation_space.shape == (len(obs) - 48,)


def test_render_puts_the_cloud_beside_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    world = make_task_world("HandOver", 3, "cpu", autoreset_mode="DISABLED", threads=1)
    black = lambda self, env_id, width, height, camera: np.zeros((height, width, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr(type(world), "render", black)
    looked = filming.CloudView(world, 200)
    looked.reset(seed=0)
    pictures = [looked.render(env_id=row, width=60, height=50) for row in (0, 2)]
    assert pictures[0].shape == (50, 180, 3) and (pictures[0][:, :60] == 0).all()
    red, blue = (pictures[0][..., i].astype(int) for i in (0, 2))
    orange = np.asarray((red > blue + 40).any(axis=0))
    assert orange[60:120].any() and orange[120:].any(), "the egg is seen from the camera and from the side"
    for _ in range(20):
        looked.step(torch.zeros(3, looked.action_size))
    assert (looked.render(env_id=0, width=60, height=50) != pictures[0]).any(), "it moves with the physics"


def test_a_copy_of_a_world_with_points_goes_on_alike() -> None:
    world = make_task_world("HandOver", 2, "cpu", autoreset_mode="SAME_STEP", threads=1, points=24)
    world.reset(seed=0)
    other = copy.deepcopy(world)
    action = torch.zeros(2, world.action_size)
    assert torch.equal(world.step(action)[0], other.step(action)[0])
