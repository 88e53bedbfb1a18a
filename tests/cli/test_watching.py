"""Looking at a run while it learns: evaluations, the best policy, films; training goes on as if nobody looked."""

import json
import random

import numpy as np
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.experiments import watching
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.runs.writers import LOGGERS, Writer
from bidex_meta.utils import gl_backend
from tests.algos.ranks import same
from tests.cli.small_runs import final, run


@pytest.fixture(autouse=True)
def screen(monkeypatch, request):
    """Some way to draw, and small tiles."""
    if "real_drawing" not in request.keywords:
        monkeypatch.setattr(gl_backend, "prepare", lambda: None)
    monkeypatch.setattr(watching, "_FILM", {"width": 64, "height": 44})
    monkeypatch.setattr(watching, "_MOST_FILM_STEPS", 4)


def learned(path, but=("time",), without=("Perf/",)):
    rows = read_metrics(path / "metrics.jsonl")
    return [{k: v for k, v in row.items() if k not in but and not k.startswith(without)} for row in rows]


@pytest.mark.parametrize("algo", ["mtppo", "mtsac"])
def test_looking_changes_nothing_of_what_is_learned(algo, toy_worlds, tmp_path, monkeypatch):
    load = watching.Watch._policy

    def greedy(watch, device):
        """Draws from every generator there is, as a policy's making may."""
        torch.rand(3), np.random.rand(3), random.random()
        return load(watch, device)

    monkeypatch.setattr(watching.Watch, "_policy", greedy)
    flags = ["--suite", "MT4", "--algo", algo, "--num-envs", "6", "--threads", "1", "--device", "cpu"]
    flags += ["--learner.hidden", "8", "--steps", "120", "--no-evaluate", "--logger", "none"]
    torch.manual_seed(1)
    assert main(["run", *flags, "--run-dir", str(tmp_path / "a")]) == 0
    after = torch.rand(1)
    torch.manual_seed(1)
    looking = ["--evaluate-every", "1", "--video-every", "2"]
    assert main(["run", *flags, *looking, "--run-dir", str(tmp_path / "b")]) == 0
    assert torch.equal(torch.rand(1), after)
    assert same(final(tmp_path / "a"), final(tmp_path / "b"))
    a, b = learned(tmp_path / "a"), learned(tmp_path / "b", without=("Perf/", "Eval/"))
    assert a == b
    assert all("Eval/success/Near" in row for row in read_metrics(tmp_path / "b" / "metrics.jsonl"))


def test_a_resumed_run_looks_when_the_unbroken_one_does(toy_worlds, tmp_path):
    looking = ["--evaluate-every", "3", "--no-evaluate"]
    assert run("--steps", 240, "--run-dir", tmp_path / "whole", *looking) == 0
    assert run("--steps", 96, "--run-dir", tmp_path / "parts", *looking) == 0
    assert main(["run", "--resume", str(tmp_path / "parts"), "--steps", "240", "--no-evaluate"]) == 0
    assert learned(tmp_path / "whole") == learned(tmp_path / "parts")
    assert RunFolder.open(tmp_path / "parts").config().steps == 240
    evaluated = [row["step"] for row in learned(tmp_path / "parts") if "Eval/success_rate" in row]
    assert evaluated == [72, 144, 216]
    assert same(final(tmp_path / "whole"), final(tmp_path / "parts"))
    best = [RunFolder.open(tmp_path / name).checkpoints.load_one(tmp_path / name / "checkpoints" / "best.pt")
            for name in ("whole", "parts")]  # fmt: skip
    assert same(*best)


def test_a_resumed_run_may_be_looked_at_otherwise(toy_worlds, tmp_path):
    assert run("--steps", 48, "--run-dir", tmp_path / "r", "--no-evaluate") == 0
    more = ["--steps", "96", "--evaluate-every", "1", "--logger", "none", "--no-evaluate"]
    assert main(["run", "--resume", str(tmp_path / "r"), *more]) == 0
    assert RunFolder.open(tmp_path / "r").config().evaluate_every == 1
    assert ["Eval/success_rate" in row for row in learned(tmp_path / "r")] == [False, False, True, True]


