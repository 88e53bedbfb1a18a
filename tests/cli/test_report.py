"""The report: self-contained, escaped, and with the numbers of the runs."""

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from bidex_meta.experiments import report_page as page
from bidex_meta.runs import RunFolder
from tests.fakes import evaluated_run, log

ROWS = [
    {
        "step": step, "Train/success/A": step / 1000, "Train/return/A": 1.0, "Train/success/<b>&": 0.1,
        "Eval/success/A": 0.5, "Perf/steps_per_second": 100.0 + step, "Perf/training_time": float(step),
    }
    for step in (500, 1000)
]  # fmt: skip


class Tags(HTMLParser):
    """Elements with their attributes, and the text of table cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict]] = []
        self.cells: list[str] = []
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag in ("td", "th")

    def handle_data(self, data):
        if self._inside and data.strip():
            self.cells.append(data.strip())


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    paths = [evaluated_run(tmp_path, seed, {"A": 0.5 + seed / 10, "<b>&": 0.1}, gamma=0.9) for seed in (0, 1)]
    paths += [evaluated_run(tmp_path, 0, {"A": 0.9, "<b>&": 0.2}, gamma=0.8, activation="<script>")]
    for path in paths:
        log(path, *ROWS)
    return paths


@pytest.fixture
def report(shown):
    return lambda paths, *more: Path(shown("report", *paths, *more).strip()).read_text()


def test_the_page_holds_everything_itself_and_no_markup_of_names(runs, report, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (runs[0] / "videos" / "training_500.mp4").write_bytes(b"old")
    (runs[0] / "videos" / "training_1000.mp4").write_bytes(b"new film")
    (runs[0] / "videos" / "tiled.mp4").write_bytes(b"tiles")
    (runs[0] / "videos" / "task.webp").write_bytes(b"animation")
    text = report(runs)
    tags = Tags(text)
    names = {tag for tag, _ in tags.elements}
    assert not names & {"script", "link", "iframe", "b"}
    addresses = [a[name] for _, a in tags.elements for name in ("src", "href") if name in a]
    assert addresses and all(address.startswith("data:") for address in addresses)
    assert not re.search(r"https?://|url\(", re.sub(r"base64,[^\"]*", "", text))
    films = [a["src"] for tag, a in tags.elements if tag == "video"]
    assert {base64.b64decode(film.partition(",")[2]) for film in films} == {b"new film", b"tiles"}
    pictures = [base64.b64decode(a["src"].partition(",")[2]) for tag, a in tags.elements if tag == "img"]
    assert len(pictures) == 4 and pictures.pop() == b"animation" and all(b"<svg" in picture for picture in pictures)
    assert "&lt;b&gt;&amp;" in text


def test_its_numbers_are_those_of_compare(runs, report, shown, tmp_path):
    out = tmp_path / "new" / "page.html"
    cells = Tags(report(runs, "--out", str(out))).cells
    for letter, group in zip("AB", json.loads(shown("compare", *runs, "--json")), strict=True):
        iqm = group["success_iqm"]
        ends = iqm["interval"]
        told = f"{100 * iqm['value']:.1f}" + (f" [{100 * ends[0]:.1f}, {100 * ends[1]:.1f}]" if ends else "")
        assert cells[cells.index(f"{letter} mtppo") + 4] == told
    assert "850" in cells  # median steps a second
    assert cells[cells.index("learner.gamma") + 1 :][:3] == ["0.9", "0.9", "0.8"]
    assert "num_envs" not in cells  # the same in all


def test_runs_without_an_evaluation_and_of_one_seed(runs, report):
    (runs[1] / "evaluation.json").unlink()
    text = report(runs, "--out", str(runs[0] / "r.html"))
    assert "1 run has no evaluation.json" in text
    alone = report(runs[:1])
    assert (runs[0] / "report.html").is_file()
    assert "Differences of configs" not in alone and "Adaptation" not in alone
    (runs[0] / "evaluation.json").write_text('{"policy": {"classes": {}}, "steps": 10}')
    assert "No table: " in report(runs[:1])


def test_a_meta_test_is_drawn(runs, report, shown):
    measures = {"success": 0.5, "return": 2.0, "score": None, "success_interval": [0.4, 0.6], "return_interval": None}
    shots = {"classes": {"A": measures}}
    played = {"shots": 1, "rollouts": 2, "trials": 1}
    splits = {"train": {**played, "before": shots, "after": shots, "by_shot": [shots, shots]}}
    (runs[0] / "evaluation.json").write_text(json.dumps({"splits": splits}))
    text = report(runs[:1])
    assert "over shots" in text and "over tasks (of few: episodes)" in text
    assert "meta-test after" not in pictures(text)
    (runs[0] / "evaluation.json").write_text(json.dumps({"splits": splits, "steps": 500}))
    assert "meta-test after 500 of 1,000 steps" in pictures(report(runs[:1]))
    shown("plot", runs[0], "--adaptation", "--out", runs[0] / "a.svg")
    assert "meta-test after 500 of 1,000 steps" in (runs[0] / "a.svg").read_text()


def pictures(text: str) -> str:
    """The text of all vector drawings of a page."""
    return "".join(base64.b64decode(each).decode() for each in re.findall(r"image/svg\+xml;base64,([^\"]*)", text))


def test_updates_are_no_environment_steps(tmp_path, report):
    path = evaluated_run(tmp_path, 0, {"A": 0.5}, "bc")
    log(path, *ROWS)
    text = report([path])
    assert {"1,000 updates", "850 updates"} < {*Tags(text).cells}
    assert "gradient updates / s" in pictures(text) and "environment steps" not in pictures(text)


def test_an_unusual_evaluation_is_named(runs, report):
    found = json.loads((runs[0] / "evaluation.json").read_text())
    (runs[0] / "evaluation.json").write_text(json.dumps(found | {"split": "test"}))
    assert "Evaluation of A mtppo: split test." in report(runs[:1])


def test_the_newest_film_is_that_of_the_latest_step(runs, report):
    for step, content in ((1000, b"newest"), (500, b"copied later"), (800, b"and this")):
        (runs[0] / "videos" / f"training_{step}.mp4").write_bytes(content)
    films = [a["src"] for tag, a in Tags(report(runs[:1])).elements if tag == "video"]
    assert [base64.b64decode(film.partition(",")[2]) for film in films] == [b"newest"]


def test_large_films_are_named_alone(runs, monkeypatch, report):
    monkeypatch.setattr(page, "FILM_BYTES", 4)
    (RunFolder.open(runs[0]).videos_path / "a.mp4").write_bytes(b"12345")
    text = report(runs[:1])
    assert "too large for this page" in text and "<video" not in text


def test_nothing_to_show_is_one_line(runs, refused, monkeypatch):
    assert "Name the run folders" in refused("report")
    log(runs[0])
    assert "has no metrics to draw yet" in refused("report", runs[0])
    log(runs[0], *ROWS)
