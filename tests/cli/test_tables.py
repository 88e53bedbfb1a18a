"""Tables in terminals of several widths: names and numbers are whole, each number has a cell of its own."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.cli.plot import named_runs
from bidex_meta.cli.tables import Sheet, evaluation_table, meta_test_table, plain_table, print_table, result_table
from bidex_meta.evaluation.comparison import read_groups
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import MetaEvaluation
from bidex_meta.evaluation.references import Reference
from bidex_meta.evaluation.results import ClassResult, Evaluation
from bidex_meta.experiments.comparing import class_table, group_table
from bidex_meta.tasks import registry
from tests.fakes import evaluated_run

CLASSES = registry.names()
WIDTHS = [80, 100, 160]


def evaluation(seed: int) -> Evaluation:
    """Long numbers for all twenty classes."""
    drawn = np.random.default_rng(seed)
    classes = {
        name: ClassResult(
            1000.0 * drawn.standard_normal(40),
            (drawn.random(40) < 0.6).astype(float),
            np.full(40, 225),
            np.arange(40),
            3,
            Reference(-1000.0, 100.0),
            0.75,
            0.25,
        )
        for name in CLASSES
    }
    return Evaluation(classes, 1)


def of_meta_test() -> Sheet:
    by_shot = [evaluation(seed) for seed in range(3)]
    adaptations = {name: np.arange(40) // 8 for name in CLASSES}
    protocol = Protocol(rollouts=10, trials=5)
    found = MetaEvaluation(by_shot, adaptations, protocol, [1, 1], [evaluation(seed) for seed in range(3)])
    return meta_test_table("promp on ML20-v2, test tasks", found.summary(), per_environment=False)


def of_sweep() -> Sheet:
    rows = [[f"MT20-v2-{name}-seed0", "left", "12,345,678", "20,000,000", "2,099", "1.23", ""] for name in CLASSES]
    return plain_table(["run", "state", "steps", "of", "steps/s", "hours left", "why"], rows)


TABLES: dict[str, Callable[[], Sheet]] = {
    "evaluate": lambda: evaluation_table("mtppo on MT20-v2", evaluation(0)),
    "evaluate --random": lambda: evaluation_table("mtppo on MT20-v2", evaluation(0), evaluation(1)),
    "run": lambda: result_table("mtppo on MT20-v2", evaluation(0), evaluation(1)),
    "meta-test": of_meta_test,
    "sweep": of_sweep,
}


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", TABLES)
def test_names_and_numbers_are_whole_at_any_width(name: str, width: int) -> None:
    sheet = TABLES[name]()
    lines = sheet.printed(width).splitlines()
    assert max(map(len, lines)) <= width and "…" not in "".join(lines)
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    assert [row[0] for row in rows] == [row[0] for row in sheet.rows], "a row a line, by its whole name"
    if name == "meta-test":
        assert rows[1][1] == "hidden" and (width < 160 or rows[0][3].startswith("["))
    whole = {part.strip() for row in sheet.rows for cell in row for part in (cell, *re.split(r" (?=\[)", cell))}
    for row in rows:
        assert len(row) >= 3 and set(row) <= whole
        for cell in row[1:]:
            assert len(re.findall(r"[-+]?\d[\d.,]*", cell)) <= 1 or re.fullmatch(r"\[.*\]|\d+ \(3 unstable\)", cell)
    assert "success" in "".join(lines) or name == "sweep"


@pytest.mark.parametrize("width", WIDTHS)
def test_comparisons_are_whole_at_any_width(width: int, tmp_path) -> None:
    success = dict.fromkeys(CLASSES, 0.123)
    paths = [evaluated_run(tmp_path, seed, success, algo) for algo in ("mtppo", "mtsac") for seed in (0, 1)]
    groups = read_groups(named_runs(paths, "compare"))
    for columns, rows in (group_table(groups), class_table(groups)):
        lines = plain_table(columns, rows).printed(width).splitlines()
        assert max(map(len, lines)) <= width
        shown = [line.split("│")[1].strip() for line in lines if "│" in line]
        assert shown == [row[0] for row in rows]


def test_what_is_left_out_is_said_and_intervals_go_first() -> None:
    sheet = TABLES["run"]()
    assert "95 %" in sheet.printed(100).split("CatchUnderarm")[0]
    narrow = sheet.printed(60)
    assert "95 %" not in narrow.split("CatchUnderarm")[0]
    assert "In a wider terminal, or with COLUMNS=200: 95 %." in " ".join(narrow.split())


def test_a_name_that_is_wider_than_the_terminal_is_printed_all_the_same() -> None:
    sheet = plain_table(["task", "success"], [["x" * 100, 0.5]])
    assert "x" * 100 in sheet.printed(80) and "0.5" in sheet.printed(80)


def test_a_pipe_is_as_wide_as_columns_says(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    found = {}
    for width in (None, 80, 100):
        if width is not None:
            monkeypatch.setenv("COLUMNS", str(width))
        else:
            monkeypatch.delenv("COLUMNS", raising=False)
        print_table(TABLES["evaluate --random"]())
        found[width] = max(map(len, capsys.readouterr().out.splitlines()))
    assert found[80] <= 80 < found[100] <= 100 < found[None] <= 180
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["list", "tasks"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80 and all(f"│ {name} " in out for name in CLASSES)
