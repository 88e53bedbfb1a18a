import errno
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.runs import Checkpoints


def state(value):
    return {"weights": torch.full((1000,), float(value)), "nested": {"steps": value, "name": "a"}}


def test_round_trip_and_only_the_last_few_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path, keep=2)
    assert checkpoints.load() is None
    for step in (5, 20, 100):
        checkpoints.save(state(step), step)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["last.pt", "step_100.pt", "step_20.pt"]
    loaded = checkpoints.load()
    assert loaded is not None
    assert loaded[1] == 100
    assert torch.equal(loaded[0]["weights"], state(100)["weights"])
    assert loaded[0]["nested"] == {"steps": 100, "name": "a"}


@pytest.mark.parametrize("damage", ["torn", "empty", "missing", "garbage"])
def test_falls_back_to_the_newest_readable_one(tmp_path, damage, capsys):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state(1), 1)
    checkpoints.save(state(2), 2)
    for path in (checkpoints.last, tmp_path / "step_2.pt"):
        if damage == "missing":
            path.unlink()
        else:
            content = path.read_bytes()
            path.write_bytes({"torn": content[: len(content) // 2], "empty": b"", "garbage": b"x" * 99}[damage])
    loaded = checkpoints.load()
    assert loaded is not None
    assert loaded[1] == 1
    assert ("cannot be read" in capsys.readouterr().err) == (damage != "missing")


def test_nothing_readable_is_an_error_and_not_a_fresh_start(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state(1), 1)
    for path in tmp_path.iterdir():
        path.write_bytes(b"")
    with pytest.raises(BidexError, match="None of the 2 checkpoints"):
        checkpoints.load()


def test_a_checkpoint_cannot_run_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "pwned"),)

    torch.save({"step": 1, "state": Evil()}, tmp_path / "last.pt")
    with pytest.raises(BidexError):
        Checkpoints(tmp_path).load()
    assert not (tmp_path / "pwned").exists()


_WRITER = """
import sys, torch
from pathlib import Path
from bidex_meta.runs import Checkpoints
checkpoints = Checkpoints(Path(sys.argv[1]))
for step in range(1, 10**9):
    checkpoints.save({"w": torch.full((300_000,), float(step))}, step)
"""


def test_a_full_disk_while_torch_writes_is_told_as_what_it_is(tmp_path, monkeypatch):
    """torch.save hides it behind an error of its own, which would be a traceback in the place of one line."""
    save = torch.save

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, data):
            if self.file.tell() > 500:
                raise OSError(errno.ENOSPC, "No space left on device")
            return self.file.write(data)

        def __getattr__(self, name):
            return getattr(self.file, name)

    monkeypatch.setattr(torch, "save", lambda content, file: save(content, Full(file)))
    with pytest.raises(OSError, match="No space left") as told:
        Checkpoints(tmp_path).save(state(1), 1)
    assert told.value.filename == str(tmp_path / "step_1.pt") and list(tmp_path.iterdir()) == []


def test_sigkill_while_writing_leaves_a_readable_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(tmp_path)])
    try:
        deadline = time.monotonic() + 300
        while (checkpoints.newest_step() or 0) < 5 and time.monotonic() < deadline:
            time.sleep(0.001)
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    (tmp_path / ".last.pt.abc.tmp").write_bytes(b"half a file")  # what dying inside a write leaves
    loaded = checkpoints.load()
    assert loaded is not None
    assert loaded[1] >= 4
    assert (loaded[0]["w"] == loaded[1]).all()
    checkpoints.save(loaded[0], loaded[1] + 1)
    assert not list(tmp_path.glob(".*.tmp"))
