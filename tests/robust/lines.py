"""Command lines in this process, in a folder with a few things in it, where no world can be built."""

import contextlib
import io
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from bidex_meta.cli import main
from bidex_meta.metaworld import batched
from bidex_meta.world import world as world_module
from tests.fakes import trained_run


class Built(BaseException):
    """A world was asked for: nothing was wrong with the command line, as far as can be told before."""


def working_folder(folder: Path, patch: pytest.MonkeyPatch) -> Path:
    """Fills a folder and goes there; until the patch ends no command builds a world, draws or takes long."""
    (folder / "loop.toml").symlink_to("loop.toml")
    (folder / "folder.toml").mkdir()
    (folder / "empty.toml").touch()
    (folder / "empty").mkdir()
    (folder / "torn" / "checkpoints").mkdir(parents=True)
    (folder / "torn" / "metrics.jsonl").touch()
    for name, run in (("run", "mtppo"), ("meta", "promp")):
        shutil.copytree(trained_run(run), folder / name)

    def built(*_: object, **__: object) -> None:
        raise Built

    patch.chdir(folder)
    patch.setattr(world_module.World, "__init__", built)
    patch.setattr(batched.MetaWorldWorld, "__init__", built)
    for what in ("draw_learning", "draw_adaptation"):  # drawing takes a second
        patch.setattr(f"bidex_meta.runs.plots.{what}", built)
    return folder


def own_time() -> float:
    """Seconds of the clock, without those in which this process was ready and others had its core.

    A hang shows whether it computes or waits; a busy machine does not. Where Linux tells no such time, all counts.
    """
    told = Path("/proc/self/schedstat")
    waited = int(told.read_text().split()[1]) / 1e9 if told.exists() else 0.0
    return time.monotonic() - waited


def called(arguments: list[str]) -> SimpleNamespace:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: object = main(arguments)
        except SystemExit as stop:
            code = stop.code
        except Built:
            code = "built"
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())
