"""The check of plain English: each rule finds what it is for and nothing else, and the listed pages have no finding."""

from pathlib import Path

import pytest

from tools.english import RULES, check, check_all, sentences


@pytest.mark.parametrize(
    ("bad", "good", "rule"),
    [
        ("* One seed on two cores.", "* We trained one seed on two cores.", "no verb"),
        (
            "MT-PPO succeeds in 49.8 %; a clone in 55.4 %.",
            "MT-PPO succeeds in 49.8 %. A clone succeeds in 55.4 %.",
            "no verb",
        ),
        ("What ends the training early.", "What ends the training early?", "opens with a question word"),
        (
            "Success rose from 5 % to 57 % in 20 minutes.",
            "Success rose from 5 % [2, 9] to 57 % [50, 61] (Duan et al. 2016, arXiv 1611.02779).",
            "more than two numbers",
        ),
        ("It prints success beside a random policy.", "It compares success with a random policy.", "compare with"),
        ("It plays fifty tasks a class.", "It plays fifty tasks per class; a class is one kind of task.", "per class"),
        ("It took 20 minutes of a core.", "It took 20 minutes on one core, over a core network.", "on one core"),
        ("Resume it with as many processes.", "Resume with the same number of processes.", "resolve"),
        ("It learned from nothing.", "It was trained from scratch.", "field's term"),
        ("It stops. Where looking costs nothing, we look.", "It stops when looking costs time.", "if"),
        ("No reward term pays for tilting.", "No reward term rewards tilting.", "objects"),
        ("| seeds | trained anew |", "| seeds | trained from scratch |", "resolve"),
    ],
)
def test_rules_find_their_own(bad: str, good: str, rule: str) -> None:
    assert [finding.line for finding in check("page", f"# Title\n\n{bad}\n") if rule in finding.rule] == [3]
    assert not list(check("page", f"{good}\n"))


def test_sentences_end_at_marks_not_at_abbreviations_and_skip_code() -> None:
    text = "# One\n\nWe follow Chen et al. 2022 here.\nIt runs `a; b. c` twice.\n\n"
    text += "```\nnot this one here\n```\n* The bullet\n  goes on."
    assert list(sentences(text)) == [
        (3, "We follow Chen et al. 2022 here."),
        (4, "It runs CODE twice."),
        (9, "The bullet goes on."),
    ]


def test_exceptions_hide_a_finding_and_must_be_needed(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("Two seeds on two cores in all.\n")
    known = {"page": "page.md", "words": "Two seeds", "reason": "a caption"}
    rules = {"pages": ["*.md"], "exceptions": [known]}
    assert check_all(rules, tmp_path) == []
    assert len(check_all({**rules, "exceptions": []}, tmp_path)) == 1
    assert "not needed" in check_all({**rules, "exceptions": [known, {**known, "words": "Three"}]}, tmp_path)[0]


def test_pages_are_plain_and_exceptions_have_reasons() -> None:
    assert check_all() == []
    assert all(exception["reason"] for exception in RULES.get("exceptions", []))
