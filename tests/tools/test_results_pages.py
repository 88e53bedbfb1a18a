"""Pages made of results as data: what their blocks show, and that the repository's are as its data say."""

import json
import shutil
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from tests.fakes import change, evaluated_run, log
from tests.pages import ROOT
from tests.tools import test_collect
from tests.tools.test_collect import collect, evaluated
from tools.pages import __main__ as pages
from tools.pages.blocks import fill
from tools.pages.studies import read_studies

no_weights = test_collect.no_weights


def test_pages_of_the_repository_are_as_its_data_say() -> None:
    """Where this fails: make results."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs" / "results").glob("*.md"))]
    assert sum("<!-- results:" in page.read_text() for page in pages) >= 2
    assert not [str(path) for page in pages for path in fill(page, ROOT / "results" / "data", check=True)]


def test_every_file_of_data_is_read_and_small() -> None:
    files = sorted((ROOT / "results" / "data").rglob("*.json"))
    shown = {run.path for folder in {file.parent for file in files} for s in read_studies(folder.parent, folder.name) for run in s.runs}  # fmt: skip  # noqa: E501
    assert shown == set(files) and all(file.stat().st_size < 40_000 for file in files)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page of a study with two arms of two seeds."""
    runs = [evaluated(tmp_path, seed, 0.5 + seed / 10, f"MT4-base-seed{seed}", gamma=0.9) for seed in (0, 1)]
    runs += [evaluated(tmp_path, seed, 0.9, f"MT4-long | sight-seed{seed}", gamma=0.99) for seed in (0, 1)]
    random = {name: {"success": 0.0, "return": 0.125} for name in "AB"}
    for run in runs:
        found = json.loads((run / "evaluation.json").read_text())
        (run / "evaluation.json").write_text(json.dumps({**found, "random": {"classes": random}}))
    collect(*runs, into=tmp_path / "data" / "tiny")
    path = tmp_path / "page.md"
    path.write_text("# Page\n\n<!-- results: study=tiny -->\nold\n<!-- end -->\n\nafter\n")
    return path


def data(page: Path) -> Path:
    return page.parent / "data"


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.replace("\\|", "/").strip("|").split("|")]


