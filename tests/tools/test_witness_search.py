from pathlib import Path

import numpy as np
import pytest
import torch

from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.replay import replay
from bidex_meta.witness.scripts import SCRIPTS
from bidex_meta.witness.store import LEVELS, Witness, load_witness
from tools.witness_search import steady, whole
from tools.witness_search.__main__ import main
from tools.witness_search.planner import Planner, PlannerConfig

SMALL = PlannerConfig(samples=6, rounds=2, first_rounds=2, horizon=6, knots=3, execute=3, copies=2)


def test_a_search_plays_the_episode_and_never_ends_below_doing_nothing() -> None:
    planner = Planner("HandOver", SMALL, threads=1)
    plan = planner.search()
    assert plan.actions.shape == (len(plan.rewards), 52) and len(plan.rewards) <= 75
    assert np.abs(plan.actions * LEVELS - np.rint(plan.actions * LEVELS)).max() < 1e-4
    # The actions give the return and success that the planner reports.
    played = replay("HandOver", Witness(plan.actions.astype(np.float32), {}), threads=1)
    assert played.total == pytest.approx(plan.total, rel=1e-9)
    assert played.first_success == plan.first_success
    assert 0.0 <= played.deepest < 0.02
    assert plan.rival is not None and np.isfinite(plan.rival)


def test_a_search_of_whole_episodes_never_falls_behind_the_episode_it_began_with(
    capsys: pytest.CaptureFixture[str],
) -> None:
    actions = load_witness("HandOver").actions
    found = whole.searched("HandOver", actions, 2)
    first, _ = capsys.readouterr().out.splitlines()
    began, ended = (replay("HandOver", Witness(each, {}), threads=1) for each in (actions, found))
    assert ended.total > began.total - 1.0 and ended.first_success is not None
    assert float(first.split("return ")[1].split(",")[0]) > began.total - 1.0 and " 0 succeed" not in first
    assert np.abs(found * LEVELS - np.rint(found * LEVELS)).max() < 1e-4


def test_steadying_keeps_an_episode_that_nothing_betters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_changes(elites: torch.Tensor, count: int, *_: object) -> torch.Tensor:
        return elites[:1].repeat(count, 1, 1)

    monkeypatch.setattr(steady, "mutants", no_changes)
    actions = load_witness("Switch").actions[:20]
    found = steady.steadied("Switch", actions, 1, threads=1)
    np.testing.assert_array_equal(found, actions)
    printed = capsys.readouterr().out  # the witness succeeds at its seventh step, from any shifted start, and softly
    assert printed.startswith("10 of 10 shifted starts") and printed.endswith("deep states 0.0\n")


def test_an_episode_of_a_script_that_does_not_hold_is_kept_in_a_named_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stay(hands: HandController) -> Actions:
        yield from hands.lead(tuple(hands.at("right").tolist()), tuple(hands.at("left").tolist()), steps=3)

    monkeypatch.setitem(SCRIPTS, "StackBlock", stay)
    monkeypatch.chdir(tmp_path)
    main(["script", "--task", "StackBlock"])
    assert not list(tmp_path.iterdir())
    main(["script", "--task", "StackBlock", "--file", "tried.npz"])
    kept = load_witness("StackBlock", Path("tried.npz"))
    assert kept.actions.shape == (3, 52) and kept.made["script"] == "stay" and kept.made["first_success"] is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["LiftUnderarm", "PourWater", "ReOrientation"])  # other scripts have changed since
def test_a_script_gives_the_stored_witness_again(name: str, tmp_path: Path) -> None:
    main(["script", "--task", name, "--file", str(tmp_path / "again.npz")])
    played = load_witness(name, tmp_path / "again.npz").actions
    np.testing.assert_allclose(played, load_witness(name).actions, atol=2.5 / 127)
