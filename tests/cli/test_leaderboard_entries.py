"""The leaderboard's statistics on known numbers, and its files: edits, forgeries and contradictions."""

import copy
import json
import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bidex_meta.errors import BidexError
from bidex_meta.evaluation import leaderboard
from bidex_meta.evaluation.entries import FORMAT, TRANSFER_STEPS, AgentEntry, Entry, TransferEntry, evaluation_seed
from bidex_meta.evaluation.entry_rows import class_row
from bidex_meta.evaluation.leaderboard import (
    improvement,
    profile,
    read_entry,
    sealed,
    success_iqm,
)
from bidex_meta.experiments import submitting
from bidex_meta.runs import RunFolder
from bidex_meta.runs.checkpoints import weights_digest
from bidex_meta.suite import Suite
from bidex_meta.suite_files import load_suite
from bidex_meta.utils.validation import parse
from tests.pages import ROOT
from tools.pages.leaderboard import leaderboard_table

SHIPPED = sorted((ROOT / "results" / "leaderboard").glob("*.json"))
TUNED = ["--tuning", "12x1"]


def classes(*rates: float, tasks: int = 10) -> list[np.ndarray]:
    """One run that solves these shares of its tasks."""
    return [np.array([[1.0] * round(rate * tasks) + [0.0] * (tasks - round(rate * tasks))]) for rate in rates]


def test_measures_of_known_numbers() -> None:
    a, b = classes(0.0, 0.2, 0.6, 1.0), classes(0.1, 0.2, 0.5, 0.9)
    assert success_iqm(a).value == pytest.approx(0.4)
    assert [profile(a, rate) for rate in (0.1, 0.6, 0.9)] == [0.75, 0.25, 0.25]
    assert improvement(a, b).value == pytest.approx((0.0 + 0.5 + 1.0 + 1.0) / 4)
    assert improvement(a, b).value + improvement(b, a).value == pytest.approx(1.0)
    two = [np.concatenate(pair) for pair in zip(a, b, strict=True)]
    assert improvement(two, two).value == pytest.approx(0.5)
    assert success_iqm(two).value == pytest.approx((0.1 + 0.2 + 0.2 + 0.5 + 0.6 + 0.9 - 0.1 - 0.9) / 4)


def test_an_interval_of_a_single_value_is_none() -> None:
    assert success_iqm(classes(1.0, tasks=1)).interval is None
    assert class_row([[1]], 1)["interval"] is None


def test_intervals_resample_tasks_and_of_few_tasks_episodes() -> None:
    low, high = class_row([[1] * 8 + [0] * 8], 1)["interval"]
    usual = 1.96 * np.sqrt(0.25 / 16)
    assert (high - low) / 2 == pytest.approx(usual, rel=0.15)
    low, high = class_row([[20, 20], [20, 20]], 40)["interval"]
    assert (high - low) / 2 == pytest.approx(1.96 * np.sqrt(0.25 / 160), rel=0.25), (
        "episodes of two runs are independent"
    )


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_entries_fit(path: Path) -> None:
    entry = read_entry(path)
    for part in entry.parts.values():
        for row in part.shots[-1].values():
            assert row.success == pytest.approx(np.mean(row.solved) / entry.episodes / part.trials, abs=1e-3)
    assert path.name.startswith(f"{entry.suite}-")


def test_digests_of_shipped_policies_are_those_of_the_runs() -> None:
    """Both policies are stored in half precision, the runs had single precision."""
    for run in ("results/MT20-dagger-seed0", "results/MT20-mtppo-seed0"):
        loaded = RunFolder.open(ROOT / run).checkpoints.load()
        assert loaded is not None
        digest = weights_digest(loaded[0]["learner"]["policy"])
        policy = {"weights": {name: w.float() for name, w in loaded[0]["learner"]["policy"]["weights"].items()}}
        assert weights_digest(policy) == digest