def test_the_best_policy_is_kept_and_judged(toy_worlds, tmp_path, monkeypatch, shown, refused):
    path, marks = tmp_path / "r", iter([0.25, 0.75, 0.75, 0.5])
    monkeypatch.setattr(watching.Watch, "_judge", lambda watch: None)
    monkeypatch.setattr(watching, "_metrics", lambda found: {"Eval/success_rate": next(marks), "Eval/mean_return": 1.0})
    assert run("--steps", 96, "--run-dir", path, "--no-evaluate", "--evaluate-every", 1) == 0
    steps = {}
    for which in ("last", "best", "step_96.pt", path / "checkpoints" / "best.pt"):
        steps[which] = json.loads(shown("evaluate", path, "--json", "--episodes", 1, "--checkpoint", which))["steps"]
    assert list(steps.values()) == [96, 48, 96, 48]
    assert "There is no worst.pt. Checkpoints in" in refused("evaluate", path, "--checkpoint", "worst.pt")
    (path / "checkpoints" / "best.pt").unlink()
    assert "--evaluate-every" in refused("evaluate", path, "--checkpoint", "best")


def test_equal_success_is_settled_by_the_score_or_the_return():
    def better(*numbers, name="Eval/score"):
        found = [{"Eval/success_rate": s, "Eval/mean_return": 9.0 - v, name: v} for s, v in numbers]
        return watching._better(*found)

    assert better((0.5, 1), (0.4, 2)) and not better((0.4, 2), (0.5, 1))
    assert better((0.5, 2), (0.5, 1)) and not better((0.5, 1), (0.5, 1))
    assert better((0.0, 2), (0.0, 1), name="Eval/mean_return")


def test_films_are_of_every_class_and_go_to_the_logger(toy_worlds, tmp_path, monkeypatch):
    seen = []

    class Notes(Writer):
        def config(self, values):
            seen.append(values["algo"])

        def film(self, tag, path, frames, fps, step):
            seen.append((tag, path, len(frames), frames[0].shape, fps, step))

    monkeypatch.setitem(LOGGERS, "none", Notes)
    flags = ["--no-evaluate", "--video-every", 2, "--logger", "none"]
    assert run("--steps", 96, "--run-dir", tmp_path / "r", *flags) == 0
    films = [tmp_path / "r" / "videos" / f"training_{step}.mp4" for step in (48, 96)]
    # Four steps, every second of them; four tiles of 64 x 44 with 20 for the name.
    assert seen == ["mtppo", *(("Film/training", film, 3, (128, 128, 3), 30.0, int(film.stem[9:])) for film in films)]
    assert all(film.stat().st_size > 0 for film in films)


def test_a_film_that_fails_ends_nothing(toy_worlds, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(watching, "_FILM", {"width": 63, "height": 44, "camera": "none"})

    def full(*arguments):
        raise OSError("disk full")

    monkeypatch.setattr("bidex_meta.runs.recorder.write_video", full)
    assert run("--steps", 48, "--run-dir", tmp_path / "r", "--no-evaluate", "--video-every", 1) == 0
    assert "No film at 24 steps: disk full" in capsys.readouterr().err


def test_what_cannot_be_watched_is_refused_before_the_run(toy_worlds, tmp_path, monkeypatch, capsys):
    def blind():
        raise gl_backend.BidexError("no way to draw")

    monkeypatch.setattr(gl_backend, "prepare", blind)
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    for flags, told in (
        (["--video-every", "1"], "no way to draw"),
        (["--logger", "wandb"], "bidex-meta[wandb]"),
        (["--evaluate-every", "0"], "--evaluate-every"),
    ):
        assert run("--steps", 48, "--run-dir", tmp_path / "r", *flags) == 2
        assert told in capsys.readouterr().err
        assert not (tmp_path / "r").exists()