def test_a_block_shows_what_compare_computes(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fill(page, data(page)) == [page]
    assert fill(page, data(page)) == [] == fill(page, data(page), check=True)
    text = page.read_text()
    assert text.startswith("# Page\n\n<!-- results: study=tiny -->") and text.endswith("<!-- end -->\n\nafter\n")
    assert "old" not in text
    head, _, *rows = [cells(line) for line in text.splitlines() if line.startswith("|")]
    rows = [dict(zip(head, row, strict=True)) for row in rows]
    assert [row["arm"] for row in rows] == ["long / sight", "base", "uniform actions"], "the best first"
    capsys.readouterr()
    assert main(["compare", *map(str, sorted(data(page).glob("tiny/*base*"))), "--json"]) == 0
    [known] = json.loads(capsys.readouterr().out)
    value, ends = known["success_iqm"]["value"], known["success_iqm"]["interval"]
    assert rows[1]["success, IQM"] == f"{100 * value:.1f} % [{100 * ends[0]:.1f}, {100 * ends[1]:.1f}]"
    assert (rows[1]["seeds"], rows[1]["steps"], rows[1]["parameters"]) == ("2", "1,000", "12,345")
    assert rows[1]["A"] == "5.5" and rows[1]["hours"] == f"{known['hours']:.2f}" and rows[2]["A"] == "0.125"


def test_a_check_fails_until_the_pages_are_filled(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(page.parent)
    (page.parent / "results").mkdir()
    (page.parent / "data").rename("results/data")
    for check, code in ((True, 1), (False, 0), (True, 0)):
        with pytest.raises(SystemExit) as stop:
            pages.main((page,), check)
        assert int(stop.value.code or 0) == code


def test_pictures_are_drawn_anew_where_the_data_changed(page: Path) -> None:
    page.write_text("".join(f"<!-- results: study=tiny show={s} -->\n<!-- end -->\n" for s in ("curves", "points", "classes")))  # fmt: skip  # noqa: E501
    written = fill(page, data(page))
    assert [path.name for path in written] == ["tiny-curves.png", "tiny-points.png", "page.md"]
    assert "![Return and success over training: tiny, MT4](tiny-curves.png)" in page.read_text()
    assert "55 % (50 to 60)" in page.read_text()
    assert fill(page, data(page), check=True) == []
    changed = sorted(data(page).glob("tiny/*"))[0]
    changed.write_text(changed.read_text().replace('"parameters": 12345', '"parameters": 12346'))
    assert fill(page, data(page), check=True) == written[:2]


def test_suites_of_the_same_classes_and_classes_alone_stand_beside_each_other(tmp_path: Path) -> None:
    whole = evaluated(tmp_path, 0, 0.5, "MT4-base-seed0")
    alone = [evaluated_run(tmp_path, 0, {name: 0.7}, "ppo", task=name) for name in "AB"]
    other = evaluated_run(tmp_path, 0, {"C": 0.7}, "ppo", task="C", gamma=0.3)
    for path in (*alone, other):
        log(path, {"step": 1000, "Perf/training_time": 7.0})
        shutil.copy(whole / "versions.json", path)
    collect(whole, into=tmp_path / "data" / "x")
    collect(*alone, arm="apart", into=tmp_path / "data" / "x")
    collect(other, arm="other", into=tmp_path / "data" / "x")
    studies = read_studies(tmp_path / "data", "x")
    assert [(study.on, [arm.group.label for arm in study.arms]) for study in studies] == [
        ("C", ["other"]),
        ("MT4", ["apart", "base"]),
    ]
    assert studies[1].arms[0].group.steps == 2000
    assert [study.on for study in read_studies(tmp_path / "data", "x", on="C")] == ["C"]


def test_rows_by_learners(tmp_path: Path) -> None:
    """The paper's Figure 6: a cell a number of rows, of each learner; a panel a learner."""
    for algo, rows, value in (("sac", 8, 0.9), ("sac", 64, 0.1), ("ppo", 64, 0.5)):
        for seed in (0, 1):
            path = evaluated_run(tmp_path, seed, {"C": value + seed / 10}, algo, task="place/C")
            path = path.rename(tmp_path / f"C-{algo} {rows}-seed{seed}")
            log(path, {"step": 500, "Train/return/C": 1.0}, {"step": 1000, "Train/return/C": 2.0})
            change(path, num_envs=rows)
            (path / "versions.json").write_text(json.dumps({"git": {"commit": test_collect.COMMIT, "dirty": False}}))
            collect(path, into=tmp_path / "data" / "many")
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- results: study=many show={s} -->\n<!-- end -->\n" for s in ("rows", "row-curves")))
    assert [path.name for path in fill(page, tmp_path / "data")] == ["many-row-curves.png", "page.md"]
    text = page.read_text()
    head, _, *rows = [cells(line) for line in text.splitlines() if line.startswith("|")]
    assert head == ["environments", "ppo", "sac"] and [row[0] for row in rows] == ["8", "64"]
    assert rows == [["8", "–", "9.5 (9 to 10)"], ["64", "5.5 (5 to 6)", "1.5 (1 to 2)"]]
    assert "Seeds: 2. Steps: 1,000." in text and "![Return over training, by number of environments: many, C]" in text
    assert fill(page, tmp_path / "data", check=True) == []
    page.write_text("<!-- results: study=many on=C show=row-curves -->\n<!-- end -->\n")
    assert [path.name for path in fill(page, tmp_path / "data")] == ["many-C-row-curves.png", "page.md"]


def test_the_best_run_of_each_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.pages.tables.load", lambda kind: {"C": {"success": 0.125}} if kind == "witness" else {})
    monkeypatch.setattr("tools.pages.tables.registry.names", lambda: ["D"])  # first, though its file is read last
    for name, arm, success, value in (("C", "ppo", 0.5, 9.0), ("C", "sac", 0.75, 2.0), ("D", "ppo", 0.0, 3.0)):
        path = evaluated_run(tmp_path, 0, {name: success}, arm, task=f"place/{name}")
        path = path.rename(tmp_path / f"{name}-{arm}-seed0")
        log(path, {"step": 1000, f"Train/return/{name}": 1.0, "Perf/training_time": 1800.0})
        row = {"success": success, "success_interval": [0.0, 1.0], "return": value, "score": None}
        (path / "evaluation.json").write_text(json.dumps({"steps": 1000, "policy": {"classes": {name: row}}}))
        (path / "versions.json").write_text(json.dumps({"git": {"commit": test_collect.COMMIT, "dirty": False}}))
        collect(path, into=tmp_path / "data" / "alone")
    page = tmp_path / "page.md"
    page.write_text("<!-- results: study=alone show=best -->\n<!-- end -->\n")
    fill(page, tmp_path / "data")
    _, _, *rows = [cells(line) for line in page.read_text().splitlines() if line.startswith("|")]
    assert rows == [
        ["D", "ppo", "0", "1,000", "0.50", "0 % [0, 100]", "3", "–", "–", "–", "–", "1"],
        ["C", "sac", "0", "1,000", "0.50", "75 % [0, 100]", "2", "–", "–", "12.5 %", "–", "2"],
    ]
    (tmp_path / "data" / "alone" / "C-ppo-seed0.json").unlink()
    (tmp_path / "data" / "alone" / "C-sac-seed0.json").unlink()
    fill(page, tmp_path / "data")
    _, _, *rows = [cells(line) for line in page.read_text().splitlines() if line.startswith("|")]
    assert rows == [["D", "0 % [0, 100]", "3", "–", "–", "–", "–"]]


def test_references_are_a_table_without_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        "random": {"Switch": {"return": 8696.25, "success": 0.005}},
        "expert": {"Switch": {"return": 9.0, "source": "x"}},
    }
    monkeypatch.setattr("tools.pages.tables.load", lambda kind: known.get(kind, {}))
    page = tmp_path / "page.md"
    page.write_text("<!-- results: show=references -->\n<!-- end -->\n")
    assert fill(page, tmp_path) == [page]
    rows = [cells(line) for line in page.read_text().splitlines() if line.startswith("| ")]
    assert len(rows) == 21 and ["Switch", "8696", "0.5 %", "–", "–", "–", "–", "–", "–", "9", "x"] in rows


def test_gains_of_meta_tests(tmp_path: Path) -> None:
    """A run's own interval, bold where it excludes zero; over the control of the same seed, errors added as squares."""

    def made(arm: str, seed: int, gain: float, half: float) -> Path:
        path = evaluated(tmp_path, seed, 0.0, f"MT4-{arm}-seed{seed}")
        rows = {when: {"success": s, "return": 8 * s, "score": None} for when, s in (("before", 0.25), ("after", 0.5))}
        one = {"return": {"value": gain, "interval": [gain - half, gain + half]}}
        part = {when: {"classes": {"A": row, "B": row}} for when, row in rows.items()}
        part |= {"shots": 2, "rollouts": 40, "gain": {"classes": {"A": one}, "aggregate": one}}
        (path / "evaluation.json").write_text(json.dumps({"steps": 1000, "splits": {"test": part}}))
        return path

    runs = [made("promp", 0, 3.0, 0.3), made("promp", 1, 0.1, 0.5), made("control", 0, 1.0, 0.4)]
    collect(*runs, into=tmp_path / "data" / "meta")
    page = tmp_path / "page.md"
    page.write_text("<!-- results: study=meta show=gains -->\n<!-- end -->\n")
    fill(page, tmp_path / "data")
    _, _, *rows = [cells(line) for line in page.read_text().splitlines() if line.startswith("|")]
    shown = ["1,000", "2 × 40", "25 → 50 %", "2 → 4"]
    assert rows == [
        ["A", "promp", "0", *shown, "**+3** [+2.7, +3.3]", "**+2** [+1.5, +2.5]"],
        ["A", "promp", "1", *shown, "+0.1 [-0.4, +0.6]", ""],
        ["A", "control", "0", *shown, "**+1** [+0.6, +1.4]", ""],
    ]
    page.write_text("<!-- results: study=meta show=gains split=train -->\n<!-- end -->\n")
    with pytest.raises(BidexError, match="has no meta-test of train tasks"):
        fill(page, tmp_path / "data")


def test_an_arm_of_two_kinds_is_refused(page: Path, tmp_path: Path) -> None:
    third = evaluated(tmp_path, 2, 0.5, "MT4-base-seed2", gamma=0.7)
    collect(third, into=data(page) / "tiny")
    with pytest.raises(BidexError, match=r"both of the arm 'base', but learner.gamma is 0.7 and 0.9"):
        fill(page, data(page))


def test_bad_blocks_are_one_line(page: Path) -> None:
    for words, told in (
        ("show=table", "name of a study"),
        ("study=tiny show=tabel", "tabel"),
        ("study=tiny colour=red", "colour"),
        ("study", "cannot make the block"),
    ):
        page.write_text(f"<!-- results: {words} -->\n<!-- end -->\n")
        with pytest.raises(BidexError, match=told):
            fill(page, data(page))
    page.write_text("<!-- results: study=tiny -->\n")
    with pytest.raises(BidexError, match="ends with"):
        fill(page, data(page))
    page.write_text("<!-- results: study=none -->\n<!-- end -->\n")
    fill(page, data(page))
    assert "No runs yet." in page.read_text()
