"""Damaged and foreign files, drawn by hypothesis: each is told in one line, or read as it was; no line is lost."""

import json
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.agreement import agreements
from bidex_meta.evaluation.references import load_from
from bidex_meta.experiments.verifying import others, recorded_conditions, recorded_evaluation
from bidex_meta.runs import Checkpoints, RunFolder, mend
from bidex_meta.runs.evaluations import Conditions, parse_evaluation, read_evaluation
from bidex_meta.runs.versions import Versions, read_versions
from bidex_meta.utils.paths import assets_dir, suites_dir
from bidex_meta.witness.store import load_witness
from tests.fakes import run_config, trained_run
from tests.robust.damage import draws, listing, of_files, of_values, one_line_or, put, remove
from tests.robust.lines import called, working_folder

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pipes and links")
ROW = {"success": 0.5, "success_interval": [0.1, 0.9], "return": 1.0, "return_interval": None, "score": 3.0}
PART = {"episodes_per_task": 2, "classes": {"A": ROW | {"tasks": 2, "length": 3.0}, "B": ROW}}
MADE = {"steps": 8, "seed": 3, "conditions": {"device": "cpu", "packages": {"mujoco": "4.0.0"}, "physics": None}}
ADAPTED = {"shots": 1, "rollouts": 2, "trials": 1}
META = MADE | {"splits": {"test": ADAPTED | {"before": PART, "after": PART, "by_shot": [PART, PART]}}}


def test_configs_of_a_run_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = working_folder(tmp_path, monkeypatch)
    path = place / "run" / "config.json"
    whole = path.read_bytes()

    def check(drawn: Any) -> None:
        put(path, drawn, whole)
        before = listing(place)
        for words in ("run --resume run --print-config", "evaluate run", "compare run", "plot run"):
            done = called(words.split())
            assert done.code in (0, 2, "built"), (words, done)
            assert done.code != 2 or len(done.err.strip().splitlines()) == 1, done
        assert listing(place) == before

    try:
        draws(100, of_files(of_values()), check)
    finally:
        remove(path)
        path.write_bytes(whole)


@pytest.mark.parametrize("content", [META, MADE | {"policy": PART}], ids=["meta-test", "policy"])
def test_evaluations(content: dict[str, Any], tmp_path: Path) -> None:
    path, whole = tmp_path / "evaluation.json", json.dumps(content).encode()

    def check(drawn: Any) -> None:
        put(path, drawn, whole)
        found = one_line_or(lambda: read_evaluation(path, "again"))
        if found is not None:  # then all that is read of it has its type
            for row in found.results.values():
                assert all(type(value) is float for value in (row.success, row.mean_return))
                assert row.score is None or type(row.score) is float
        found = one_line_or(lambda: recorded_evaluation(tmp_path, path))
        if found is not None:  # and what verify makes of it
            now = Conditions(packages={"mujoco": "4.1.0"}, device="cpu", engine="c", threads=1, physics="x")
            others(recorded_conditions(found, Versions(), run_config()), now)
            again = parse_evaluation(content, "again").all_results
            again = {name: msgspec.structs.replace(row, tasks=2, episodes=4) for name, row in again.items()}
            one_line_or(lambda: agreements(found.all_results, again))

    draws(150, of_files(of_values()), check)


def test_versions_and_references(tmp_path: Path) -> None:
    sources = {"versions.json": (trained_run("mtppo") / "versions.json").read_bytes()}
    sources["random.json"] = (assets_dir() / "references" / "random.json").read_bytes()
    readers = {"versions.json": lambda path: read_versions(path.parent), "random.json": load_from}

    def check(drawn: Any) -> None:
        for name, whole in sources.items():
            put(path := tmp_path / name, drawn, whole)
            found = one_line_or(partial(readers[name], path))
            assert found is None or path.is_file() or drawn == "gone"

    draws(150, of_files(of_values()), check)


