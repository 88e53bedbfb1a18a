"""``make gpu-quarter``: its steps by themselves, and a dry run on the CPU."""

import json
from pathlib import Path

import pytest

from bidex_meta.errors import BidexError
from tests.tools.test_results_pages import cells
from tools.bench import quarter as module
from tools.bench.__main__ import main
from tools.bench.quarter import TRAININGS, quarter
from tools.bench.switches import SWITCHES
from tools.pages import gpu as page


def script(name: str, code: str, limit: float = 60.0) -> module._Step:
    return module._Step(name, ["-c", code], limit)


def test_a_second_start_repeats_only_what_did_not_end_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [
        script("good", "open('good', 'a').write('x'); print('all well')"),
        script("bad", "import os; open('bad', 'a').write('x'); raise SystemExit(len(open('bad').read()) < 2)"),
        script("slow", "import time; time.sleep(60)", limit=1.0),
    ]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "_LEAST", 0.5)
    monkeypatch.setattr(module, "_steps", lambda *_: iter(steps))
    first = quarter(out=tmp_path / "out", minutes=1.0)["steps"]
    assert {name: step["state"] for name, step in first.items()} == {"good": "done", "bad": "failed", "slow": "cut"}
    assert first["good"]["last"] == "all well" and first["slow"]["seconds"] < 30.0
    second = quarter(out=tmp_path / "out", minutes=1.0)["steps"]
    assert {name: step["state"] for name, step in second.items()} == {"good": "done", "bad": "done", "slow": "cut"}
    assert (tmp_path / "good").read_text() == "x" and second["good"] == first["good"]
    assert json.loads((tmp_path / "out" / "quarter.json").read_text())["steps"] == second
    with pytest.raises(BidexError, match=r"of the settings .*MT4-v2.*, got .*MT20-v2.*Name another --out"):
        quarter(out=tmp_path / "out", suite="MT4-v2", minutes=1.0)
    with monkeypatch.context() as patch:
        patch.setattr(module, "collect_versions", lambda: {"git": {"commit": "0" * 40, "dirty": False}})
        with pytest.raises(BidexError, match="of the code"):
            quarter(out=tmp_path / "out", minutes=1.0)
    late = quarter(out=tmp_path / "late", minutes=0.0)
    assert late["steps"] == {}


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_dry_run_on_the_cpu_fills_every_table(tmp_path: Path) -> None:
    out = tmp_path / "out"
    flags = "--device cpu --suite MT1-v2 --sizes 4 8 --num-envs 32 --seconds 1 --rest 1 --minutes 45 --slack 6"
    main(["quarter", "--out", str(out), *flags.split(), "--json"])
    found = json.loads((out / "quarter.json").read_text())
    states = {name: (step["state"], step["last"]) for name, step in found["steps"].items()}
    assert {state for state, _ in states.values()} == {"done"}, states
    assert list(found["switches"]["rows"]) == ["4", "8"]
    for row in found["switches"]["rows"].values():
        assert list(row) == list(SWITCHES) and row["deterministic"]["repeats"]
    assert list(found["training"]) == [*TRAININGS, "rest"]
    for name, run in found["training"].items():
        assert run["steps"] > 0 and list((out / name / "checkpoints").glob("*.pt")), name
    (tmp_path / "gpu-quarter.json").write_bytes((out / "quarter.json").read_bytes())
    lengths = {"switches": 2 * len(SWITCHES), "pictures": 4, "training": len(found["training"])}
    for show, length in lengths.items():
        head, _, *rows = map(cells, page.gpu_table(show, tmp_path / "data"))
        assert len(rows) == length and all(len(row) == len(head) for row in rows), show


def test_tables_have_a_place_before_they_are_measured(tmp_path: Path) -> None:
    head, _, row = map(cells, page.gpu_table("switches", tmp_path))
    assert len(row) == len(head) and set(row) == {"not measured yet", ""}
