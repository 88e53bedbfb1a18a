import json
from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import filming
from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.evaluation.filming import film_row, film_tiles
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent, evaluate, play_tasks
from bidex_meta.evaluation.references import Reference
from bidex_meta.evaluation.results import MANY_TASKS, ClassResult, Evaluation, compare
from bidex_meta.experiments.metatest import Options
from bidex_meta.worlds import open_worlds
from tests.algos.families import Passing
from tests.fakes import STEPS_OF_TASK, Seeker, ToyWorld


def result(returns, reference=None):
    returns = np.asarray(returns, np.float64)
    return ClassResult(
        returns, returns > 0, np.ones(len(returns), np.int64), np.zeros(len(returns), np.int64), 0, reference
    )


@pytest.mark.parametrize("rows", [6, 8, 12, 30])
def test_every_task_is_played_equally_often_whatever_the_rows_and_lengths(rows):
    found = evaluate(Seeker(), ToyWorld(rows, "DISABLED"), episodes_per_task=3)
    for name, tasks in (("Near", 3), ("Far", 2)):
        counts = np.bincount(found.classes[name].tasks, minlength=tasks)
        assert counts.tolist() == [3] * tasks
        assert found.classes[name].lengths.tolist() == [STEPS_OF_TASK[t] for t in found.classes[name].tasks]


def test_return_is_the_sum_of_unscaled_rewards_until_the_episode_ends():
    world = ToyWorld(6, "DISABLED")
    found = evaluate(ZeroAgent(world.action_space), world, episodes_per_task=1, seed=5)
    obs, _ = ToyWorld(6, "DISABLED").reset(seed=5)
    distance = (obs[:, 0] - obs[:, 1]).abs()
    expected = world.max_episode_steps * (1 - distance)
    # Rows 0-2 play Near's three tasks and rows 3 and 4 Far's two; row 5 repeats Far's first task and is left out.
    assert np.allclose(found.classes["Near"].returns, expected[:3].numpy())
    assert np.allclose(found.classes["Far"].returns, expected[3:5].numpy())


def test_success_counts_any_step_and_is_kept_by_name():
    found = evaluate(Seeker(), ToyWorld(6, "DISABLED"), episodes_per_task=2)
    assert list(found.classes) == ["Near", "Far"]
    assert found.classes["Near"].success == 1.0
    zero = evaluate(ZeroAgent(ToyWorld(6, "DISABLED").action_space), ToyWorld(6, "DISABLED"), 2)
    assert zero.classes["Far"].success == 0.0


def test_agent_is_told_which_rows_begin():
    seeker = Seeker()
    evaluate(seeker, ToyWorld(8, "DISABLED"), episodes_per_task=3)
    # Near has 4 rows for 3 tasks, of which tasks 1 and 2 have one row each, so it needs three rounds.
    assert len(seeker.masks) == 3
    assert seeker.masks[0].all()
    assert seeker.masks[2].tolist() == [False, True, True, False, False, False, False, False]


def test_same_seed_same_evaluation():
    def once():
        world = ToyWorld(6, "DISABLED")
        return evaluate(RandomAgent(world.action_space, 3), world, 4, seed=1).to_json()

    assert once() == once()
    json.dumps(once(), allow_nan=False)


def test_python_and_the_commands_play_the_same_starts():
    """Whatever seed the world was made with."""
    found = []
    for seed in (0, 5):
        place = ToyWorld(6, "DISABLED")
        place.reset(seed=seed)
        found.append(evaluate(ZeroAgent(place.action_space), place, 1).to_json())
    options = Options(episodes=1)
    protocol = open_worlds({"suite": "MT4"}).protocol("train", options.episodes, options.seed)
    for seed in (EVALUATION_SEED, protocol.seed):
        place = ToyWorld(6, "DISABLED")
        found.append(evaluate(ZeroAgent(place.action_space), place, 1, seed=seed).to_json())
    place = ToyWorld(6, "DISABLED")
    found.append(evaluate(ZeroAgent(place.action_space), place, protocol=protocol).to_json())
    assert all(each == found[0] for each in found)


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"split": "tests"}, "split: expected one of train, test, others, got 'tests'."),
        ({"seed": -1}, "seed: expected a whole number from 0 on, got -1."),
        ({"shots": 1.0}, "shots: expected a whole number from 0 on, got 1.0."),
        ({"trials": None}, "trials: expected a whole number from 1 to 1000000, got None."),
        ({"episodes_per_task": 0}, "episodes_per_task: expected a whole number from 1 to 1000000, got 0."),
    ],
)
def test_a_protocol_refuses_what_cannot_be_played(entries, told):
    with pytest.raises(BidexError) as error:
        Protocol(**entries)
    assert str(error.value) == told
    with pytest.raises(BidexError, match="plays all tasks of a world, got a protocol with tasks=2"):
        evaluate(Seeker(), ToyWorld(6, "DISABLED"), protocol=Protocol(tasks=2))


