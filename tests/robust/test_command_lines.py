"""Odd command lines, drawn by hypothesis: exit code 0, or one line and 2 before a world is built; nothing is left."""

import os
from pathlib import Path

import pytest
from hypothesis import strategies as st

from tests.robust.damage import draws, listing
from tests.robust.lines import called, own_time, working_folder

VALUES = (
    "", "0", "1", "2", "-1", "1.5", "1e9", "-1e9", "nan", "inf", "-inf", "9" * 30, "9" * 5000, "1e400", "0x10",
    "None", "true", "[/x]", "\x1b[31mred", "\udc80", "näme", "x" * 256, "x" * 5000, "/", "..", ".", "~",
    "~nobody/x.toml", "/dev/null", "/dev/zero", "/proc/self/mem", "no/such/folder/x", "-", "--", "=", "MT4", "mt20",
    "ML4", "MT5", "metaworld/MT3", "HandOver", "handover", "mtppo", "rl2", "os:system", "nowhere.x:Y", ":", "auto",
    "cpu", "cuda:7", "c", "warp", "paper", "laptop", "random", "zero", "train", "test", "last", "best", "front",
    "suites", "expert", "world", "gpu", "loop.toml", "folder.toml", "empty.toml", "x.png", "x.mp4", "x.json",
    "a/b.png", "run", "meta", "torn", "empty",
)  # fmt: skip
FLAGS = {
    "run": "suite task base algo preset num-envs steps minutes seed device engine threads start-from run-dir resume "
    "episodes evaluate-every video-every logger learner.hidden learner.gamma learner.std-range learner.rollout-steps "
    "learner.learning-rate learner.clip learner.activation learner.num-minibatches learner.replay-memory",
    "evaluate": "checkpoint episodes split shots rollouts tasks trials seed num-envs device engine",
    "verify": "evaluation num-envs device engine",
    "control": "trials episodes shots rollouts num-envs seed device engine",
    "compare": "out json",
    "plot": "evaluation out",
    "report": "out",
    "render": "task out policy checkpoint suite seed steps every width height camera",
    "demo": "out",
    "witness": "task file out camera threads",
    "baseline": "suite episodes seed threads runs out",
    "list": "",
    "completion": "",
    "bench": "suite num-envs steps repeats threads device engine seed",
}
SWITCHES = {
    "run": ["--print-config", "--no-evaluate"],
    "evaluate": ["--random", "--json", "--hidden-rewards"],
    "verify": ["--json"],
    "plot": ["--adaptation"],
    "render": ["--tiled"],
    "witness": ["--all", "--json"],
    "bench": ["--json"],
}
NAMED = ("list", "bench", "baseline")
"""Commands whose first word is no run folder."""
PLACED = dict.fromkeys((*NAMED, "evaluate", "verify", "control", "plot", "report"), 1) | {"compare": 2}
"""Words before the flags."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory):
    with pytest.MonkeyPatch.context() as patch:
        yield working_folder(tmp_path_factory.mktemp("fuzz"), patch)


def lines(command: str) -> st.SearchStrategy[list[str]]:
    value = st.sampled_from(VALUES)
    flags = [f"--{name}" for name in FLAGS[command].split()]
    parts = [st.builds(lambda text: [text], value)]
    if flags:
        flag = st.sampled_from(flags)
        parts += [st.tuples(flag, value).map(list), st.tuples(flag, value).map(lambda pair: ["=".join(pair)])] * 2
    if command in SWITCHES:
        parts.append(st.sampled_from(SWITCHES[command]).map(lambda word: [word]))
    odd = st.lists(st.one_of(parts), max_size=4).map(lambda chosen: [word for part in chosen for word in part])
    place = (
        st.one_of(st.sampled_from(("run", "meta")), value) if PLACED.get(command) and command not in NAMED else value
    )
    first = st.lists(place, min_size=PLACED.get(command, 0), max_size=PLACED.get(command, 0))
    base = ["--print-config", "--suite", "MT4", "--device", "cpu"] if command == "run" else []
    return st.tuples(first, odd).map(lambda words: [command, *words[0], *base, *words[1]])


def judge(arguments: list[str], place: Path) -> None:
    before, began = listing(place), own_time()
    done = called(arguments)
    told = done.err.strip().splitlines()
    assert own_time() - began < 20.0, arguments
    assert done.code in (0, None, 2, "built"), (arguments, done)
    assert "Traceback" not in done.err
    if done.code == 2:
        assert told and told[-1].startswith("bidex-meta: "), (arguments, done)
        assert len(told) == 1 and len(told[0]) < 3000, (arguments, told)
        assert "\x1b" not in done.err
        assert listing(place) == before, arguments


@pytest.mark.skipif(os.name != "posix", reason="needs links")
@pytest.mark.parametrize(
    "line",
    [
        "run --suite MT4 --device cpu --start-from loop.toml",
        "run --suite loop.toml",
        "run --task CatchUnderarm --object loop.xml",
        "run --suite MT4 --device cpu --run-dir r\udcff",
        "record random --suite MT4 --out loop.toml",
        "record random --suite MT4 --out r\udcff",
        "render --task HandOver --out loop.toml/x.png",
        "evaluate r\udcff",
    ],
)
def test_paths_that_lead_nowhere_or_are_no_text(line: str, place: Path) -> None:
    (place / "loop.xml").symlink_to("loop.xml")
    try:
        judge(line.split(), place)
        assert called(line.split()).code == 2
    finally:
        (place / "loop.xml").unlink()


# Lines per command, 1,000 in all. Parsing a line of ``run`` takes 60 ms.
COUNTS = {
    "run": 120, "evaluate": 130, "control": 100, "compare": 100, "plot": 100, "report": 60, "render": 120,
    "witness": 120, "baseline": 60, "list": 30, "completion": 10, "bench": 50,
}  # fmt: skip


@pytest.mark.skipif(os.name != "posix", reason="needs pipes and links")
@pytest.mark.parametrize("times", [1, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("command", COUNTS)
def test_odd_command_lines(command: str, times: int, place: Path) -> None:
    judge([command, ""], place)
    draws(times * COUNTS[command], lines(command), lambda arguments: judge(arguments, place))