def test_the_seed_comes_from_the_weights_alone() -> None:
    weights = ["0" * 32, "1" * 32]
    assert evaluation_seed(weights) == evaluation_seed(weights[::-1]) == evaluation_seed(iter(weights))
    seeds = {evaluation_seed([f"{number:032x}"]) for number in range(100)}
    assert len(seeds) == 100 and min(seeds) >= 2**30 and max(seeds) < 2**31


KINDS = {"multi-task": "MT5-v2", "reward-only": "ML5-v2", "agent": "ML1-Switch-choice2", "transfer": "ML4-v2"}
SCHEMAS = {"agent": AgentEntry, "transfer": TransferEntry}


def _part(suite: Suite, split: str, adapts: bool, runs: int, rate: float, generator: np.random.Generator) -> dict:
    shots = []
    trials = 2 if adapts else 1
    for shot in range(3 if adapts else 1):
        rows = {}
        for name, pool in suite.task_names(split).items():  # type: ignore[arg-type]
            tasks = min(len(pool), 20) if adapts else len(pool)
            solved = generator.binomial(3 * trials, rate * (1 + shot) / 3 if adapts else rate, (runs, tasks)).tolist()
            rows[name] = class_row(solved, 3 * trials)
        shots.append(rows)
    return {"trials": trials, "rollouts": 4 if adapts else 0, "shots": shots}


def _transfer(suite: Suite, runs: int, rate: float, first: int, generator: np.random.Generator) -> dict:
    """The fields of a transfer to the suite's only held-out class, with ``runs`` seeds."""
    held_out = "TwoCatchUnderarm"
    shots = []
    for success in (rate / 2, rate):
        solved = generator.binomial(3, success, (runs, 50)).tolist()
        shots.append({held_out: class_row(solved, 3)})
    return {
        "new": {"trials": 1, "rollouts": 0, "shots": shots}, "seeds": list(range(runs)), "budget": TRANSFER_STEPS,
        "start": f"{first + 100:032x}", "scratch": [f"{first + 200 + number:032x}" for number in range(runs)],
        "algorithm": "mtppo", "train_tasks": None, "steps": [1000],
        "stated": {"seeds": [0], "hours": [0.5], "device": "H100", "commit": [None]},
    }  # fmt: skip


def made(kind: str, name: str = "mine", rate: float = 0.5, runs: int = 2, first: int = 0) -> dict[str, Any]:
    """The content of a valid entry; runs of other ``first`` have other weights."""
    suite = load_suite(KINDS[kind])
    adapts = kind in ("reward-only", "agent")
    generator = np.random.default_rng(first)
    weights = [f"{first + number:032x}" for number in range(runs)]
    content: dict[str, Any] = {
        "format": FORMAT, "name": name, "suite": suite.name, "tuning": {"trials": 12, "seeds": 1},
        "track": "reward-only" if adapts else kind, "episodes": 3, "seed": evaluation_seed(weights),
        "new": _part(suite, "test" if adapts else "train", adapts, 1 if kind == "agent" else runs, rate, generator),
        "conditions": {
            "device": "cpu", "engine": "c", "threads": 1, "num_envs": None, "physics": "0123456789ab",
            "packages": {"bidex-meta": "0.3.0", "mujoco": "4.0.0"}, "suite_version": suite.version,
            "suite_digest": suite.digest,
        },
    }  # fmt: skip
    if kind == "agent":
        receipt = {"weights": [], "config": [], "code": None}
        return sealed({**content, "agent": "Scout", "task_seed": 3, "receipt": receipt}, AgentEntry, "made")
    receipt = {"weights": weights, "config": weights, "code": "0123456789+"}
    if kind == "transfer":
        content |= _transfer(suite, runs, rate, first, generator) | {"receipt": receipt}
        return sealed(content, TransferEntry, "made")
    content |= {
        "algorithm": "rl2" if adapts else "mtppo", "train_tasks": None, "steps": [1000] * runs,
        "own": _part(suite, "train", adapts, runs, rate, generator),
        "stated": {"seeds": list(range(runs)), "hours": [0.5] * runs, "device": "H100", "commit": [None] * runs},
        "receipt": receipt,
    }  # fmt: skip
    return sealed(content, Entry, "made")


