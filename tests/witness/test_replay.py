import json
from pathlib import Path

import numpy as np
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.runs.versions import collect_versions
from bidex_meta.tasks import registry
from bidex_meta.utils import paths
from bidex_meta.witness.demonstrators import OpenLoopReplay
from bidex_meta.witness.replay import SHIFT, Replay, Simulator, replay, task_slot
from bidex_meta.witness.store import Witness, load_witness, quantised, save_witness, witness_path
from bidex_meta.world import World, WorldConfig
from bidex_meta.worlds.own import OwnSuite
from tests.fakes import ToyWorld


def random_actions(steps: int) -> torch.Tensor:
    return quantised(2.0 * torch.rand(steps, 52, generator=torch.Generator().manual_seed(3)) - 1.0)


@pytest.mark.parametrize("name", ["HandOver", "TwoCatchUnderarm"])
def test_the_simulator_plays_what_the_world_plays(name: str) -> None:
    actions = random_actions(40)
    simulator = Simulator(name, 2, threads=1)
    trace = simulator.play(actions[:, None].expand(-1, 2, -1))
    world = World([task_slot(name)], WorldConfig(1, autoreset_mode="DISABLED", seed=0, threads=1))
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
    assert trace.success[:, 0].tolist() == success and bool(trace.alive[0]) == (not ended)
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
    starts = [simulator._part.group.members[0].scene.qpos[name].start for name in ("object1", "object2")]
    for shift in (other - first for other in others):
        assert set(shift.nonzero().flatten().tolist()) <= {start + i for start in starts for i in (0, 1)}
        for start in starts:
            assert float(shift[start : start + 2].norm()) == pytest.approx(SHIFT, rel=1e-6)
    first, *others = (state["mocap_pos"] for state in Simulator("Switch", 1, threads=1).starts(2))
    for other in others:  # fixtures too
        torch.testing.assert_close((other - first).norm(dim=1), first.new_full((2,), SHIFT), rtol=1e-6, atol=0)


@pytest.mark.parametrize("first, succeeded, found", [(3, 8, True), (3, 7, False), (None, 10, False)])
def test_found_means_the_start_and_eight_of_ten_shifted_ones(first: int | None, succeeded: int, found: bool) -> None:
    assert Replay(0.0, first, succeeded, 0.0).found is found


def test_a_missing_witness_is_not_found(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr("bidex_meta.cli.witness.witness_path", lambda name: tmp_path / name)
    assert main(["witness", "--task", "HandOver", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["found"] is False
    monkeypatch.setattr(paths, "assets_dir", lambda: tmp_path)
    with pytest.raises(BidexError, match=r"HandOver has no witness\. `bidex-meta witness --all`"):
        load_witness("HandOver")


def test_a_file_is_replayed_if_it_is_of_the_class(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "attempt.npz"
    words = ["witness", "--task", "CatchUnderarm", "--json", "--file", str(file)]
    save_witness(file, random_actions(20).numpy(), {"return": 0.0, "rival": 2.5})
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["found"], row["first_success"], row["steps"], row["rival"]) == (False, None, 20, 2.5)
    for columns in (1, 40, 53):
        save_witness(file, np.zeros((20, columns), np.float32), {"return": 0.0})
        assert main(words) == 2
        assert f"(steps, 52), as CatchUnderarm has, got (20, {columns})" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in registry.names() if witness_path(name).is_file()])
def test_every_stored_witness_holds(name: str) -> None:
    witness = load_witness(name)
    result, here = replay(name, witness), collect_versions()
    assert result.found, (
        f"{name}: success {result.first_success}, {result.succeeded} of 10 shifted starts, "
        f"on {here['platform']} with {here['packages']}; made on {witness.made['versions']}"
    )
    page = (Path(__file__).parents[2] / "docs/results/mt20.md").read_text().partition("| class | return | best")[2]
    row = next(line for line in page.splitlines() if line.startswith(f"| {name} |")).split(" | ")
    assert row[1] == f"{result.total:.4g}" and row[3].startswith(f"{result.first_success} of ")
    assert row[4:6] == [f"{result.succeeded} of 10", f"{1000.0 * result.deepest:.1f} mm"]


def test_a_witness_is_played_in_its_order_by_every_row_of_its_class() -> None:
    known = {"A": Witness(np.arange(6, dtype=np.float32).reshape(3, 2) / 8, {})}
    agent = OpenLoopReplay(known, ["A", "B"], torch.tensor([0, 1, 0]), 3)
    obs = torch.zeros(3, 5)
    played = [agent.eval_action(obs) for _ in range(2)]
    assert played[1].tolist() == [[0.25, 0.375, 0.0], [0.0, 0.0, 0.0], [0.25, 0.375, 0.0]]
    agent.reset(torch.tensor([True, True, False]))
    assert agent.eval_action(obs)[:, 0].tolist() == [0.0, 0.0, 0.5]
    for _ in range(4):
        last = agent.eval_action(obs)
    assert last[:, 0].tolist() == [0.5, 0.0, 0.5], "held after its end"


def test_the_baseline_of_witnesses_is_of_the_classes_that_have_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(OwnSuite, "world", lambda source: ToyWorld(6, "DISABLED", source.seed))
    world = ToyWorld(6, "DISABLED", 0)
    first, actions = world.task_names[0], np.zeros((2, *world.single_action_space.shape), np.float32)
    save_witness(tmp_path / first, actions, {"return": 1.0, "first_success": 0, "rival": None})
    for module in ("witness.store", "experiments.baselines"):
        monkeypatch.setattr(f"bidex_meta.{module}.witness_path", lambda name: tmp_path / name)
    assert main(["baseline", "witness", "--suite", "MT4", "--episodes", "1", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == [first]
