"""What broken episodes count for, and what doing nothing, doing anything and breaking physics score."""

import json
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.cli.tables import evaluation_table
from bidex_meta.evaluation import references
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.references import Reference, counted_returns
from bidex_meta.evaluation.results import Evaluation, results_by_class
from bidex_meta.tasks import registry
from tests.fakes import run_config
from tests.points import Finder, PointWorld, Still, ring
from tests.tasks.worlds import mixed_world
from tests.world.play import class_world


class Breaker:
    """Does nothing for some steps of every episode, then emits NaN."""

    def __init__(self, after: int, actions: int = 52) -> None:
        self.after, self.actions, self.steps = after, actions, 0

    def eval_action(self, obs: Tensor) -> Tensor:
        self.steps += 1
        return torch.full((len(obs), self.actions), math.nan if self.steps > self.after else 0.0)

    def reset(self, env_mask: Tensor) -> None:
        self.steps = 0


@pytest.fixture(scope="module", params=[0, 3])
def broken(request: pytest.FixtureRequest) -> Evaluation:
    """All classes, in every episode of which an agent breaks a row, at once or after some steps."""
    world = mixed_world(4)
    return evaluate(Breaker(request.param), world, 1, seed=0)


@pytest.mark.parametrize("name", registry.names())
def test_an_agent_that_breaks_physics_gets_nothing_for_it(name: str, broken: Evaluation) -> None:
    found, known = broken.classes[name], references.references()[name]
    assert found.unstable == found.episodes == 4 and found.lengths.max() <= 4
    assert found.success == 0.0 and found.mean_return <= known.random
    assert found.score is None or found.score <= 1.0


@pytest.mark.parametrize(("name", "known"), [("ReOrientation", True), ("HandOver", False)])
def test_stored_references_are_those_of_moving_bases(name: str, known: bool) -> None:
    world = class_world(name, 2, "DISABLED")
    world.set_tasks({name: world.pools[0][:2]})
    expected = references.references()[name] if known else None
    (shot,) = meta_evaluate(Breaker(0, world.action_size), world, 0, protocol=Protocol(episodes_per_task=1)).by_shot
    for found in (shot, evaluate(Breaker(0, world.action_size), world, 1)):
        assert found.classes[name].reference == expected
        assert found.classes[name].mean_return == (expected.random if expected else 0.0)
    assert evaluate(Breaker(0, world.action_size), world, 1, references={}).classes[name].reference is None


@pytest.mark.parametrize("name", registry.names())
def test_the_score_of_version_2_needs_no_expert(name: str) -> None:
    """References of version 2 are stored, and an untrained policy gets less than the reward of every step."""
    task = registry.get(f"{name}-v2", moving_base=True)
    (known,) = references.references_for({name: task}).values()
    stored = [references.load(kind)[f"{name}-v2"]["return"] for kind in ("random", "zero")]
    assert [known.random, known.zero] == stored and all(0.0 < value < 0.95 * task.episode_steps for value in stored)
    assert known.scores(np.array([0.0, task.episode_steps])).tolist() == [0.0, 100.0]


def test_scores_of_version_2_are_the_mean_reward_per_step() -> None:
    world = class_world("Switch-v2", 2, "DISABLED")
    world.set_tasks({"Switch-v2": world.pools[0][:2]})
    found = evaluate(ZeroAgent(world.action_space), world, 1)
    row = found.summary().classes["Switch-v2"]
    assert row.episode_steps == row.length and row.score == pytest.approx(100 * row.mean_return / row.length)
    assert references.rescored({"Switch-v2": row}, run_config(base="moving"))["Switch-v2"] == row


def test_a_slot_of_a_listed_task_has_the_score_of_its_class_in_version_2_alone() -> None:
    episodes = {"slot": np.zeros(2, int), "task": np.arange(2), "return": np.array([3.0, 5.0])}
    episodes |= {"success": np.ones(2, bool), "length": np.array([8, 8]), "unstable": np.zeros(2, bool)}
    for reference, score in ((Reference(0.0, episode_steps=8), 50.0), (Reference(0.0, 8.0), None)):
        assert results_by_class(["A/left"], episodes, {"A": reference})["A/left"].score == score
        assert results_by_class(["A"], episodes, {"A": reference})["A"].score == 50.0


