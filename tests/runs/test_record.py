import io
import json
import math
import os
import resource
import sys
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bidex_meta.config import RunConfig
from bidex_meta.data.part_files import SealedFile
from bidex_meta.errors import BidexError
from bidex_meta.runs import MetricsWriter, Progress, Recorder, RunFolder, mend, read_metrics
from bidex_meta.runs import progress as progress_module
from bidex_meta.runs.evaluations import read_evaluation
from bidex_meta.runs.metrics import last_rows
from bidex_meta.runs.plots import Curve, draw_adaptation, draw_learning, save, svg
from bidex_meta.runs.video import check_suffix, write_animation, write_image, write_video
from bidex_meta.runs.writers import make_writer

CONFIG = RunConfig(suite="MT4", algo="mtppo", seed=3, learner={"hidden": [8]}, num_envs=8, steps=100, threads=1)


def board_points(folder, tag):
    events = EventAccumulator(str(folder))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(tag)]


def test_run_folder_is_complete_when_made(tmp_path):
    folder = RunFolder.create(CONFIG, root=tmp_path)
    assert folder.path.parent == tmp_path / "MT4" / "mtppo"
    assert folder.path.name.endswith("_seed3")
    parts = ["checkpoints", "config.json", "metrics.jsonl", "versions.json", "videos"]
    assert sorted(path.name for path in folder.path.iterdir()) == parts
    assert RunFolder.open(folder.path).config() == CONFIG
    assert folder.versions()["packages"]["torch"]
    paths = {RunFolder.create(CONFIG, root=tmp_path).path for _ in range(3)}
    assert len(paths) == 3, "runs that begin in one second share no folder"
    with pytest.raises(BidexError, match=folder.path.name):  # those below are named
        RunFolder.open(tmp_path)


