import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bidex_meta import paths
from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.record.versions import collect_versions
from bidex_meta.sources.source import OwnSuite
from bidex_meta.tasks import registry
from bidex_meta.witness import steady, whole
from bidex_meta.witness.config import PlannerConfig
from bidex_meta.witness.mutants import mutants, parts_of_the_hands
from bidex_meta.witness.open_loop import OpenLoop
from bidex_meta.witness.planner import LEVELS, Planner, interpolation, quantised, rest_action, shifted
from bidex_meta.witness.replay import Replay, replay
from bidex_meta.witness.simulator import SHIFT, Simulator, Trace, task_slot
from bidex_meta.witness.store import Witness, load_witness, save_witness, witness_path
from bidex_meta.world import World

SMALL = PlannerConfig(samples=6, rounds=2, first_rounds=2, horizon=6, knots=3, execute=3, copies=2)


def random_actions(steps: int) -> torch.Tensor:
    return quantised(2.0 * torch.rand(steps, 52, generator=torch.Generator().manual_seed(3)) - 1.0)


@pytest.mark.parametrize("name", ["HandOver", "TwoCatchUnderarm"])
def test_the_simulator_plays_what_the_world_plays(name: str) -> None:
    actions = random_actions(40)
    simulator = Simulator(name, 2, threads=1)
    trace = simulator.play(actions[:, None].expand(-1, 2, -1))
    world = World([task_slot(name)], 1, autoreset_mode="DISABLED", seed=0, threads=1)
    world.reset(seed=0)
    rewards, least, success, ended = [], [], [], False
    for action in actions:
        _, reward, terminated, truncated, info = world.step(action[None])
        terms = [float(term[0]) for term in info["reward_terms"].values()]
        rewards.append(0.0 if ended else float(reward[0]))
        least.append(0.0 if ended else len(terms) * min(terms))
        success.append(bool(info["success"][0]) and not ended)
        ended |= bool(terminated[0] | truncated[0])
    np.testing.assert_allclose(trace.rewards[:, 0].float().numpy(), np.array(rewards, np.float32), rtol=1e-6)
    np.testing.assert_allclose(trace.least[:, 0].numpy(), np.array(least), rtol=1e-5)
    assert trace.success[:, 0].tolist() == success
    assert bool(trace.alive[0]) == (not ended)
    torch.testing.assert_close(trace.rewards[:, 0], trace.rewards[:, 1], rtol=0, atol=0)


def test_a_saved_state_continues_bit_for_bit_in_every_row() -> None:
    actions = random_actions(20)[:, None].expand(-1, 2, -1)
    simulator = Simulator("CatchUnderarm", 2, threads=1)
    simulator.play(actions[:10])
    state = simulator.save(0)
    expected = simulator.play(actions[10:]).rewards
    simulator.load([state])
    assert torch.equal(simulator.play(actions[10:]).rewards, expected)


def test_shifted_starts_move_the_objects_alone_and_by_a_tenth_of_a_millimetre() -> None:
    simulator = Simulator("TwoCatchUnderarm", 1, threads=1)
    first, *others = (state["qpos"] for state in simulator.starts(3))
    places = simulator._part.group.members[0].scene.qpos
    for other in others:
        moved = (other - first).nonzero().flatten().tolist()
        expected = [places[name].start + i for name in ("object1", "object2") for i in (0, 1)]
        assert set(moved) <= set(expected)
        for name in ("object1", "object2"):
            start = places[name].start
            assert float((other - first)[start : start + 2].norm()) == pytest.approx(SHIFT, rel=1e-6)


def test_fixtures_are_shifted_too() -> None:
    first, *others = (state["mocap_pos"] for state in Simulator("Switch", 1, threads=1).starts(2))
    for other in others:
        torch.testing.assert_close((other - first).norm(dim=1), first.new_full((2,), SHIFT), rtol=1e-6, atol=0)


