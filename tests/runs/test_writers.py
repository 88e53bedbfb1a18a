"""The loggers: what TensorBoard's file holds, and what wandb is told, by a fake."""

import sys
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from bidex_meta.errors import BidexError
from bidex_meta.runs.writers import make_writer

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


def test_none_writes_nothing_and_every_logger_takes_the_same(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb())
    use(make_writer("none", tmp_path), tmp_path / "a.mp4")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(BidexError, match="Did you mean 'tensorboard'"):
        make_writer("tensorbord", tmp_path)