def test_a_used_folder_is_refused_and_left_alone(tmp_path):
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(BidexError, match="not empty"):
        RunFolder.create(CONFIG, path=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_metrics_go_to_both_and_resume_drops_what_came_after_the_checkpoint(tmp_path):
    writer = MetricsWriter(tmp_path)
    for step in (10, 20, 30):
        writer.log({"Train/mean_return": step}, step)
    writer.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 40, "Train/me')  # torn by the crash
    resumed = MetricsWriter(tmp_path, resume_step=20)
    assert [row["step"] for row in read_metrics(tmp_path / "metrics.jsonl")] == [10, 20]
    resumed.log({"Train/mean_return": -1.0}, 30)
    resumed.close()
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [(row["step"], row["Train/mean_return"]) for row in rows] == [(10, 10.0), (20, 20.0), (30, -1.0)]
    assert board_points(tmp_path, "Train/mean_return") == [(10, 10.0), (20, 20.0), (30, -1.0)]


def test_a_value_that_is_not_finite_stays_valid_json(tmp_path):
    writer = MetricsWriter(tmp_path)
    writer.log({"Loss/value": math.nan, "Loss/policy": math.inf, "ok": 1}, 1)
    writer.close()
    row = json.loads((tmp_path / "metrics.jsonl").read_text(), parse_constant=pytest.fail)
    assert (row["Loss/value"], row["Loss/policy"], row["ok"]) == (None, None, 1.0)


@pytest.fixture
def rare_lines(monkeypatch):
    """However slow the machine, no second line is due."""
    monkeypatch.setattr(progress_module, "_PLAIN_SECONDS", math.inf)


def test_progress_without_a_terminal_is_one_plain_line(rare_lines):
    stream = io.StringIO()
    progress = Progress(1000, start_step=500, stream=stream)
    progress.start()
    metrics = {"Train/mean_return": 3.25, "Train/success_rate": 0.5, "Train/success/HandOver": 0.25}
    progress.update(metrics, 600)
    progress.update(metrics, 700)
    progress.close()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1
    for part in ("600 / 1,000 steps", "steps/s", "left", "return 3.25", "success 50.0 %", "HandOver 25.0 %"):
        assert part in lines[0]


def test_time_left_is_that_of_what_ends_first(rare_lines):
    stream = io.StringIO()
    progress = Progress(10**15, total_seconds=300.0, stream=stream)  # more steps than any machine's microseconds make
    progress.start()
    progress.update({"Perf/training_time": 60.0}, 10)
    progress.update({"Perf/training_time": 120.0}, 20)
    progress.update({"Perf/training_time": 301.0}, 30)
    progress.close()
    first, last = stream.getvalue().splitlines()
    assert "1:00 of 5:00  10 steps" in first and "4:00 left" in first
    assert "5:01 of 5:00  30 steps" in last and "0:00 left" in last


def test_progress_in_a_terminal_is_a_table(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    progress = Progress(1000, stream=stream)
    progress.start()
    progress.update({"Train/success/HandOver": 0.25, "Train/return/HandOver": 7.0}, 600)
    progress.close()
    assert "HandOver" in stream.getvalue()
    assert "25.0 %" in stream.getvalue()
    left = stream.getvalue().rpartition("\x1b[2K")[2]  # after what clears the table
    assert left.startswith("600 / 1,000 steps") and left.count("\n") == 1


@pytest.mark.parametrize("width", [80, 100, 160])
def test_the_live_heading_breaks_no_number_from_its_unit(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    progress = Progress(20_000_000, stream=io.StringIO())
    progress._shown = {"Train/mean_return": -1234.5, "Train/success_rate": 0.123, "Policy/teacher_share": 0.5}
    progress._shown |= {f"Train/success/{name}": 0.5 for name in ("CatchOver2Underarm", "DoorCloseOutward")}
    monkeypatch.setattr(progress, "_rate", lambda step: 2099.0)
    with progress._console.capture() as shown:
        progress._console.print(progress._table(12_345_678))
    lines = shown.get().splitlines()
    heading = lines[: next(number for number, line in enumerate(lines) if "━" in line)]
    assert len(heading) == (2 if width < 110 else 1) and max(map(len, heading)) <= width
    for part in ("12,345,678 / 20,000,000 steps", "2,099 steps/s", "1:00:47 left", "return -1234", "success 12.3 %"):
        assert any(part in line for line in heading)


def curve(*values, spread=None):
    mean = np.array(values, float)
    ends = (None, None) if spread is None else (mean - spread, mean + spread)
    return Curve(np.arange(len(values), dtype=float), mean, *ends)


def test_curves_are_drawn_and_an_empty_run_says_so(tmp_path):
    with pytest.raises(BidexError, match="no episode has ended"):
        draw_learning([("mtppo", {"Loss/value": curve(1.0)})])
    tags = {f"Train/{kind}/T{i}": curve(0.1, 0.2, spread=0.05) for i in range(5) for kind in ("return", "success")}
    other = {"Eval/success/T0": curve(0.5), "Train/return/T5": curve(1.0, 2.0)}
    figure = draw_learning([("mtppo, gamma $0.9$", tags), ("mtsac", other)])
    shown = [axis for axis in figure.axes if axis.axison]
    assert len(shown) == 2 * 6
    assert [len(axis.lines) for axis in shown[:4]] == [1, 1, 1, 1]
    success = next(axis for axis in figure.axes if axis.get_ylabel() == "success")
    assert [line.get_linestyle() for line in success.lines] == ["-", "--"]
    assert len(success.collections) == 1  # the interval of the first group
    save(figure, tmp_path / "new" / "c.png")
    assert (tmp_path / "new" / "c.png").read_bytes()[:4] == b"\x89PNG"
    assert b"gamma $0.9$" in svg(figure)
    with pytest.raises(BidexError, match=r"png.*got 'c\.txt'"):
        save(figure, tmp_path / "c.txt")


@pytest.mark.parametrize("text", ["[1]", "{}"])
def test_a_file_without_a_meta_test_is_one_line(text, tmp_path):
    path = tmp_path / "evaluation.json"
    with pytest.raises(BidexError, match="No such file"):
        read_evaluation(path, "again")
    path.write_text(text)
    with pytest.raises(BidexError, match=r"content: expected a table|policy: expected it to be there"):
        read_evaluation(path, "again")
    path.write_text(json.dumps({"policy": {"classes": {"A": {"success": 0.5, "return": 1.0}}}}))
    with pytest.raises(BidexError, match="holds no meta-test"):
        draw_adaptation(read_evaluation(path, "again"), path)


def test_picture_and_film_read_back(tmp_path):
    frame = np.zeros((50, 70, 3), np.uint8)
    frame[:, :35, 0] = 255
    write_image(tmp_path / "a.png", frame)
    assert (imageio.imread(tmp_path / "a.png") == frame).all()
    assert write_video(tmp_path / "a.mp4", [frame] * 5, fps=60) == 5
    film = imageio.imread(tmp_path / "a.mp4")
    assert film.shape == (5, 50, 70, 3)
    assert abs(film[2].astype(int) - frame).mean() < 10


@pytest.mark.skipif(os.name != "posix", reason="needs a umask")
@pytest.mark.parametrize("umask", [0o077, 0o027, 0o022, 0o002])
def test_the_umask_decides_who_may_read_what_is_written(umask: int, tmp_path):
    before = os.umask(umask)
    try:
        folder = RunFolder.create(CONFIG, tmp_path / "r")
        folder.checkpoints.save({"weights": torch.zeros(3)}, 1)
        folder.change_config(replace(CONFIG, steps=200))
        with Recorder(folder, 10) as record:
            record.log({"Train/return/HandOver": 1.0}, 1)
        write_image(folder.videos_path / "a.png", np.zeros((4, 4, 3), np.uint8))
        write_animation(folder.videos_path / "a.webp", [np.zeros((4, 4, 3), np.uint8)] * 2, 10)
        save(draw_learning([("a", {"Train/return/HandOver": curve(1.0, 2.0)})]), folder.path / "a.svg")
        sealed = SealedFile(folder.path / "part.hdf5")
        sealed.commit()
        mend(folder.metrics_path, 0)
    finally:
        os.umask(before)
    paths = [tmp_path / "r", *(tmp_path / "r").rglob("*")]
    assert len(paths) > 12
    modes = {path.name: path.stat().st_mode & 0o777 for path in paths}
    expected = {path.name: (0o777 if path.is_dir() else 0o666) & ~umask for path in paths}
    assert modes == expected


@pytest.mark.skipif(os.name != "posix", reason="needs a limit of a file's size")
@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.mp4", "figure.png"])
def test_a_disk_that_fills_leaves_what_was_there(name, tmp_path):
    path, frames = tmp_path / name, list(np.random.default_rng(0).integers(0, 256, (5, 200, 200, 3), np.uint8))
    path.write_text("earlier")
    figure = draw_learning([("mtppo", {"Train/return/Near": curve(2.0)})])

    def write():
        if name == "figure.png":
            save(figure, path)
        elif name == "a.png":
            write_image(path, frames[0])
        else:
            (write_animation if name == "a.webp" else write_video)(path, frames, fps=60)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))  # in place of a full disk
    try:
        with pytest.raises(OSError) as raised:
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not isinstance(raised.value, BrokenPipeError)  # which would be the end of a reader
    assert [entry.name for entry in tmp_path.iterdir()] == [name] and path.read_text() == "earlier"
    write()
    assert path.stat().st_size > 8192


def test_endings_and_the_missing_extra(tmp_path, monkeypatch):
    with pytest.raises(BidexError, match=r"\.mp4"):
        check_suffix(tmp_path / "a.gif")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(BidexError, match=r"bidex-meta\[video\]"):
        write_video(tmp_path / "a.mp4", [], fps=60)


def test_the_last_rows_are_those_of_the_whole_file(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps({"step": i, "x": 0.1234567}) + "\n" for i in range(5000)) + '{"torn')
    found = last_rows(path)
    assert 100 < len(found) < 5000 and found == read_metrics(path)[-len(found) :]
    path.write_text('{"step": 1}\n')
    assert last_rows(path) == [{"step": 1}]