def test_a_search_plays_the_episode_and_never_ends_below_doing_nothing() -> None:
    planner = Planner("HandOver", SMALL, threads=1)
    seen: list[int] = []
    plan = planner.search(lambda steps, total, success: seen.append(steps))
    assert plan.actions.shape == (len(plan.rewards), 52) and len(plan.rewards) <= 75
    assert seen == sorted(seen)
    assert np.abs(plan.actions * LEVELS - np.rint(plan.actions * LEVELS)).max() < 1e-4
    # What the planner says it got is what the actions give.
    played = replay("HandOver", Witness(plan.actions.astype(np.float32), {}), threads=1)
    assert played.total == pytest.approx(plan.total, rel=1e-9)
    assert played.first_success == plan.first_success
    assert 0.0 <= played.deepest < 0.02
    assert plan.rival is not None and np.isfinite(plan.rival)


def test_copies_that_do_not_divide_the_samples_are_refused() -> None:
    with pytest.raises(BidexError, match="6 and 4"):
        Planner("HandOver", replace(SMALL, copies=4))


def test_a_witness_survives_the_disk(tmp_path: Path) -> None:
    actions = random_actions(30).numpy()
    path = save_witness(tmp_path / "HandOver.npz", actions, {"return": 1.5})
    assert path.stat().st_size < 10_000
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["actions"].astype(np.float32) / LEVELS, actions)
        assert json.loads(str(stored["made"])) == {"return": 1.5}


@pytest.mark.parametrize("first, succeeded, found", [(3, 8, True), (3, 7, False), (None, 10, False)])
def test_found_means_the_start_and_eight_of_ten_shifted_ones(first: int | None, succeeded: int, found: bool) -> None:
    assert Replay(0.0, first, succeeded, 0.0).found is found


@given(st.integers(2, 60), st.integers(2, 12))
def test_interpolation_goes_through_its_knots(horizon: int, knots: int) -> None:
    weights = interpolation(horizon, knots)
    torch.testing.assert_close(weights.sum(1), torch.ones(horizon))
    line = torch.linspace(-1.0, 1.0, knots)
    torch.testing.assert_close(weights @ line, torch.linspace(-1.0, 1.0, horizon), atol=1e-5, rtol=0)


@given(st.integers(3, 40), st.integers(2, 9), st.integers(0, 50))
def test_a_plan_that_is_shifted_says_the_same_of_the_same_moment(horizon: int, knots: int, steps: int) -> None:
    line = torch.linspace(0.0, 1.0, knots)[:, None]  # linear in time, so that no knot hides anything
    moved = shifted(line, steps, horizon)
    expected = (torch.linspace(0.0, horizon - 1.0, knots) + steps).clamp(max=horizon - 1.0) / (horizon - 1.0)
    torch.testing.assert_close(moved[:, 0], expected, atol=1e-5, rtol=0)


def test_mutants_change_a_few_actions_or_one_part_of_the_hands() -> None:
    elites, generator = torch.zeros(1, 9, 52), torch.Generator().manual_seed(0)
    changed = (mutants(elites, 400, PlannerConfig(), generator) != 0).any(1)
    parts = parts_of_the_hands(52)
    whole = (changed[:, None] == parts).all(2).any(1)
    assert 0.35 < float(whole.float().mean()) < 0.65
    assert 0.1 < float(changed[~whole].float().mean()) < 0.2
    assert parts.sum(1).tolist() == [20, 20, 3, 3, 3, 3, 6] and parts[3].nonzero().flatten().tolist() == [23, 24, 25]
    assert parts_of_the_hands(40).sum(1).tolist() == [20, 20]


def test_half_of_the_mutants_cross_the_hands_of_two_elites() -> None:
    elites = torch.tensor([-0.5, 0.5])[:, None, None].expand(2, 9, 52)
    made = mutants(elites, 400, replace(PlannerConfig(), std=0.0), torch.Generator().manual_seed(0))
    right, left = made[:, :, :26], made[:, :, 26:]
    assert bool((right == right[:, :1, :1]).all()) and bool((left == left[:, :1, :1]).all())
    assert 0.15 < float((right[:, 0, 0] != left[:, 0, 0]).float().mean()) < 0.35