def place_of(folder: Path, kind: str, content: dict[str, Any]) -> Path:
    path = folder / ("trials" if kind == "agent" else "") / f"{KINDS[kind]}-{content['name']}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def _places(value: Any, place: tuple = ()) -> Iterator[tuple]:
    """Every place in a content of JSON."""
    yield place
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _places(each, (*place, name))
    elif isinstance(value, list):
        for number, each in enumerate(value):
            yield from _places(each, (*place, number))


def _edited(value: Any, rng: random.Random) -> Any:
    """Another value in the place of one."""
    if isinstance(value, dict):
        names = list(value)
        one, two = rng.choice(names), rng.choice(names)
        return rng.choice([
            {**value, "extra": 1},
            {name: each for name, each in value.items() if name != one},
            {name + "x" * (name == one): each for name, each in value.items()},
            {**value, one: value[two], two: value[one]},
            dict(reversed(value.items())),
        ])  # fmt: skip
    if isinstance(value, list):
        if not value:
            return [rng.choice([0, "x", None])]
        one, two = rng.randrange(len(value)), rng.randrange(len(value))
        swapped = list(value)
        swapped[one], swapped[two] = value[two], value[one]
        return rng.choice([[*value, value[one]], value[:one] + value[one + 1 :], swapped, value * 2, [], value[::-1]])
    if isinstance(value, str):
        return rng.choice([value + "0", value[1:], value[::-1], value.upper(), "", 0, "MT4", "a|b", "/home/me/x"])
    if value is None:
        return rng.choice([0, "x", 1.0, []])
    return rng.choice([value + 1, value - 1, value / 2, value * 2 + 0.01, -value, 0, 1, 1e12, float("nan"), None, "1"])


PROVEN = ("suite", "episodes", "format", "own", "new", "seed", "budget")
"""Fields that follow from the weights, the suite or other fields. A forger gives the rest a fitting digest too."""


def _resealed(content: dict[str, Any]) -> None:
    with suppress(BidexError, LookupError, TypeError, AttributeError):
        entry = parse(content, TransferEntry if "budget" in content else Entry, "edited", exact=True)
        content["receipt"]["evaluation"] = leaderboard._digest_of(entry)


@pytest.mark.parametrize("kind", KINDS)
def test_200_random_edits_are_refused_or_equal_in_meaning(kind: str, tmp_path: Path, few_resamples) -> None:
    content = json.loads(json.dumps(made(kind)))
    path = place_of(tmp_path, kind, content)
    whole = read_entry(path)
    rng = random.Random(0)
    places = list(_places(content))
    by_field: dict[Any, list[tuple]] = {}
    for place in places[1:]:
        by_field.setdefault(place[0], []).append(place)
    refused = 0
    for number in range(200):
        edited = copy.deepcopy(content)
        # Most numbers are of tasks, so that an edit chooses its field first.
        place = rng.choice(by_field[rng.choice(list(by_field))]) if number else ()
        parent = edited
        for name in place[:-1]:
            parent = parent[name]
        if place:
            parent[place[-1]] = _edited(parent[place[-1]], rng)
        else:
            edited = _edited(edited, rng)
        if kind != "agent" and place and place[0] in PROVEN and "rollouts" not in place:
            _resealed(edited)
        path.write_text(json.dumps(edited))
        try:
            assert read_entry(path) == whole, f"{place} {json.dumps(parent)[:300]}"
        except BidexError as error:
            refused += 1
            assert "\n" not in str(error) and str(path) in str(error)
    assert refused > 150


