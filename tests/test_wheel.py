"""The wheel, built, installed alone, and used beside folders that bear the names of our rooms."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]

CODE = """
import sys
from pathlib import Path

import bidex_meta
import bidex_algos
from bidex_meta import Benchmark
from bidex_meta.cli import demo, main
from bidex_meta.utils import paths

benchmark = Benchmark("ML4", seed=0)
assert list(benchmark.test_classes) == ["TwoCatchUnderarm"] and len(benchmark.train_tasks) == 150
world = benchmark.make_world("test", num_envs=2, device="cpu", threads=1)
obs, _ = world.reset(seed=0)
assert obs.shape == (2, 446)
demo.FILM = ["--tiled", "--steps", "1", "--every", "1", "--width", "32"]
assert main(["demo"]) == 0
print(bidex_meta.__file__, bidex_algos.__path__[0], paths.suites_dir(), paths.assets_dir(), *sys.path, sep="\\n")
"""


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # The wheel is built from the source distribution, as for a package index, because each file must survive both
    # steps.
    folder = tmp_path_factory.mktemp("dist")
    run("-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


def files_of(room: str) -> set[str]:
    files = (path.relative_to(ROOT) for path in (ROOT / room).rglob("*") if path.is_file())
    return {file.as_posix() for file in files if "__pycache__" not in file.parts and file.name != ".DS_Store"}


def test_every_file_is_in_the_wheel_once(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    packed = {name for name in names if ".dist-info/" not in name}
    expected = {f"bidex_meta/{name}" for room in ("suites", "assets") for name in files_of(room)}
    expected |= files_of("bidex_meta")
    expected |= {name.removeprefix("algos/") for name in files_of("algos/bidex_algos")}
    assert packed == expected
    assert {"bidex_meta/py.typed", "bidex_algos/py.typed"} <= packed
    assert wheel.stat().st_size < 40e6
    assert len(names) == len(set(names))
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_nothing_ignored_lies_in_the_rooms_of_data() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    command = ["git", "ls-files", "--others", "--ignored", "--exclude-standard", "suites", "assets"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout == ""


def test_installed_wheel_runs_beside_decoys(wheel: Path, tmp_path: Path) -> None:
    target, folder = tmp_path / "target", tmp_path / "work"
    run("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", target, wheel, cwd=tmp_path)
    for decoy in ("algos", "suites", "assets"):
        (folder / decoy).mkdir(parents=True)
        (folder / decoy / "__init__.py").write_text("raise ImportError('the decoy was imported')")
    (folder / "suites" / "ML4.toml").write_text("name = 'decoy'")
    (folder / "main.py").write_text(CODE)
    # -S leaves out the path files of site-packages, and with them an editable install of this checkout.
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    path = os.pathsep.join([str(target), *sorted(libraries)])
    environment = {"PYTHONPATH": path, "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    film, *lines = run("-S", "main.py", cwd=folder, **environment).splitlines()
    assert Path(film) == (folder / "bidex-meta-demo.webp").resolve() and Image.open(film).n_frames == 2
    where, sys_path = [Path(line).resolve() for line in lines[:4]], [Path(line).resolve() for line in lines[4:]]
    package = (target / "bidex_meta").resolve()
    expected = [package / "__init__.py", target / "bidex_algos", package / "suites", package / "assets"]
    assert where == [path.resolve() for path in expected]
    assert not {ROOT, ROOT / "algos"} & set(sys_path)
    assert (target / "bin" / "bidex-meta").is_file() or (target / "Scripts" / "bidex-meta.exe").is_file()


def test_the_container_is_built_from_what_the_wheel_is_built_from() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    dockerfile = (ROOT / "Dockerfile").read_text()
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    packed = {path.split("/")[0] for path in project["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]}
    assert sent == {*packed, "pyproject.toml", "constraints.txt", "README.md", *project["project"]["license-files"]}
    (extras,) = re.findall(r"^ARG EXTRAS=(.*)$", dockerfile, re.MULTILINE)
    assert set(extras.split(",")) <= project["project"]["optional-dependencies"].keys()
    (command,) = re.findall(r'^ENTRYPOINT \["(.*)"\]$', dockerfile, re.MULTILINE)
    assert command in project["project"]["scripts"]
    (base,) = re.findall(r"^ARG BASE=(.*)$", dockerfile, re.MULTILINE)
    assert re.fullmatch(r"debian:bookworm-slim@sha256:[0-9a-f]{64}", base)
    users = re.findall(r"^USER (.*)$", dockerfile, re.MULTILINE)
    assert users and users[-1] not in ("0", "root")
