"""Pages made of results as data: what their blocks show, and that the repository's are as its data say."""

import json
from pathlib import Path

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.worlds import open_worlds
from tests.pages import ROOT
from tests.tools import test_collect
from tests.tools.test_collect import collect, evaluated
from tools.pages.blocks import fill, filled_pages
from tools.pages.studies import bars_figure, read_studies
from tools.pages.tables import arms_table, best_table, classes_table, mean_and_range
from tools.pages.validity import read_validity, validity_table

no_weights = test_collect.no_weights


def test_pages_of_the_repository_are_as_its_data_say() -> None:
    """Where this fails: make results."""
    pages = filled_pages(ROOT)
    assert sum("<!-- results:" in page.read_text() for page in pages) >= 2
    assert not [str(path) for page in pages for path in fill(page, ROOT / "results" / "data", check=True)]


@pytest.mark.parametrize(("study", "replayed", "scripted"), [("mt20-gpu", True, True), ("ladder-rung1", False, True)])
def test_references_beside_results_are_of_their_version(study: str, replayed: bool, scripted: bool) -> None:
    head, _, *rows = best_table(read_studies(ROOT / "results" / "data", study))
    assert ("open-loop replay: success" in head) == replayed and ("scripted policy: success" in head) == scripted
    assert rows


def test_every_policy_of_the_repository_stands_on_the_page_of_pretrained_policies(tmp_path: Path) -> None:
    folders = {path.parents[1] for room in ("assets", "results") for path in (ROOT / room).rglob("checkpoints/*.pt")}
    page = tmp_path / "page.md"
    blocks = [f"<!-- results: show=pretrained on={on} -->\n<!-- end -->" for on in ("policies", "teachers")]
    page.write_text("\n".join(blocks))
    fill(page, ROOT / "results" / "data")
    rows = [cells(line) for line in page.read_text().splitlines() if line.startswith("|") and "bidex-meta" in line]
    commands = [row[-1].strip("`") for row in rows]
    assert sorted(commands) == sorted(
        f"bidex-meta play {folder.relative_to(ROOT)}".replace(" assets/policies/MT20-v2", "") for folder in folders
    )
    stored = json.loads((ROOT / "assets" / "policies" / "MT20-v2" / "evaluation.json").read_text())
    assert percent(rows[0][4]) == pytest.approx(
        stored["other_tasks"]["policy"]["aggregate"]["success"]["mean"], abs=6e-4
    )
    assert {row[4] for row in rows if "ML20-mtppo" in row[-1]} == {"not stored"}


def test_every_run_of_the_data_is_read_and_small() -> None:
    data = ROOT / "results" / "data"
    for name in [file.stem for file in data.iterdir()]:
        runs = [run for study in read_studies(data, name) for run in study.runs]
        file = data / f"{name}.json"
        assert {run.path for run in runs} == {Path(f"{file}:{known}") for known in json.loads(file.read_text())}
        assert file.stat().st_size < 50_000 * len(runs)


def test_success_on_other_tasks_stands_beside_that_on_its_own() -> None:
    (study,) = read_studies(ROOT / "results" / "data", "mt20-dagger")
    found = [run.evaluation() for run in study.runs]
    of_others = [each.other_tasks.policy.classes for each in found]
    head, _, *rows = map(cells, classes_table(study))
    assert head == ["class", "success", "other tasks", "return", "score"] and rows[-1][0] == "mean"
    (row,) = [row for row in rows if row[0] == "HandOver"]
    assert percent(row[2]) == pytest.approx(np.mean([each["HandOver"].success for each in of_others]), abs=6e-4)
    mean = pytest.approx(np.mean([row.success for each in of_others for row in each.values()]), abs=6e-4)
    head, _, arm, *_ = map(cells, arms_table(study))
    assert percent(arm[head.index("other tasks, mean")]) == percent(rows[-1][2]) == mean


def test_arms_are_in_the_order_of_the_success_that_the_table_shows() -> None:
    (study,) = read_studies(ROOT / "results" / "data", "one-policy-v2")
    head, _, *rows = map(cells, arms_table(study))
    success = [percent(row[head.index("success, mean")]) for row in rows if row[0] != "uniform actions"]
    assert success == sorted(success, reverse=True) and len(success) == 7


def test_a_mean_over_fewer_classes_says_how_many(tmp_path: Path) -> None:
    shares = {"hidden": [], "blind": 0.25, "chance": 0.02, "named": 0.1, "explained": 0.0}
    known = {**shares, "solved": 0.5, "alignment": {"rank": 0.75, "solved": 2.0, "unsolved": 1.0}}
    (tmp_path / "validity").mkdir()
    rows = {"A": known, "B": {**shares, "blind": 0.75, "alignment": None}}
    (tmp_path / "validity" / "S.json").write_text(json.dumps({"classes": rows}))
    head, _, *_, mean = map(cells, validity_table("S", tmp_path / "data"))
    found = dict(zip(head, mean, strict=True))
    assert (found["blind at best"], found["named by its start"], found["zero"]) == ("50.0 %", "10.0 %", "")
    assert (found["knowing the task"], found["rank"]) == ("50.0 % (1 of 2)", "0.75 (1 of 2)")