@pytest.mark.parametrize("kind", KINDS)
def test_contradictions_are_refused_whatever_the_digest(kind: str, tmp_path: Path, few_resamples) -> None:
    """Each is an edit of somebody who knows how digests are made."""
    name = next(iter(made(kind)["new"]["shots"][0]))
    edits: dict[str, Callable[[dict[str, Any]], object]] = {
        "shots": lambda entry: entry["new"]["shots"].append(entry["new"]["shots"][0]),
        "classes": lambda entry: entry["new"]["shots"][0].update(Juggling=entry["new"]["shots"][0].pop(name)),
        "at most": lambda entry: entry["new"]["shots"][0].update({name: solved_by(entry, 7)}),
        "episodes of a task": lambda entry: entry.update(episodes=1_000_000),
        "version": lambda entry: entry["conditions"].update(suite_version=9),
        "digest": lambda entry: entry["conditions"].update(suite_digest="0" * 12),
        "mujoco": lambda entry: entry["conditions"]["packages"].pop("mujoco"),
        "rollouts": lambda entry: entry["new"].update(rollouts=4 if kind in ("multi-task", "transfer") else 0),
        "shipped suite": lambda entry: entry.update(suite="mine"),
        r"receipt|expected \d values": lambda entry: entry["receipt"]["config"].append("0" * 32),
    }
    if kind != "agent":
        edits |= {
            "seed: expected": lambda entry: entry.update(seed=entry["seed"] + 1),
            "which comes from the weights": lambda entry: entry["receipt"]["weights"].__setitem__(0, "f" * 32),
            "got one twice|each policy once": lambda entry: entry["receipt"].update(weights=["0" * 32] * 2),
            "each seed once|expected 1 values": lambda entry: entry["stated"].update(seeds=[0, 0]),
            "train_tasks|digest": lambda entry: entry.update(train_tasks=7),
        }
    if kind == "transfer":
        edits |= {
            "budget: expected 1,000,000 steps": lambda entry: entry.update(budget=10),
            "seeds: expected each seed once": lambda entry: entry.update(seeds=[3, 3]),
            "scratch: expected each policy once": lambda entry: entry.update(start=entry["scratch"][0]),
            "track": lambda entry: entry.update(track="multi-task"),
        }

    def solved_by(entry: dict[str, Any], count: int) -> dict[str, Any]:
        solved = [[count] * len(run) for run in entry["new"]["shots"][0][name]["solved"]]
        return {**entry["new"]["shots"][0][name], "solved": solved}

    for expected, edit in edits.items():
        content = made(kind)
        edit(content)
        with pytest.raises(BidexError, match=expected):
            sealed(content, SCHEMAS.get(kind, Entry), "edited")


def test_a_policy_stands_in_one_entry_alone_of_all_suites(tmp_path: Path, few_resamples) -> None:
    board = tmp_path / "leaderboard"
    place_of(board, "multi-task", made("multi-task", first=0))
    assert list(leaderboard_table("", tmp_path / "data"))
    place_of(board, "reward-only", made("reward-only", first=1))  # its first policy is the other's second
    with pytest.raises(BidexError, match="their weights are equal"):
        list(leaderboard_table("", tmp_path / "data"))


def test_a_run_is_transferred_in_one_entry_alone(tmp_path: Path, few_resamples) -> None:
    board = tmp_path / "leaderboard"
    place_of(board, "multi-task", made("multi-task", first=100))  # the policy itself may also have its own entry
    place_of(board, "transfer", made("transfer"))
    assert list(leaderboard_table("", tmp_path / "data"))
    again = made("transfer", "again", first=10)
    again["start"] = f"{100:032x}"
    place_of(board, "transfer", sealed(again, TransferEntry, "again"))
    with pytest.raises(BidexError, match="their weights are equal"):
        list(leaderboard_table("", tmp_path / "data"))


