"""Our agents in Meta-World's own evaluation, agents written for it in ours."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from metaworld import evaluation as theirs
from metaworld.env_dict import ALL_V3_ENVIRONMENTS

from bidex_meta import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.evaluation.play import ZeroAgent, evaluate
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.metaworld.adapters import ForMetaWorld, FromMetaWorld, MetaWorldEnvs
from bidex_meta.metaworld.evaluation import known_to_metaworld
from tests.algos.families import Passing
from tests.points import SPEED, Finder, PointWorld, Still, ring


def points(rows=16, **keywords):
    return PointWorld(rows, {"Near": ring(8), "Far": 1.5 * ring(8, 0.5)}, **keywords)


class Native:
    """As one would write it for Meta-World: NumPy, six entries a timestep, each row on its own."""

    def __init__(self, rows: int):
        self.rows, self.calls, self.reset_masks = rows, [], []

    def _called(self, name: str) -> None:
        self.calls += [name] if self.calls[-1:] != [name] else []

    def init(self) -> None:
        self._called("init")
        self.best, self.reward = np.zeros((self.rows, 2)), np.full(self.rows, -np.inf)
        self.told: list[Any] = []

    def reset(self, env_mask: np.ndarray) -> None:
        self._called("reset")
        assert isinstance(env_mask, np.ndarray) and env_mask.dtype == bool
        self.reset_masks.append(env_mask.copy())

    def eval_action(self, obs: np.ndarray) -> np.ndarray:
        self._called("eval_action")
        assert isinstance(obs, np.ndarray)
        return np.clip((self.best - obs[:, :2]) / SPEED, -1, 1)

    def adapt_action(self, obs: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        self._called("adapt_action")
        angle = np.arange(len(obs)) * 2.399 + len(self.told) // 3  # in arcs
        action = np.stack([np.cos(angle), np.sin(angle)], 1)
        return action, {"log_prob": np.zeros(len(obs))}

    def step(self, timestep: Any) -> None:
        self._called("step")
        obs, action, reward, terminated, truncated, aux = timestep
        assert all(isinstance(x, np.ndarray) for x in (obs, action, reward, terminated, truncated, aux["log_prob"]))
        self.told.append((reward.copy(), terminated | truncated))
        better = reward > self.reward
        self.reward = np.where(better, reward, self.reward)
        self.best = np.where(better[:, None], obs[:, :2] + SPEED * np.clip(action, -1, 1), self.best)

    def adapt(self) -> None:
        self._called("adapt")


def test_their_names_are_known_while_it_lasts_and_their_table_is_untouched():
    envs, count = MetaWorldEnvs(points()), len(ALL_V3_ENVIRONMENTS)
    with known_to_metaworld(envs):
        assert theirs._get_task_names(envs) == ["Near"] * 8 + ["Far"] * 8  # type: ignore[arg-type]
        assert len(ALL_V3_ENVIRONMENTS) == count
    assert theirs.ALL_V3_ENVIRONMENTS is ALL_V3_ENVIRONMENTS
    with pytest.raises(KeyError):
        theirs._get_task_names(envs)  # type: ignore[arg-type]


@pytest.mark.parametrize("agent", [Native(16), ForMetaWorld(Finder())], ids=["theirs", "ours"])
def test_adaptation_in_their_evaluation(agent):
    envs = MetaWorldEnvs(points())

    def success(**keywords):
        with known_to_metaworld(envs):
            found = theirs.metalearning_evaluation(agent, envs, num_evals=2, **keywords)  # type: ignore[arg-type]
        assert set(found[2]) == {"Near", "Far"}
        return found

    adapted = success(adaptation_steps=3, adaptation_episodes=2, evaluation_episodes=8)
    plain = success(adaptation_steps=0, evaluation_episodes=8)
    assert plain[0] == 0 and adapted[1] > plain[1]  # their mean return
    assert not envs.terminate_on_success


def test_our_agent_hears_the_order_of_calls_it_knows():
    class Ours(Still):
        def assign(self, task_of_row):
            self._called("assign")
            assert task_of_row is None

    agent = Ours()
    envs = MetaWorldEnvs(points(2, steps=(3, 3)))
    with known_to_metaworld(envs):
        keywords: dict[str, Any] = {"num_evals": 1, "adaptation_episodes": 2, "evaluation_episodes": 1}
        theirs.metalearning_evaluation(ForMetaWorld(agent), envs, **keywords)  # type: ignore[arg-type]
    episode = ["reset", *["adapt_action", "step"] * 3]
    # The last reset of a shot belongs to the episode that Meta-World begins and does not play.
    assert agent.calls == ["assign", "init", *episode, *episode, "reset", "adapt", "reset", "eval_action", "reset"]
    told = agent.steps[0]
    assert isinstance(told.observation, torch.Tensor) and told.observation.dtype == torch.float32
    assert told.valid is None and told.next_observation is None
    assert torch.allclose(told.aux_policy_outputs["double"], 2 * told.action)


def test_their_agent_in_our_evaluation():
    place = points(16, ends=True)
    native = Native(16)
    found = meta_evaluate(FromMetaWorld(native), place, 4, protocol=Protocol(episodes_per_task=2, max_adapt_steps=10))
    assert found.gains().aggregate["return"].value > 0  # type: ignore[union-attr]
    played = ["reset", "eval_action"]
    shot = [*["adapt_action", "step"] * 10, "adapt", *played]
    assert native.calls == ["init", *played * 2, *[*shot, *played] * 4]
    # Each row's episode ends once; after that the row continues without reward and without an end.
    rewards, ends = (np.stack([told[i] for told in native.told[:10]]) for i in (0, 1))
    assert (ends.sum(0) == 1).all()
    after = np.cumsum(ends, 0) - ends > 0
    assert after.any() and (rewards[after] == 0).all()


def test_a_real_world_in_their_evaluation_gives_our_numbers():
    def world():
        return Benchmark("ML1").make_world("train", 3, device="cpu", autoreset_mode="DISABLED", threads=1)

    place = world()
    envs, zero = MetaWorldEnvs(place), ForMetaWorld(ZeroAgent(place.action_space))
    with known_to_metaworld(envs):
        success, mean, _, returns = theirs.evaluation(zero, envs, num_episodes=3)  # type: ignore[arg-type]
    ours = evaluate(ZeroAgent(place.action_space), world(), 1, seed=place.seed).classes["CatchUnderarm"]
    assert (success, returns["CatchUnderarm"]) == (ours.success, pytest.approx(ours.returns.tolist(), rel=1e-5))
    assert mean == pytest.approx(ours.mean_return, rel=1e-5)


def test_where_success_counts_at_the_end_their_evaluation_counts_it_there():
    """A quarter of the episodes hold the goal at the end; the others had held it long enough before, and lost it."""
    envs, zero = MetaWorldEnvs(Passing(16)), ForMetaWorld(ZeroAgent(Passing(16).action_space))
    with known_to_metaworld(envs):
        success, *_ = theirs.evaluation(zero, envs, num_episodes=16)  # type: ignore[arg-type]
    assert success == 0.25
    assert evaluate(ZeroAgent(envs.action_space), Passing(16), 4).classes["PointGoals"].success == 0.25


def test_tasks_are_sampled_in_turns():
    place = points(6)
    envs = MetaWorldEnvs(place)
    for expected in ([0, 1, 2], [3, 4, 5], [6, 7, 0]):
        envs.call("sample_tasks")
        envs.reset()
        assert np.allclose(place.goal[:3], ring(8)[expected], atol=1e-6)
    # The world keeps all its tasks, for the next evaluation.
    assert [len(pool) for pool in place.pools] == [8, 8] and len(np.unique(place.pools[0], axis=0)) == 8


def test_refusals_name_the_mend():
    with pytest.raises(BidexError, match="autoreset_mode='DISABLED'"):
        MetaWorldEnvs(points(mode="SAME_STEP"))
    with pytest.raises(BidexError, match="sample_tasks"):
        MetaWorldEnvs(points()).call("toggle_sample_tasks_on_reset", True)
    with pytest.raises(BidexError, match=r"expected reset\(\) without options"):
        MetaWorldEnvs(points()).reset(options={"reset_mask": np.ones(16, bool)})


@pytest.mark.parametrize("algo", ["maml", "promp", "rl2"])
def test_our_learners_in_their_evaluation(algo):
    kind = learner_kind(algo)
    place = Benchmark("ML1").make_world("test", 12, device="cpu", autoreset_mode="DISABLED", threads=1)
    config = replace(kind.presets["laptop"], hidden=(8,), max_adapt_steps=20)
    state = kind.learner_class(place, config, seed=0).policy_state_dict()
    agent, envs = ForMetaWorld(kind.learner_class.load_policy(state, "cpu")), MetaWorldEnvs(place)
    with known_to_metaworld(envs):
        keywords: dict[str, Any] = {"num_evals": 1, "adaptation_episodes": 1, "evaluation_episodes": 2}
        found = theirs.metalearning_evaluation(agent, envs, **keywords)  # type: ignore[arg-type]
    assert list(found[2]) == ["CatchUnderarm"] and np.isfinite(found[1])