def test_the_zero_of_the_score_is_the_better_of_random_and_zero_actions() -> None:
    assert Reference(1.0, 11.0).scores(np.array([1.0, 6.0])) == pytest.approx([0.0, 50.0])
    assert Reference(1.0, 11.0, 6.0).scores(np.array([1.0, 6.0, 11.0])) == pytest.approx([-100.0, 0.0, 100.0])
    assert Reference(1.0, 11.0, -5.0).floor == 1.0
    assert Reference(1.0, 5.0, 6.0).scores(np.array([5.0])) is None
    assert Reference(1.0).scores(np.array([5.0])) is None


def test_broken_episodes_count_with_the_random_return_or_the_worst_finished_one_or_their_own_if_lower() -> None:
    returns, broken = np.array([5.0, 0.0, -9.0, 7.0]), np.array([False, True, True, True])
    counted = counted_returns(returns, broken, Reference(-4.0, 10.0, 3.0), np.array([5.0]))
    assert counted.tolist() == [5.0, -4.0, -9.0, -4.0]
    returns, broken = np.array([5.0, 2.0, 9.0, 1.0]), np.array([False, False, True, True])
    assert counted_returns(returns, broken, None, returns[~broken]).tolist() == [5.0, 2.0, 2.0, 1.0]
    assert counted_returns(returns, np.ones(4, bool), None, np.zeros(0)).tolist() == returns.tolist()


def rows(breaks: tuple[int, ...]) -> PointWorld:
    return PointWorld(10, {"Near": ring(5), "Far": 2 * ring(5)}, breaks=breaks, noise=0.0)


def test_rows_that_break_change_no_other_episode_and_are_counted() -> None:
    known = {"Near": Reference(-100.0, 0.0)}
    whole = evaluate(Still(), rows(()), 1, references=known)
    found = evaluate(Still(), rows((1, 7)), 1, references=known)
    near, far = found.classes["Near"], found.classes["Far"]
    assert near.returns[1] == -100.0 and near.lengths[1] == 2
    finished = whole.classes["Far"].returns[np.arange(5) != 2]
    assert far.returns[2] == finished.min()
    for name, row in (("Near", 1), ("Far", 2)):
        rest = np.arange(5) != row
        assert np.array_equal(found.classes[name].returns[rest], whole.classes[name].returns[rest])
    told = found.to_json()["classes"]
    assert (told["Near"]["unstable"], told["Far"]["unstable"]) == (1, 1)
    json.dumps(told, allow_nan=False)
    assert "physics broke" in str(evaluation_table("", found).caption)
    assert "physics broke" not in str(evaluation_table("", whole).caption)


def test_a_success_before_the_break_is_none() -> None:
    episodes = {"slot": np.zeros(2, int), "task": np.arange(2), "return": np.array([3.0, 4.0])}
    episodes |= {"success": np.array([True, True]), "length": np.array([9, 4]), "unstable": np.array([False, True])}
    found = results_by_class(["A"], episodes)["A"]
    assert found.successes.tolist() == [1.0, 0.0] and found.returns.tolist() == [3.0, 3.0] and found.unstable == 1


def test_a_meta_test_counts_broken_episodes_alike_in_every_shot() -> None:
    """Without a reference the worst finished episode of all shots, so that breaking later gains nothing."""
    found = meta_evaluate(Finder(), rows((0, 5)), 1, protocol=Protocol(rollouts=1, episodes_per_task=1))
    for name in ("Near", "Far"):
        shots = [shot.classes[name] for shot in found.by_shot]
        worst = min(shot.returns[1:].min() for shot in shots)
        assert [shot.returns[0] for shot in shots] == [worst, worst]
        assert [shot.unstable for shot in shots] == [1, 1]


def test_a_baseline_has_no_reference_yet() -> None:
    """Its broken episodes count with its worst finished one, else the reference would be better for each of them."""
    for agent in (RandomAgent, ZeroAgent):
        world = rows((3,))
        found = evaluate(agent(world.action_space), world, 2).classes["Near"]
        assert found.unstable == 2 and (found.returns[found.tasks == 3] == found.returns.min()).all()