FRAMES = [np.full((4, 6, 3), 40 * i, np.uint8) for i in range(3)]


def use(writer, path):
    writer.config({"algo": "mtppo", "learner": {"gamma": 0.9}})
    writer.scalars({"Train/mean_return": 2.0}, 10)
    writer.film("Film/training", path, FRAMES, 30.0, 10)
    writer.flush()
    writer.close()


def test_tensorboard_holds_numbers_config_and_films(tmp_path):
    use(make_writer("tensorboard", tmp_path), tmp_path / "a.mp4")
    board = EventAccumulator(str(tmp_path), size_guidance={"tensors": 0, "images": 0})
    board.Reload()
    assert [(point.step, point.value) for point in board.Scalars("Train/mean_return")] == [(10, 2.0)]
    assert b'"gamma": 0.9' in board.Tensors("config/text_summary")[0].tensor_proto.string_val[0]
    [film] = board.Images("Film/training")
    assert (film.step, film.width, film.height) == (10, 6, 4)
    assert film.encoded_image_string.startswith(b"GIF89a")


class FakeWandb(SimpleNamespace):
    """Notes what it is told."""

    def __init__(self):
        super().__init__(told=[], Video=lambda path, format: (path, format))

    def init(self, **options: object):
        self.told.append(("init", options))

        def note(name: str) -> Callable[..., None]:
            return lambda *given, **named: self.told.append((name, given, named))

        config = SimpleNamespace(update=note("config"))
        return SimpleNamespace(define_metric=note("define"), log=note("log"), finish=note("finish"), config=config)


def test_wandb_is_told_the_same_and_a_resumed_run_goes_on_there(tmp_path, monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setenv("WANDB_PROJECT", "hands")
    use(make_writer("wandb", tmp_path), tmp_path / "a.mp4")
    begun = fake.told[0][1]
    assert (begun["project"], begun["resume"], begun["dir"]) == ("hands", "allow", str(tmp_path))
    said = [entry[1][0] for entry in fake.told if entry[0] in ("config", "log")]
    assert said[0]["learner"] == {"gamma": 0.9}
    assert said[1:] == [
        {"Train/mean_return": 2.0, "env_steps": 10},
        {"Film/training": (str(tmp_path / "a.mp4"), "mp4"), "env_steps": 10},
    ]
    assert fake.told[-1][0] == "finish"
    make_writer("wandb", tmp_path, resume_step=10)
    again = [entry[1]["id"] for entry in fake.told if entry[0] == "init"]
    assert again[0] == again[1]


def test_a_logger_gets_the_config_of_a_resumed_run(tmp_path, monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    folder = RunFolder.create(CONFIG, tmp_path / "run")
    with Recorder(folder, 100, resume_step=50, logger="wandb", show_progress=False):
        pass
    [config] = [entry[1][0] for entry in fake.told if entry[0] == "config"]
    assert config["steps"] == 100


def test_none_writes_nothing_and_every_logger_takes_the_same(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb())
    use(make_writer("none", tmp_path), tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(BidexError, match="Did you mean 'tensorboard'"):
        make_writer("tensorbord", tmp_path)
