"""Meta-World as a foreign world: its contract, and oracles that no one here wrote: its environments, its scripts."""

import json
import sys
from pathlib import Path
from typing import Any

import metaworld as library
import numpy as np
import pytest
import torch
from metaworld.env_dict import MT10_V3
from metaworld.policies import ENV_POLICY_MAP
from torch import Tensor

from bidex_algos.onpolicy.mtppo import PRESETS
from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import RandomAgent, evaluate
from bidex_meta.metaworld import batched
from bidex_meta.metaworld import library as client
from bidex_meta.metaworld.batched import MetaWorldWorld, evaluate_all_tasks
from bidex_meta.runs import RunFolder
from bidex_meta.suite_files import METAWORLD_SUITES
from tests.world.play import assert_same, play

ROWS = 6
SHORT = 40  # steps of an episode where a test is about its end


def make(rows: int = ROWS, mode: str = "SAME_STEP", seed: int = 0, suite: str = "metaworld/MT3") -> MetaWorldWorld:
    return MetaWorldWorld(suite, rows, seed=seed, autoreset_mode=mode)


def actions(world: MetaWorldWorld, steps: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2.0 * torch.rand(steps, world.num_envs, 4, generator=generator) - 1.0


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batched, "EPISODE_STEPS", SHORT)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batched, "TASKS_PER_CLASS", 3)


class Scripts:
    """Meta-World's own scripted policies."""

    def __init__(self, world: MetaWorldWorld) -> None:
        self.policies = [ENV_POLICY_MAP[world.task_names[i]]() for i in world.task_id.tolist()]

    def eval_action(self, obs: Tensor) -> Tensor:
        numbers = [p.get_action(o) for p, o in zip(self.policies, obs[:, :39].double().numpy(), strict=True)]
        return torch.tensor(np.clip(numbers, -1, 1), dtype=torch.float32)

    def reset(self, env_mask: Tensor) -> None: ...


def test_suites_are_those_of_the_library() -> None:
    assert METAWORLD_SUITES["metaworld/MT10"] == tuple(MT10_V3)
    assert set(METAWORLD_SUITES["metaworld/MT3"]) < set(MT10_V3)
    tasks = client.make_tasks("metaworld/MT3", 0)
    assert all(len(set(pool)) == client.TASKS_PER_CLASS for pool in tasks.values())
    assert client.make_tasks("metaworld/MT3", 1) != tasks
    world = make(10, suite="metaworld/MT10")
    assert world.reset(seed=0)[0].shape == (10, 49) and world.task_names == list(MT10_V3)
    assert all(step["obs"].isfinite().all() for step in play(world, actions(world, 3)))


def test_a_row_is_the_library_s_environment() -> None:
    world = make(3, "DISABLED")
    world.set_tasks({name: [7] for name in world.task_names})
    obs, _ = world.reset(seed=0)
    for row, (name, pool) in enumerate(client.make_tasks("metaworld/MT3", 0).items()):
        env: Any = library.ALL_V3_ENVIRONMENTS[name]()
        env.set_task(pool[7])
        expected = [env.reset()[0]]
        steps = [env.step(action) for action in actions(world, 40)[:, row].numpy()]
        expected += [step[0] for step in steps]
        world.reset()
        found = [obs[row, :39]]
        for action, step in zip(actions(world, 40), steps, strict=True):
            new, reward, _, _, info = world.step(action)
            found.append(new[row, :39])
            assert (float(reward[row]), bool(info["success"][row])) == (np.float32(step[1]), bool(step[4]["success"]))
        assert torch.equal(torch.stack(found), torch.tensor(np.array(expected), dtype=torch.float32))


def test_the_library_s_scripts_solve_its_tasks_here() -> None:
    world = make(ROWS, "DISABLED")
    scripts, solved = Scripts(world), torch.zeros(ROWS, dtype=torch.bool)
    obs, _ = world.reset(seed=0)
    for _ in range(500):
        obs, _, _, _, info = world.step(scripts.eval_action(obs))
        solved |= info["success"]
        if solved.all():
            break
    assert solved.all()


def test_episodes_draw_tasks_and_first_ones_are_shortened(short: None) -> None:
    world = make(30)
    world.reset(seed=0)
    first = world.task_index.clone()
    assert len(first.unique()) > 10
    world.reset()
    assert (world.task_index != first).sum() > 20 and (world.episodes.elapsed == 0).all()
    fixed = make(ROWS, "DISABLED")
    fixed.reset(seed=0)
    assert fixed.task_index.tolist() == [0, 1] * 3 and (fixed.episodes.elapsed == 0).all()


def test_numpys_generator_is_left_alone() -> None:
    before = np.random.get_state()
    world = make()
    world.reset(seed=5)
    play(world, actions(world, 3))
    client.make_tasks.__wrapped__("metaworld/MT3", 0)  # Meta-World seeds NumPy's generator to draw tasks
    assert all(np.array_equal(x, y) for x, y in zip(before, np.random.get_state(), strict=True))