def test_no_good_line_of_metrics_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    lines = [json.dumps({"step": 10 * i, "time": 1.0, "Perf/training_time": 0.5 * i}).encode() for i in range(1, 9)]

    def check(drawn: Any) -> None:
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()
        put(path, drawn, b"\n".join(lines) + b"\n")
        present = [] if isinstance(drawn, str) else path.read_bytes().split(b"\n")
        good = [line for line in lines if line in present]
        rows = mend(path, 80)
        steps = [row["step"] for row in rows]
        assert set(steps) >= {json.loads(line)["step"] for line in good}
        if path.exists():
            assert set(path.read_bytes().split(b"\n")) >= set(good)

    draws(300, of_files(), check)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(_same, a, b))
    return a == b


def test_a_damaged_checkpoint_is_refused_or_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoints = Checkpoints(tmp_path)
    state = {"w": torch.arange(300.0), "b": [torch.tensor(True), 3, "x"], "o": {"lr": 0.1, 0: (None, 2)}}
    checkpoints.save(state, 7)
    path, whole = tmp_path / "step_7.pt", (tmp_path / "step_7.pt").read_bytes()
    checkpoints.last.unlink()
    refused = 0

    def check(drawn: Any) -> None:
        nonlocal refused
        put(path, drawn, whole)
        found = one_line_or(checkpoints.load)
        assert found is None or (found[1] == 7 and _same(found[0], state))
        refused += found is None
        assert capsys.readouterr().err.count("\n") <= 1

    draws(500, of_files(), check)
    assert refused > 200


def test_a_checkpoint_without_digest_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"step": 7, "state": {"w": torch.arange(3.0)}}, tmp_path / "step_7.pt")
    with pytest.raises(BidexError, match="None of the 1 checkpoints"):
        Checkpoints(tmp_path).load()
    assert "its format is None, not 2" in capsys.readouterr().err


def test_suites(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    whole = (suites_dir() / "ML4.toml").read_bytes()
    words = [*b'1e308 -1 nan inf "\\u001b[2J" "[/x]" "" [] {} true x'.split(), b"9" * 400]

    def change(which: float, word: bytes) -> bytes:
        lines = whole.split(b"\n")
        places = [i for i, line in enumerate(lines) if b"=" in line]
        place = places[int(which * len(places))]
        lines[place] = lines[place].split(b"=")[0] + b"= " + word
        return b"\n".join(lines)

    values = st.builds(
        lambda w, v: ("value", lambda _: change(w, v)), st.floats(0, 1, exclude_max=True), st.sampled_from(words)
    )

    def check(drawn: Any) -> None:
        put(path, drawn, whole)
        found = one_line_or(lambda: Benchmark(path))
        if found is not None:
            assert all(np.isfinite(task.variation).all() for task in found.train_tasks + found.test_tasks)

    draws(300, of_files(values), check)


def test_witnesses(tmp_path: Path) -> None:
    path, whole = tmp_path / "w.npz", (assets_dir() / "witnesses" / "HandOver.npz").read_bytes()
    good = load_witness("HandOver")

    def check(drawn: Any) -> None:
        put(path, drawn, whole)
        found = one_line_or(lambda: load_witness("HandOver", path))
        # The archive's checksums protect its content.
        assert found is None or (found.made == good.made and np.array_equal(found.actions, good.actions))

    draws(150, of_files(), check)


def test_links_in_a_run_folder_lead_nowhere(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    for name in (".a.tmp", "step_1.pt", "step_2.pt", "step_3.pt", "step_4.pt"):
        (outside / name).write_text("precious")
    run = Path(shutil.copytree(trained_run("mtppo"), tmp_path / "run"))
    shutil.rmtree(run / "checkpoints")
    (run / "checkpoints").symlink_to(outside)
    before = listing(outside)
    for action in (RunFolder(run).check_own, lambda: RunFolder(run).checkpoints.save({}, 9)):
        with pytest.raises(BidexError, match="is a link"):
            action()
    assert listing(outside) == before