def test_teachers_stand_with_what_noise_costs_them(tmp_path: Path) -> None:
    (tmp_path / "validity").mkdir()
    row = {"teacher": "scripts", "own": 0.94, "unseen": 0.88, "noise": 0.6}
    (tmp_path / "validity" / "teachers.json").write_text(json.dumps({"classes": {"PourWater": row}}))
    (page := tmp_path / "page.md").write_text("<!-- results: show=teachers -->\n<!-- end -->")
    fill(page, tmp_path / "data")
    *_, found = [cells(line) for line in page.read_text().splitlines() if line.startswith("|")]
    assert found == ["PourWater", "scripts", "94 %", "88 %", "60 %", "34 points"]


def test_the_repository_has_a_teacher_of_every_class() -> None:
    rows = read_validity(ROOT / "results", "teachers")
    assert rows.keys() == open_worlds({"suite": "MT20-v2"}).task_classes().keys()
    assert all(row["own"] >= 0.8 and row["unseen"] >= 0.8 for row in rows.values())


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page of a study with two arms of two seeds."""
    runs = [evaluated(tmp_path, seed, 0.5 + seed / 10, f"MT4-base-seed{seed}", gamma=0.9) for seed in (0, 1)]
    runs += [evaluated(tmp_path, seed, 0.9, f"MT4-long | sight-seed{seed}", gamma=0.99) for seed in (0, 1)]
    random = {name: {"success": 0.0, "return": 0.125} for name in "AB"}
    for run in runs:
        found = json.loads((run / "evaluation.json").read_text())
        (run / "evaluation.json").write_text(json.dumps({**found, "random": {"classes": random}}))
    collect(*runs, into=tmp_path / "data" / "tiny.json")
    path = tmp_path / "page.md"
    path.write_text("# Page\n\n<!-- results: study=tiny -->\nold\n<!-- end -->\n\nafter\n")
    return path


def data(page: Path) -> Path:
    return page.parent / "data"


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.replace("\\|", "/").strip("|").split("|")]


def percent(cell: str) -> float:
    return float(cell.split()[0]) / 100


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
    assert main(["compare", *(f"{data(page)}/tiny.json:MT4-base-seed{seed}" for seed in (0, 1)), "--json"]) == 0
    [known] = json.loads(capsys.readouterr().out)
    value, ends = known["success_iqm"]["value"], known["success_iqm"]["interval"]
    assert rows[1]["success, IQM"] == f"{100 * value:.1f} % [{100 * ends[0]:.1f}, {100 * ends[1]:.1f}]"
    assert (rows[1]["seeds"], rows[1]["steps"], rows[1]["parameters"]) == ("2", "1,000", "12,345")
    assert rows[1]["A"] == "5.5" and rows[1]["hours"] == f"{known['hours']:.2f}" and rows[2]["A"] == "0.125"


def test_bars_are_as_long_as_each_arm_succeeds_and_lines_span_its_seeds(page: Path) -> None:
    (study,) = read_studies(data(page), "tiny")
    (axis,) = bars_figure(study).axes
    widths = [[bar.get_width() for bar in bars] for bars in axis.containers]
    assert widths == [pytest.approx([90.0, 25.0]), pytest.approx([55.0, 25.0])]
    ends = [tuple(line.get_xdata()) for line in axis.lines]
    assert ends == [pytest.approx(each) for each in [(90.0, 90.0), (25.0, 25.0), (50.0, 60.0), (25.0, 25.0)]]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["A", "B"]
    page.write_text("<!-- results: study=tiny,tiny show=bars -->\n<!-- end -->\n")
    with pytest.raises(BidexError, match="two arms are named 'long"):
        fill(page, data(page))


def test_pictures_are_drawn_anew_where_the_data_changed(page: Path) -> None:
    page.write_text("".join(f"<!-- results: study=tiny show={s} -->\n<!-- end -->\n" for s in ("curves", "classes")))  # fmt: skip  # noqa: E501
    written = fill(page, data(page))
    assert [path.name for path in written] == ["tiny-curves.png", "page.md"]
    title = "Return and success of training episodes, which have exploration noise"
    assert f"![{title}: tiny, MT4](tiny-curves.png)" in page.read_text()
    assert "55 % (50 to 60)" in page.read_text()
    assert fill(page, data(page), check=True) == []
    changed = data(page) / "tiny.json"
    changed.write_text(changed.read_text().replace('"parameters": 12345', '"parameters": 12346', 1))
    assert fill(page, data(page), check=True) == written[:1]


def test_a_range_has_no_negative_zero() -> None:
    assert mean_and_range(np.array([-0.3, 0.2]), ".0f", " %") == "0 % (0 to 0)"
    assert mean_and_range(np.array([-0.6, -0.2]), ".0f") == "0 (-1 to 0)"