def test_the_table_is_by_track_and_suite_and_claims_only_what_is_separated(tmp_path: Path, few_resamples) -> None:
    board = tmp_path / "leaderboard"
    place_of(board, "multi-task", made("multi-task", "strong", 0.9, first=0))
    place_of(board, "multi-task", made("multi-task", "like", 0.9, first=2))
    place_of(board, "multi-task", made("multi-task", "weak", 0.1, runs=1, first=4))
    place_of(board, "reward-only", made("reward-only", first=6))
    place_of(board, "transfer", made("transfer", first=8))
    scout = place_of(board, "agent", made("agent", "scout"))
    with pytest.raises(BidexError, match="cannot be played again"):
        submitting.check(scout, [], "cpu")
    lines = list(leaderboard_table("", tmp_path / "data"))
    heads = [line for line in lines if line.startswith("**")]
    of = "adaptation, reward only"
    adaptation = [f"**ML1-Switch-choice2, {of}**", f"**ML5-v2, {of}**"]
    assert heads == ["**MT5-v2, multi-task**", *adaptation, "**ML4-v2, transfer to held-out classes**"]
    assert sum("better than weak (policies of single runs)" in line for line in lines) == 2
    assert sum("| not separated |" in line for line in lines) == 1
    assert any("scout (not verified)" in line and "| 12 × 1 |" in line for line in lines)
    assert not list(leaderboard_table("MT4", tmp_path / "data"))
    assert next(iter(leaderboard_table("MT5-v2", tmp_path / "data"))) == heads[0]


def test_entries_of_equal_success_share_a_place(tmp_path: Path, few_resamples) -> None:
    board = tmp_path / "leaderboard"
    for first, (name, rate) in enumerate((("best", 1.0), ("as-good", 1.0), ("third", 0.2))):
        place_of(board, "multi-task", made("multi-task", name, rate, first=2 * first))
    rows = [line.split("|")[1].strip() for line in list(leaderboard_table("MT5-v2", tmp_path / "data"))[4:7]]
    assert rows == ["1", "1", "3"]


def test_claims_say_that_an_entry_is_not_verified(tmp_path: Path, few_resamples) -> None:
    board = tmp_path / "leaderboard"
    place_of(board, "agent", made("agent", "scout", 1.0))
    other = made("agent", "rl2", 0.1)
    place_of(board, "agent", other)
    lines = list(leaderboard_table(KINDS["agent"], tmp_path / "data"))
    assert "| scout (not verified) | rl2 (not verified) |" in lines[-2]
    assert "scout (not verified) better than rl2 (not verified)" in lines[-2]


@pytest.mark.parametrize(
    ("kind", "edits", "expected"),
    [
        ("reward-only", {"algorithm": "mtppo"}, "track: expected multi-task for mtppo, got reward-only"),
        ("reward-only", {"algorithm": "icl"}, "track: expected privileged for icl, got reward-only"),
        ("multi-task", {"algorithm": "rl2"}, "track: expected reward-only or privileged for rl2, got multi-task"),
        ("multi-task", {"algorithm": "nosuch"}, "algorithm: Unknown algo"),
    ],
)
def test_a_learner_stands_only_in_its_own_track(
    kind: str, edits: dict[str, str], expected: str, tmp_path: Path, few_resamples
) -> None:
    content = sealed(made(kind) | edits, Entry, "edited")
    path = place_of(tmp_path / "leaderboard", kind, content)
    with pytest.raises(BidexError, match=f"{path.name}: {expected}"):
        list(leaderboard_table("", tmp_path / "data"))


@pytest.mark.parametrize("name", ["x <!-- end --> y", "[me](https://example.org)", "<img src=x>"])
def test_names_hold_no_markup(name: str) -> None:
    with pytest.raises(BidexError, match="name: expected a text"):
        made("multi-task", name)


def test_a_file_that_holds_no_entry_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "MT5-v2-x.json"
    path.write_text("[]")
    with pytest.raises(BidexError, match=path.name):
        read_entry(path)
