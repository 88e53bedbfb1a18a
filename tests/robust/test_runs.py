"""What happens to a run when its folder, its machine or its training goes wrong."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest

from bidex_algos.onpolicy.mtppo import MTPPO
from bidex_meta.cli import main
from bidex_meta.runs import Progress, Recorder, RunFolder
from bidex_meta.runs import folder as folder_module
from bidex_meta.worlds.own import OwnSuite
from tests.fakes import ToyWorld, run_config

SMALL = ["--suite", "MT4", "--num-envs", "6", "--threads", "1", "--device", "cpu", "--learner.hidden", "8"]
SMALL += ["--learner.rollout-steps", "4", "--no-evaluate"]


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    make = lambda source, split="train", rows=None, mode="DISABLED": ToyWorld(rows or 6, mode, source.seed)  # noqa: E731
    monkeypatch.setattr(OwnSuite, "world", make)


@pytest.fixture
def run(toy: None, tmp_path: Path) -> Path:
    assert main(["run", *SMALL, "--steps", "48", "--run-dir", str(tmp_path / "r")]) == 0
    return tmp_path / "r"


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert main([str(word) for word in words]) in (1, 2)
    return capsys.readouterr().err


def test_a_failed_resume_changes_nothing(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoints = RunFolder(run).checkpoints
    state, step = checkpoints.load() or ({}, 0)
    state["learner"]["policy"]["weights"].popitem()
    checkpoints.save(state, step)
    before = (run / "config.json").read_text()
    assert "does not fit its config" in refused(capsys, "run", "--resume", run, "--steps", "9999")
    assert (run / "config.json").read_text() == before


def test_two_processes_do_not_train_in_one_folder(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunFolder(run).locked():
        assert "Another process trains in" in refused(capsys, "run", "--resume", run, "--steps", "96")
    assert main(["run", "--resume", str(run), "--steps", "96", "--no-evaluate"]) == 0
    assert not list(run.glob("*lock*"))


def test_a_system_without_locks_trains_without_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_module, "fcntl", None)
    with RunFolder(tmp_path / "not here").locked(), RunFolder(tmp_path / "not here").locked():
        pass  # Windows cannot open a folder, so nothing may try to


def test_a_start_that_was_torn_begins_again(toy: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("checkpoints", "videos"):
        (tmp_path / "r" / name).mkdir(parents=True)
    (tmp_path / "r" / "metrics.jsonl").touch()
    assert f"Begin again: --run-dir {tmp_path / 'r'}" in refused(capsys, "run", "--resume", tmp_path / "r")
    assert main(["run", *SMALL, "--steps", "24", "--run-dir", str(tmp_path / "r")]) == 0


@pytest.mark.parametrize("more", [[], ["--record", "24"]])
def test_a_run_that_failed_before_it_learned_anything_does_not_block_its_command(
    more: list[str], toy: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["run", *SMALL, "--steps", "24", "--run-dir", str(tmp_path / "r"), *more]

    def fail(learner: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(MTPPO, "_iterate", fail)
        assert main(words) == 2
    assert (tmp_path / "r" / "config.json").is_file()
    with RunFolder(tmp_path / "r").locked():
        assert "Another process trains in" in refused(capsys, *words)
    (tmp_path / "r" / "mine").touch()
    assert "is not empty" in refused(capsys, *words)
    (tmp_path / "r" / "mine").unlink()
    assert main(words) == 0
    assert [row["step"] for row in RunFolder(tmp_path / "r").metrics()] == [24]
    assert "is not empty" in refused(capsys, *words)


def test_a_start_that_was_killed_at_its_first_file_begins_again(toy: None, tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / ".config.json.x1.tmp").touch()
    assert main(["run", *SMALL, "--steps", "24", "--run-dir", str(tmp_path / "r")]) == 0
    assert not list(tmp_path.rglob("*.tmp"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".mine.tmp").touch()
    assert main(["run", *SMALL, "--steps", "24", "--run-dir", str(tmp_path / "other")]) == 2
    assert (tmp_path / "other" / ".mine.tmp").exists()


def test_a_resume_ends_a_save_that_was_killed(run: Path) -> None:
    kept = run / "checkpoints"
    newest = (kept / "last.pt").read_bytes()
    (kept / "last.pt").write_bytes(b"older")
    os.utime(kept / "last.pt", (1.0, 1.0))
    for name in ("checkpoints/.last.pt.x.tmp", ".evaluation.json.x.tmp"):
        (run / name).touch()
    assert main(["run", "--resume", str(run), "--no-evaluate"]) == 0
    assert (kept / "last.pt").read_bytes() == newest
    assert not list(run.rglob("*.tmp"))


def test_damaged_metrics_do_not_stop_a_run(run: Path) -> None:
    path = run / "metrics.jsonl"
    first, second = path.read_bytes().splitlines()
    path.write_bytes(first + b"\n\xff{torn\nnull\n" + second + b"\n")
    assert main(["run", "--resume", str(run), "--steps", "72", "--no-evaluate"]) == 0
    assert path.read_bytes().splitlines()[:2] == [first, second] and len(path.read_bytes().splitlines()) == 3
    assert b"null" in (run / "metrics.jsonl.damaged").read_bytes()


def test_places_that_cannot_be_written_are_told_before_a_world_is_built(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OwnSuite, "world", lambda *_: pytest.fail("a world was built"))
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file" / "r", Path("/proc/r"), tmp_path / ("x" * 256), Path("/dev/null")):
        assert refused(capsys, "run", *SMALL, "--run-dir", folder).count("\n") == 1
    assert "would take about" in refused(capsys, "run", *SMALL, "--num-envs", "9000000")
    assert "would take about" in refused(capsys, "run", *SMALL, "--learner.rollout-steps", "1000000000")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_divergence_ends_in_one_line(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    def diverge(learner: object) -> None:
        raise FloatingPointError("mtppo: the loss is not finite after 48 steps; lower the step size.")

    monkeypatch.setattr(MTPPO, "_iterate", diverge)
    told = refused(capsys, "run", "--resume", run, "--steps", "96").splitlines()[-1]
    assert told.startswith("bidex-meta: mtppo: the loss is not finite after 48 steps; lower the step size. What was")


def test_a_full_disk_is_one_line(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "checkpoints/step_96.pt")

    monkeypatch.setattr("bidex_meta.runs.checkpoints.write_atomic", full)
    told = refused(capsys, "run", "--resume", run, "--steps", "96").splitlines()[-1]
    assert told.startswith("bidex-meta: checkpoints/step_96.pt: No space left on device.")


@pytest.mark.skipif(os.name != "posix", reason="needs a limit of a file's size")
@pytest.mark.parametrize("refuses", ["disk", "quota"])
def test_a_disk_without_room_for_a_checkpoint_is_told_before_training(
    refuses: str, toy: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    line = ["run", *SMALL, "--logger", "none", "--steps", "48", "--run-dir", tmp_path / "r"]
    with monkeypatch.context() as patch:
        patch.setattr(MTPPO, "_iterate", lambda learner: pytest.fail("it trained"))
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        if refuses == "disk":
            patch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=5000))
        else:
            resource.setrlimit(resource.RLIMIT_FSIZE, (8000, limits[1]))
        try:
            told = refused(capsys, *line).splitlines()[-1]
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert told.startswith("bidex-meta: Expected room for 2 files of ") and str(tmp_path / "r" / "checkpoints") in told
    assert not list((tmp_path / "r" / "checkpoints").iterdir())
    assert main([str(word) for word in line]) == 0, "the same command begins again"


@pytest.mark.parametrize("algo", ["mtppo", "mtsac"])
def test_the_room_that_is_held_takes_the_first_checkpoint(algo: str, toy: None, tmp_path: Path, monkeypatch) -> None:
    room, sizes, save = [], [], Recorder.save

    def watched(record: Recorder, state: dict[str, object], step: int) -> None:
        room.extend(path.stat().st_size for path in sorted((tmp_path / "r" / "checkpoints").glob(".room-*")))
        save(record, state, step)
        sizes.append((tmp_path / "r" / "checkpoints" / f"step_{step}.pt").stat().st_size)

    monkeypatch.setattr(Recorder, "save", watched)
    small = [word for word in SMALL if word not in ("--learner.rollout-steps", "4")]
    words = ["--algo", algo, "--steps", "48", "--run-dir", str(tmp_path / "r")]
    assert main(["run", *small, *words]) == 0
    assert len(room) == 2 and min(room) > sizes[0], "for step_<N>.pt and for last.pt"
    assert not list((tmp_path / "r" / "checkpoints").glob(".*"))


def test_a_deleted_run_folder_is_one_line(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    save = Recorder.save
    monkeypatch.setattr(Recorder, "save", lambda *a: (shutil.rmtree(run), save(*a)))
    # TensorBoard's thread would open its file again while the folder is emptied.
    told = refused(capsys, "run", "--resume", run, "--steps", "96", "--logger", "none").splitlines()[-1]
    assert told.startswith("bidex-meta: ") and "No such file" in told


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGUSR2, 140)])
def test_a_signal_before_training_is_one_line_and_leaves_nothing(
    number: int, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        os.kill(os.getpid(), number)
        time.sleep(60.0)

    monkeypatch.setattr(OwnSuite, "world", interrupted)
    assert main(["run", *SMALL, "--run-dir", str(tmp_path / "r")]) == code
    why = "interrupted" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
    assert capsys.readouterr().err.splitlines()[-1] == f"bidex-meta: {why}."
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("list suites >&-", 0),
        ("list >&-", 2),  # tyro, which parses, asks for the encoding of stdout
        ("run --print-config --suite MT4 2>&-", 0),
        ("nothing 2>&-", 2),
        ("list suites >/dev/full", 2),
        ("run --print-config --suite MT4 >/dev/full", 2),
        ("nothing 2>/dev/full", 2),
        ("list suites | true", 0),
        ("run --print-config --suite MT4 | true", 0),
        ("list suites 2>&1 | true", 141),
    ],
)
def test_output_that_nobody_takes_is_no_traceback(line: str, code: int, tmp_path: Path) -> None:
    # Shells differ in how they tell the first command's end of a pipe: it goes into a file.
    command, mark, rest = line.partition(" |")
    script = f"{{ {sys.executable} -m bidex_meta.cli {command}; echo $? > {tmp_path / 'code'}; }} {mark[1:]}{rest}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run(["sh", "-c", script], env=environment, capture_output=True, text=True)
    assert int((tmp_path / "code").read_text()) == code, done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    # On a busy machine a line of progress ("starting: 4 s so far") comes before the message.
    assert len([line for line in done.stderr.splitlines() if "so far" not in line]) <= 1


def test_a_terminal_that_is_gone_is_a_reader_that_has_ended() -> None:
    class Gone(StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, "Input/output error")

    progress = Progress(100, stream=Gone())
    progress.start()
    with pytest.raises(BrokenPipeError, match="Input/output"):
        progress.update({}, 50)
    progress.close()


def test_names_are_text(tmp_path: Path, capsys: pytest.CaptureFixture[str], toy: None) -> None:
    names = ["[/x]", "[red]", "a\x1b[2J"]
    for seed in (0, 1):
        config = run_config(seed=seed, steps=8, num_envs=4)
        folder = RunFolder.create(config, tmp_path / str(seed))
        classes = {name: {"success": 0.5, "return": 1.0, "score": None} for name in names}
        (folder.path / "evaluation.json").write_text(json.dumps({"policy": {"classes": classes}}))
    assert main(["compare", str(tmp_path / "0"), str(tmp_path / "1")]) == 0
    shown = capsys.readouterr().out
    assert "[/x]" in shown and "[red]" in shown and "\x1b" not in shown