def test_the_rest_action_holds_the_start() -> None:
    action = rest_action(52)
    assert action.shape == (52,) and (action[20:26] == 0).all() and (action.abs() <= 1).all()
    assert torch.equal(action[:26], action[26:])


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--task", "HandOver", "--all"],
        ["--task", "HandOve"],
        ["--task", "HandOver", "--whole", "3"],
        ["--task", "HandOver", "--find", "--whole", "3"],
        ["--task", "HandOver", "--find", "--exchange", "3"],
    ],
)
def test_bad_calls_are_answered_in_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["witness", *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_missing_witness_says_how_to_search_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "assets_dir", lambda: tmp_path)
    with pytest.raises(Exception, match="--task HandOver --find"):
        load_witness("HandOver")


def test_replay_of_what_is_missing_is_not_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("bidex_meta.witness.store.witness_path", lambda name: tmp_path / name)
    assert main(["witness", "--task", "HandOver", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["found"] is False


def test_a_search_keeps_its_best_episode_in_a_file_and_the_file_can_be_replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "attempt.npz"
    words = ["witness", "--task", "CatchUnderarm", "--file", str(file), "--json"]
    search = ["--find", "--planner.samples", "2", "--planner.first-rounds", "1", "--planner.rounds", "1"]
    assert main([*words, *search, "--planner.horizon", "4", "--planner.knots", "2", "--planner.execute", "40"]) == 0
    capsys.readouterr()
    assert main(words) == 0
    row = json.loads(capsys.readouterr().out)[0]
    assert row["found"] is False and row["return"] == pytest.approx(
        load_witness("CatchUnderarm", file).made["return"], abs=1e-3
    )
    for columns in (1, 40, 53):
        save_witness(file, np.zeros((20, columns), np.float32), {"return": 0.0})
        assert main(words) == 2
        assert f"(steps, 52), as CatchUnderarm has, got (20, {columns})" in capsys.readouterr().err
    assert main([*words[:-2], str(tmp_path / "none.npz")]) == 2
    assert "--find --file" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in registry.names() if witness_path(name).is_file()])
def test_every_stored_witness_holds(name: str) -> None:
    witness = load_witness(name)
    result, here = replay(name, witness), collect_versions()
    assert result.found, (
        f"{name}: success {result.first_success}, {result.succeeded} of 10 shifted starts, "
        f"on {here['platform']} with {here['packages']}; made on {witness.made['versions']}"
    )
    page = (Path(__file__).parent.parent / "docs/results/mt20.md").read_text().partition("| class | return | best")[2]
    row = next(line for line in page.splitlines() if line.startswith(f"| {name} |")).split(" | ")
    assert row[1] == f"{result.total:.4g}" and row[3].startswith(f"{result.first_success} of ")
    assert row[4:6] == [f"{result.succeeded} of 10", f"{1000.0 * result.deepest:.1f} mm"]


def test_a_search_of_whole_episodes_never_falls_behind_the_episode_it_began_with(tmp_path: Path) -> None:
    actions = load_witness("HandOver").actions
    seen: list[tuple[float, bool]] = []

    def report(number: int, trace: Trace, best: int) -> None:
        seen.append((float(trace.rewards[:, best].sum()), bool(trace.success[:, best].any())))

    found = whole.searched("HandOver", actions, 2, report=report)
    began, ended = (replay("HandOver", Witness(each, {}), threads=1) for each in (actions, found))
    assert ended.total > began.total - 1.0 and ended.first_success is not None
    assert all(success for _, success in seen) and seen[0][0] >= began.total - 1.0
    assert np.abs(found * LEVELS - np.rint(found * LEVELS)).max() < 1e-4


def test_exchanged_hands_are_each_others_turn_about_the_vertical() -> None:
    actions = random_actions(6).numpy()
    both = whole.exchanged(actions, 2)
    assert np.array_equal(both[:2, :26], actions[:2, :26]) and np.array_equal(both[2:, 26:], actions[2:, 26:])
    turned = both.reshape(6, 2, 26)[:, ::-1].copy()
    turned[:, :, [20, 21, 23, 24]] *= -1.0
    assert np.array_equal(turned.reshape(6, 52), both)