def test_random_agent_is_uniform_and_ignores_torchs_global_generator():
    space = ToyWorld(5000, "DISABLED").action_space
    torch.manual_seed(0)
    first = RandomAgent(space, 1).eval_action(torch.zeros(5000, 2))
    torch.manual_seed(7)
    assert torch.equal(first, RandomAgent(space, 1).eval_action(torch.zeros(5000, 2)))
    assert first.shape == (5000, 1)
    assert first.min() >= -1
    assert first.max() <= 1
    assert abs(first.mean()) < 0.05
    assert abs(first.std() - 3**-0.5) < 0.02


def test_refusals_name_the_mend():
    drawing = make_task_world("Switch-v2", 4, "cpu", threads=1, autoreset_mode="DISABLED", task_sampling="uniform")
    with pytest.raises(BidexError, match='task_sampling="fixed"'):
        evaluate(Seeker(), drawing, 1)
    with pytest.raises(BidexError, match="DISABLED"):
        evaluate(Seeker(), ToyWorld(6, "SAME_STEP"), 1)
    with pytest.raises(BidexError, match="num_envs=6"):
        evaluate(Seeker(), ToyWorld(4, "DISABLED"), 1)
    with pytest.raises(BidexError, match="whole number from 1"):
        evaluate(Seeker(), ToyWorld(6, "DISABLED"), 0)


@pytest.mark.parametrize("tasks", [MANY_TASKS - 1, MANY_TASKS, 50])
def test_episodes_played_over_and_over_feign_no_precision(tasks):
    """Four equal episodes of every task tell no more than one of each: unless tasks are few."""
    task = np.tile(np.arange(tasks), 4)
    once = np.random.default_rng(tasks).normal(3.0, 1.0, tasks)
    found = ClassResult(once[task], once[task] > 3, np.ones(len(task), np.int64), task, 0)
    single = ClassResult(once, once > 3, np.ones(tasks, np.int64), np.arange(tasks), 0)
    same = found.summary().return_interval == pytest.approx(single.summary().return_interval)
    assert same == (tasks >= MANY_TASKS)
    assert found.drawn(found.returns).mean() == pytest.approx(found.mean_return)


def test_compare_tells_a_difference_from_noise():
    generator = np.random.default_rng(1)
    noise, other = generator.normal(0, 1, 100), generator.normal(0, 1, 100)
    same = compare(Evaluation({"A": result(noise)}, 4), Evaluation({"A": result(other)}, 4))["A"]
    better = compare(Evaluation({"A": result(noise + 2)}, 4), Evaluation({"A": result(other)}, 4))["A"]
    assert not same.excludes_zero
    assert better.excludes_zero
    assert better.value == pytest.approx(same.value + 2)
    assert better.interval is not None
    assert better.interval[0] < better.value < better.interval[1]


def test_score_needs_both_references_and_all_classes():
    scored = result([1.0, 3.0], Reference(random=1.0, expert=5.0))
    assert scored.score == pytest.approx(25.0)
    assert result([1.0, 3.0]).score is None
    both = Evaluation({"A": scored, "B": result([1.0])}, 2).to_json()
    assert both["aggregate"]["score"] is None
    assert both["classes"]["A"]["score"] == pytest.approx(25.0)


class Watcher(ZeroAgent):
    """Keeps the transitions that it is shown."""

    def __init__(self, world: Any) -> None:
        super().__init__(world.action_space)
        self.seen: list[Any] = []

    def observe(self, timestep: Any) -> None:
        self.seen.append((timestep.reward.tolist(), timestep.valid.tolist(), timestep.next_observation.tolist()))


@pytest.mark.parametrize("tiled", [True, False])
def test_a_film_shows_the_agent_the_transitions_that_an_evaluation_shows(tiled: bool) -> None:
    """Until the first episode ends; without tiles also after it, where ended episodes have no valid transitions."""
    world: Any = ToyWorld(5, "DISABLED")
    evaluated, filmed = Watcher(world), Watcher(world)
    play_tasks(evaluated, world, 1, seed=0)
    steps = min(STEPS_OF_TASK) if tiled else max(STEPS_OF_TASK)
    longest = int(world.max_episode_steps.argmax())
    if tiled:
        list(film_tiles(filmed, world, [0, 1], steps, seed=0, width=8, height=6))
    else:
        list(film_row(filmed, world, longest, steps, seed=0, width=8, height=6))
    assert len(filmed.seen) == steps and filmed.seen == evaluated.seen[:steps]


@pytest.mark.parametrize("at_end", [True, False])
def test_a_name_is_green_while_the_episode_counts_as_a_success(monkeypatch: pytest.MonkeyPatch, at_end: bool) -> None:
    """Environment 0 holds the goal from step 5 to the end, environment 1 from step 2 to 17; an episode has 20 steps."""
    world: Any = Passing(4)
    world.success_at_end = at_end
    world.render = lambda env_id, width, height: np.zeros((height, width, 3), np.uint8)
    shown: list[list[bool]] = []
    monkeypatch.setattr(filming, "tiled", lambda pictures, names, done: shown.append(done))
    list(film_tiles(ZeroAgent(world.action_space), world, [0, 1], 25, seed=0, width=8, height=6))
    held, passing = ([step for step, done in enumerate(shown) if done[i]] for i in (0, 1))
    if at_end:
        assert (held, passing) == ([19], [16, 17])  # an ended episode has given way to the next one
    else:
        assert (held, passing) == ([*range(5, 20), 25], [*range(2, 20), *range(22, 26)])