def test_environments_do_not_affect_each_other(short: None) -> None:
    many, single, rows = make(12), make(3), [0, 4, 8]
    many.reset(seed=0), single.reset(seed=0)
    wide = actions(many, 60)
    assert_same(play(many, wide), play(single, wide[:, rows]), rows, slice(None))


def test_broken_physics_and_broken_actions_end_their_row_alone() -> None:
    world, other = make(), make()
    world.reset(seed=0), other.reset(seed=0)
    first = actions(world, 10)
    assert_same(play(world, first), play(other, first))
    before = world.state_dict()["observation"]
    world._singles[0]._env.data.qvel[0] = np.nan
    action = actions(world, 1, seed=1)[0]
    bad = action.clone()
    bad[2, 1] = torch.inf
    broken, sound = play(world, [bad])[0], play(other, [action])[0]
    rows = [0, 2]
    assert broken["info/unstable"].nonzero().squeeze(1).tolist() == rows
    assert broken["truncated"][rows].all() and broken["info/_final_obs"][rows].all()
    assert torch.equal(broken["info/final_obs"][rows], before[rows]) and broken["obs"].isfinite().all()
    assert_same([broken], [sound], [1, 3, 4, 5])
    after = actions(world, 10, seed=2)
    steps = play(world, after)
    assert not any(step["info/unstable"].any() for step in steps)
    assert_same(steps, play(other, after), [1, 3, 4, 5])


def test_evaluate_plays_each_task_once(short: None, few: None) -> None:
    world = make(ROWS, "DISABLED")
    found = evaluate_all_tasks(Scripts(world), world, 1, seed=4)
    assert list(found.classes) == world.task_names
    for result in found.classes.values():
        assert result.tasks.tolist() == [0, 1, 2] and result.lengths.tolist() == [SHORT] * 3
        assert result.reference is None and result.unstable == 0
    world.set_tasks({name: [0, 1] for name in world.task_names})
    two = evaluate(Scripts(world), world, 2, seed=4).classes["reach-v3"]
    assert two.returns.tolist() == [*found.classes["reach-v3"].returns[:2]] * 2  # a task fixes its start
    random = evaluate_all_tasks(RandomAgent(world.action_space), world, 1).classes["reach-v3"]
    assert random.mean_return < found.classes["reach-v3"].mean_return


RUN = ["run", "--suite", "metaworld/MT3", "--num-envs", "6", "--threads", "1", "--device", "cpu"]
RUN += ["--learner.hidden", "16", "--learner.rollout-steps", "20"]


def test_a_run_trains_evaluates_and_resumes(short, few, tmp_path, capsys):
    whole, part = str(tmp_path / "whole"), str(tmp_path / "part")
    assert main([*RUN, "--steps", "480", "--run-dir", whole]) == 0
    assert "Preset metaworld: the suite is Meta-World's." in capsys.readouterr().err
    report = json.loads((tmp_path / "whole" / "evaluation.json").read_text())
    assert "Train/return/reach-v3" in (tmp_path / "whole" / "metrics.jsonl").read_text()
    assert report["policy"]["classes"]["reach-v3"]["episodes"] == 3 and report["policy"]["aggregate"]["score"] is None
    assert main([*RUN, "--steps", "240", "--run-dir", part, "--no-evaluate"]) == 0
    assert main(["run", "--resume", part, "--steps", "480", "--no-evaluate"]) == 0
    ends = [RunFolder.open(Path(path)).checkpoints.load() for path in (whole, part)]
    assert ends[0] is not None and ends[1] is not None and ends[0][1] == ends[1][1] == 480
    weights = [end[0]["learner"]["policy"]["weights"] for end in ends if end]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    capsys.readouterr()
    assert main(["evaluate", part, "--json", "--device", "cpu"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"] == report["policy"]
    assert main(["evaluate", part, "--split", "test"]) == 2
    assert "only the split train" in capsys.readouterr().err


def test_defaults_follow_the_suite(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--suite", "metaworld/MT10", "--print-config"]) == 0
    config = json.loads(capsys.readouterr().out)
    assert (config["num_envs"], config["preset"], config["device"]) == (40, "metaworld", "cpu")
    assert config["learner"]["gamma"] == PRESETS["metaworld"].gamma
    assert main(["list", "suites", "--json"]) == 0
    listed = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert listed["metaworld/MT3"]["train_classes"] == list(METAWORLD_SUITES["metaworld/MT3"])


def test_misuse_is_refused() -> None:
    world = make()
    with pytest.raises(BidexError, match="Did you mean 'reach-v3'"):
        world.set_tasks({"reach": [0]})
    with pytest.raises(BidexError, match="from 0 to 49"):
        world.set_tasks({"reach-v3": [50]})
    world.reset(seed=0)
    with pytest.raises(BidexError, match="seed of tasks 0, here 1; build the world with the same"):
        make(seed=1).load_state_dict(world.state_dict())


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "metaworld", None)
    client._library.cache_clear()
    with pytest.raises(BidexError, match="pip install metaworld"):
        client.Single("reach-v3")