def test_steadying_keeps_an_episode_that_nothing_betters(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_changes(elites: torch.Tensor, count: int, *_: object) -> torch.Tensor:
        return elites[:1].repeat(count, 1, 1)

    monkeypatch.setattr(steady, "mutants", no_changes)
    actions = load_witness("Switch").actions[:20]
    told: list[tuple[int, float]] = []
    found = steady.steadied("Switch", actions, 1, threads=1, report=lambda solved, _, deep: told.append((solved, deep)))
    np.testing.assert_array_equal(found, actions)
    assert told == [(10, 0.0)], "the witness succeeds at its seventh step, from any shifted start, and softly"


def test_steadying_prefers_soft_blows(monkeypatch: pytest.MonkeyPatch) -> None:
    def one_change(elites: torch.Tensor, count: int, *_: object) -> torch.Tensor:
        changed = elites[:1].repeat(count, 1, 1)
        changed[1, :, 20] += 0.05  # the right base is pushed a little along x
        return changed

    monkeypatch.setattr(steady, "mutants", one_change)
    # Rows of all but the changed sequence are told to be deep.
    monkeypatch.setattr(Simulator, "contact_depth", lambda self, row: 0.001 if row % 12 == 1 else 0.02)
    actions = load_witness("Switch").actions[:20]
    found = steady.steadied("Switch", actions, 1, threads=1)
    assert (found != actions).any(axis=0).nonzero()[0].tolist() == [20]


def test_what_a_search_finds_goes_into_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("bidex_meta.witness.steady.steadied", lambda name, actions, *_: actions[:20])
    shipped = witness_path("Switch")
    before = shipped.read_bytes()
    monkeypatch.chdir(tmp_path)
    assert main(["witness", "--task", "switch", "--find", "--improve", str(shipped), "--steady", "1", "--json"]) == 0
    assert "Switch: stored witnesses" in capsys.readouterr().out
    assert len(load_witness("Switch", Path("witnesses/Switch.npz")).actions) == 20
    assert shipped.read_bytes() == before


def test_steady_needs_an_episode(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["witness", "--task", "Switch", "--find", "--steady", "3"]) == 2
    assert "--improve" in capsys.readouterr().err


def test_a_witness_is_played_in_its_order_by_every_row_of_its_class() -> None:
    known = {"A": Witness(np.arange(6, dtype=np.float32).reshape(3, 2) / 8, {})}
    agent = OpenLoop(known, ["A", "B"], torch.tensor([0, 1, 0]), 3)
    obs = torch.zeros(3, 5)
    played = [agent.eval_action(obs) for _ in range(2)]
    assert played[1].tolist() == [[0.25, 0.375, 0.0], [0.0, 0.0, 0.0], [0.25, 0.375, 0.0]]
    agent.reset(torch.tensor([True, True, False]))
    assert agent.eval_action(obs)[:, 0].tolist() == [0.0, 0.0, 0.5]
    for _ in range(4):
        last = agent.eval_action(obs)
    assert last[:, 0].tolist() == [0.5, 0.0, 0.5], "held after its end"


def test_the_baseline_of_witnesses_is_of_the_classes_that_have_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.fakes import ToyWorld

    monkeypatch.setattr(OwnSuite, "world", lambda source: ToyWorld(6, "DISABLED", source.seed))
    first, *_ = ToyWorld(6, "DISABLED", 0).task_names
    size = ToyWorld(6, "DISABLED", 0).single_action_space.shape[0]
    paths_of = {
        first: save_witness(
            tmp_path / "one.npz", np.zeros((2, size), np.float32), {"return": 1.0, "first_success": 0, "rival": None}
        )
    }
    monkeypatch.setattr("bidex_meta.witness.store.witness_path", lambda name: paths_of.get(name, tmp_path / "none"))
    assert main(["baseline", "witness", "--suite", "MT4", "--episodes", "1", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == [first]
