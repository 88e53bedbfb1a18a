import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from bidex_meta import Benchmark
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import meta_test
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.gains import paired_gains
from bidex_meta.evaluation.play import RandomAgent, evaluate
from bidex_meta.evaluation.references import Reference
from bidex_meta.evaluation.results import ClassResult, Evaluation
from bidex_meta.evaluation.trial_agents import AdaptingTrialAgent
from bidex_meta.experiments import metatest
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.run_config import resolve
from bidex_meta.metaworld.adapters import FromMetaWorld
from bidex_meta.suite import SPLITS
from bidex_meta.worlds import open_worlds
from tests.fakes import ToyWorld
from tests.points import Climber, Finder, PointWorld, Still, ring


def world(rows=12, near=3, far=2, **keywords):
    return PointWorld(rows, {"Near": ring(near), "Far": 2 * ring(far, 0.5)}, **keywords)


def meta_evaluate(agent, place, shots=None, *, protocol=Protocol(), **given):  # noqa: B008
    """Call ``meta_evaluate`` with a protocol of some entries."""
    entries = {name: given.pop(name) for name in given.keys() & vars(protocol).keys()}
    return meta_test.meta_evaluate(agent, place, shots, protocol=replace(protocol, **entries), **given)


def short_names(agent):
    names = {"eval_action": "eval", "adapt_action": "explore"}
    return [names.get(call, call) for call in agent.calls]


def test_adaptation_that_helps_shows_with_an_interval_above_zero():
    found = meta_evaluate(Finder(), world(24), 2, rollouts=4, seed=3)
    gains = found.gains()
    assert len(found.by_shot) == 3
    for name in ("Near", "Far"):
        gain = gains.classes[name]["return"]
        assert gain is not None and gain.interval is not None
        assert 0 < gain.interval[0] < gain.value < gain.interval[1]
        assert gain.value == pytest.approx(
            found.after.classes[name].mean_return - found.before.classes[name].mean_return
        )
    both = gains.aggregate["return"]
    assert both is not None and both.excludes_zero
    assert both.value == pytest.approx(np.mean([g["return"].value for g in gains.classes.values()]))  # type: ignore
    assert found.before.classes["Near"].success == 0 < found.after.classes["Near"].success


def test_an_agent_that_does_not_change_gains_exactly_nothing():
    found = meta_evaluate(Still(), world(), 2, seed=1)
    for shot in (1, 2):
        for measures in (*found.gains(shot).classes.values(), found.gains(shot).aggregate):
            for measure in ("return", "success"):
                gain = measures[measure]
                assert gain is not None and (gain.value, gain.interval) == (0.0, (0.0, 0.0))


def test_without_adaptation_it_is_the_plain_evaluation():
    found = meta_evaluate(Still(), world(), 1, episodes_per_task=3, seed=5).before
    plain = evaluate(Still(), world(), 3, seed=5)
    assert found.to_json() == plain.to_json()
    random = meta_evaluate(RandomAgent(world().action_space), world(), 0, seed=5)
    assert len(random.by_shot) == 1 and random.adapt_steps == []


def test_the_order_of_calls():
    agent = Still()
    meta_evaluate(agent, world(10), 2, rollouts=1, episodes_per_task=1)
    judged = ["reset", "eval"]
    round_ = ["reset", *["explore", "step"] * 12]
    assert short_names(agent) == ["assign", "init", *judged, *[*round_, "adapt", *judged] * 2]


def test_rows_of_a_task_share_it_and_its_rollouts_are_split_over_them():
    agent = Still()
    found = meta_evaluate(agent, world(14), 1, rollouts=3, episodes_per_task=2)
    # Each class has seven rows: Near plays two tasks at a time, Far one.
    assert agent.of_row.tolist() == [0, 1, 0, 1, 0, 1, 0] + [2] * 7
    valid = torch.stack([told.valid for told in agent.steps if told.valid is not None]).sum(0)
    portions = 2
    assert valid.tolist() == [8 * portions] * 6 + [0] + [12 * portions] * 3 + [0] * 4
    assert found.rollouts == 3
    assert found.adapt_steps == [portions * (6 * 8 + 3 * 12)]


def test_more_rollouts_than_rows_take_several_rounds():
    agent = Still()
    found = meta_evaluate(agent, world(6, 3, 3), 1, rollouts=5, episodes_per_task=1)
    assert found.rollouts == 5
    # One task is played at a time, in three rows each: a round of three and a round of two between two evaluations.
    assert found.adapt_steps == [3 * 5 * (8 + 12)]
    assert [int(mask.sum()) for mask in agent.masks[:4]] == [2, 6, 4, 2]


@pytest.mark.parametrize("rows", [4, 6, 10, 16])
def test_every_task_is_played_equally_often_though_success_ends_episodes_early(rows):
    place = world(rows, ends=True)
    found = meta_evaluate(Finder(), place, 2, rollouts=2, episodes_per_task=3)
    for shot in found.by_shot:
        assert np.bincount(shot.classes["Near"].tasks).tolist() == [3, 3, 3]
        assert np.bincount(shot.classes["Far"].tasks).tolist() == [3, 3]
    assert found.after.classes["Near"].lengths.mean() < found.before.classes["Near"].lengths.mean()


def test_frozen_cut_and_broken_rows_are_not_valid():
    agent = Still()
    meta_evaluate(agent, world(10, ends=True, breaks=(1,)), 1, rollouts=1, max_adapt_steps=9, episodes_per_task=1)
    assert len(agent.steps) == 9  # Far's twelve steps are cut
    over = torch.zeros(10, dtype=torch.bool)
    for number, told in enumerate(agent.steps, 1):
        assert told.valid is not None and told.next_observation is not None
        broken = torch.arange(10) == 1 if number == 2 else torch.zeros(10, dtype=torch.bool)
        playing = ~over & (torch.arange(10) < 3) | ~over & (torch.arange(10) >= 5) & (torch.arange(10) < 7)
        assert torch.equal(told.valid, playing & ~broken)
        over |= told.terminated | told.truncated
        assert not (told.terminated & told.truncated).any()
        assert torch.equal(told.aux_policy_outputs["double"], 2 * told.action)
    assert agent.steps[8].truncated[5:7].all() and agent.steps[7].truncated[0] and not agent.steps[7].truncated[5]
    # The next observation belongs to the same episode; for the last step it is the final one.
    for told, after in zip(agent.steps, agent.steps[1:], strict=False):
        assert told.next_observation is not None and torch.equal(told.next_observation, after.observation)


def test_starts_of_adaptation_are_others_and_all_are_reproducible():
    def starts(seed):
        place = world()
        meta_evaluate(Still(), place, 2, seed=seed, episodes_per_task=1)
        return place.starts

    one, again, other = starts(1), starts(1), starts(2)
    assert all(torch.equal(a, b) for a, b in zip(one, again, strict=True))
    before, shot1, after1, shot2, after2 = one
    assert torch.equal(before, after1) and torch.equal(before, after2)
    different = [before, shot1, shot2, *other[:2], other[3]]
    assert len({tuple(part.flatten().tolist()) for part in different}) == 6


def test_data_come_from_the_other_world_with_the_same_starts():
    place, elsewhere = world(60), world(60)
    elsewhere.set_tasks({"Near": -ring(3), "Far": -2 * ring(2, 0.5)})
    own_agent, foreign_agent = Finder(), Finder()
    own = meta_evaluate(own_agent, place, 1, episodes_per_task=1, seed=2)
    foreign = meta_evaluate(foreign_agent, place, 1, episodes_per_task=1, seed=2, adapt_world=elsewhere)
    assert len(place.starts) == 3 + 2 and len(elsewhere.starts) == 1
    assert torch.equal(elsewhere.starts[0], place.starts[1])
    assert (foreign_agent.best[:3] * -place.goal[:3]).sum(1).min() > 0  # towards the other world's goals
    assert own.before.to_json() == foreign.before.to_json()
    advantage = paired_gains(own.after, foreign.after, own.adaptations).classes["Near"]["return"]
    assert advantage is not None and advantage.interval is not None and advantage.interval[0] > 0


def test_portions_of_tasks_give_what_one_large_world_gives():
    def play(rows):
        place = world(rows, 5, 5, noise=0.0)
        own = list(place.pools)
        found = meta_evaluate(Explorer(), place, 2, rollouts=2, episodes_per_task=2)
        assert all(np.array_equal(*pair) for pair in zip(place.pools, own, strict=True))
        return found, len(place.given)

    whole, untouched = play(20)
    parts, changes = play(8)
    assert untouched == 0 and changes == 4  # two tasks at a time: three portions, and the pools put back
    assert whole.adapt_steps == [steps * 5 // 6 for steps in parts.adapt_steps]  # the sixth is played twice
    for one, other in zip(whole.by_shot, parts.by_shot, strict=True):
        for name in ("Near", "Far"):
            a, b = one.classes[name], other.classes[name]
            for task in range(5):
                assert np.allclose(a.returns[a.tasks == task], b.returns[b.tasks == task], atol=1e-5)
                assert (b.tasks == task).sum() == 2


class Explorer(Finder):
    """Explores in one way in every row."""

    def adapt_action(self, obs):
        return torch.tensor([0.9, 0.3]).expand(len(obs), 2), {}


def test_trials_adapt_a_task_anew_with_other_episodes():
    agent = Finder()
    found = meta_evaluate(agent, world(8, 1, 1), 1, rollouts=1, trials=4, episodes_per_task=5, seed=4)
    assert agent.of_row.tolist() == list(range(8))
    near = found.after.classes["Near"]
    assert near.tasks.tolist() == [0] * 20
    assert np.bincount(found.adaptations["Near"]).tolist() == [5] * 4
    assert len({near.returns[found.adaptations["Near"] == trial].mean() for trial in range(4)}) == 4


def test_json_is_complete_and_of_the_first_tasks_alone_if_asked():
    few = meta_evaluate(Still(), world(20, 5, 5), 1, tasks=2, rollouts=5, episodes_per_task=1)
    assert few.before.classes["Near"].tasks.tolist() == [0, 1]
    references = {"Near": Reference(-10.0, 0.0), "Far": Reference(-20.0, 0.0)}
    found = meta_evaluate(Finder(), world(), 3, rollouts=2, references=references, protocol=Protocol("test")).to_json()
    json.dumps(found, allow_nan=False)
    assert (found["split"], found["shots"], found["rollouts"], len(found["by_shot"])) == ("test", 3, 2, 4)
    assert found["before"] == found["by_shot"][0] and found["after"] == found["by_shot"][3]
    for gain in (*found["gain"]["classes"].values(), found["gain"]["aggregate"]):
        assert gain.keys() == {"return", "success", "score"}
        assert gain["score"].keys() == {"value", "interval"}
    unscored = meta_evaluate(Finder(), world(), 1).to_json()["gain"]
    assert unscored["aggregate"]["score"] is None and unscored["classes"]["Near"]["score"] is None


def test_agents_may_answer_in_numpy():
    class Numpy(Finder):
        def eval_action(self, obs):
            return super().eval_action(obs).numpy()

        def adapt_action(self, obs):
            return super().adapt_action(obs)[0].numpy(), {}

    found, same = (meta_evaluate(kind(), world(), 1, seed=8).to_json() for kind in (Numpy, Finder))
    assert found == same


def test_intervals_know_that_episodes_of_an_adaptation_share_its_luck():
    generator = np.random.default_rng(0)
    luck = np.repeat(generator.normal(0, 1, 10), 100)
    noise = generator.normal(0, 0.1, 1000)

    def result(returns):
        ones = np.ones(1000)
        return Evaluation({"A": ClassResult(returns, ones, ones, ones, 0)}, 100)

    zero = result(np.zeros(1000))
    apart = paired_gains(result(luck + noise), zero, {"A": np.arange(1000)}).classes["A"]["return"]
    shared = paired_gains(result(luck + noise), zero, {"A": np.repeat(np.arange(10), 100)}).classes["A"]["return"]
    assert apart is not None and apart.interval is not None and shared is not None and shared.interval is not None
    assert shared.value == pytest.approx(apart.value)
    assert np.diff(shared.interval)[0] > 3 * np.diff(apart.interval)[0]


@pytest.mark.parametrize(("tasks", "wider"), [(4, False), (10, True)])
def test_trials_of_one_task_share_its_difficulty(tasks: int, wider: bool) -> None:
    """With four tasks these are all that there are, and trials are independent."""
    trials, episodes = 20, 2
    adaptation = np.repeat(np.arange(tasks * trials), episodes)
    task = adaptation % tasks
    returns = np.random.default_rng(0).normal(0, 1, tasks)[task]

    def result(returns: np.ndarray, tasks: np.ndarray) -> Evaluation:
        ones = np.ones(len(returns))
        return Evaluation({"A": ClassResult(returns, ones, ones, tasks, 0)}, 1)

    widths = []
    for told in (task, adaptation):  # by task, and as if each trial had a task of its own
        zero = result(0 * returns, told)
        gain = paired_gains(result(returns, told), zero, {"A": adaptation}).classes["A"]["return"]
        assert gain is not None and gain.interval is not None and gain.value == pytest.approx(returns.mean())
        widths.append(float(np.diff(gain.interval)[0]))
    assert (widths[0] > 3 * widths[1]) == wider


@pytest.mark.parametrize(
    ("agent", "place", "keywords", "expected"),
    [
        (Still(), world(mode="SAME_STEP"), {}, "DISABLED"),
        (Still(), world(), {"shots": -1}, "shots"),
        (Still(), world(), {"rollouts": 0}, "rollouts"),
        (Still(), world(), {"tasks": 0}, "tasks"),
        (Still(), world(), {"trials": 0}, "trials"),
        (Still(), world(), {"max_adapt_steps": 0}, "max_adapt_steps"),
        (Still(), world(), {"episodes_per_task": 0}, "from 1 to"),
        (Still(), world(), {"evaluated": (3,)}, "from 0 to 2 shots"),
        (RandomAgent(world().action_space), world(), {}, "RandomAgent has no init, adapt_action, step, adapt"),
        (Still(), world(), {"adapt_world": world(14)}, "observations and actions"),
        (Still(), world(), {"adapt_world": world(12, 2, 2)}, "tasks in its pools"),
        (Still(), world(), {"adapt_world": world(mode="SAME_STEP")}, "DISABLED"),
        (Still(), ToyWorld(6, "DISABLED"), {"rollouts": 2}, "ToyWorld, whose tasks cannot be set"),
    ],
)
def test_refusals_name_the_mend(agent, place, keywords, expected):
    with pytest.raises(BidexError, match=expected) as error:
        meta_evaluate(agent, place, **keywords)
    assert "\n" not in str(error.value)


def test_exploring_episodes_are_whole_by_default():
    agent, place = Still(), world(10, steps=(160, 200))
    found = meta_evaluate(agent, place, 1, rollouts=1, episodes_per_task=1)
    assert found.adapt_steps == [3 * 160 + 2 * 200]
    assert found.to_json()["max_adapt_steps"] == found.protocol.max_adapt_steps == 200
    cut = meta_evaluate(agent, place, 1, rollouts=1, episodes_per_task=1, max_adapt_steps=150)
    assert cut.adapt_steps == [5 * 150]


def test_an_agent_of_ones_own_sees_rewards_while_it_is_judged_unless_they_are_hidden():
    agent = Climber()
    place = world(10, steps=(20, 20))
    found = meta_evaluate(
        AdaptingTrialAgent(agent), place, 2, rollouts=1, episodes_per_task=1, seed=3, hidden_rewards=True
    )
    assert agent.observed == 2 * 20, "two exploring episodes; evaluations are played by copies"
    assert found.hidden_by_shot is not None and len(found.by_shot) == len(found.hidden_by_shot) == 3
    for name in ("Near", "Far"):
        shown, hidden = (each[0].classes[name] for each in (found.by_shot, found.hidden_by_shot))
        assert shown.mean_return > hidden.mean_return + 1.0
        assert np.array_equal(shown.tasks, hidden.tasks)
    written = found.to_json()
    assert written["rewards_shown"] and len(written["hidden_by_shot"]) == 3
    plain = meta_evaluate(AdaptingTrialAgent(Climber()), place, 2, rollouts=1, episodes_per_task=1, seed=3)
    assert plain.hidden_by_shot is None
    assert [each.to_json() for each in plain.by_shot] == [each.to_json() for each in found.by_shot]


def test_one_protocol_says_what_is_played():
    protocol = Protocol(seed=3, tasks=2, episodes_per_task=2, shots=2, rollouts=3, trials=2, max_adapt_steps=6)
    assert meta_evaluate(Finder(), world(), protocol=protocol).protocol == protocol
    assert len(meta_evaluate(Finder(), world(), 1, protocol=protocol).adapt_steps) == 1


@pytest.mark.parametrize("suite", ["ML4", "MT1", "MT4-v2"])
def test_others_are_tasks_of_another_seed(suite):
    worlds = open_worlds({"suite": suite, "threads": 1, "seed": 7})
    own, others = (each.world("train", 4).pools[0] for each in (worlds, worlds.others))
    assert own.shape == others.shape and not (own == others).all(1).any()
    benchmark = Benchmark(suite, seed=7)
    by_name = benchmark.make_world("others", 4, device="cpu", autoreset_mode="DISABLED", threads=1)
    assert np.array_equal(by_name.pools[0], others)
    assert len(set(benchmark.train_tasks) & set(benchmark.others.train_tasks)) == 0


@pytest.mark.parametrize("suite", ["ML1", "ML1-Switch-shared", "ML2-Doors-shared", "MT2-Doors-shared"])
def test_others_are_the_test_tasks_that_a_file_lists(suite: str) -> None:
    """Only what the file lists is the same: version 1's goals come with other starts."""
    others = open_worlds({"suite": suite, "threads": 1}).others
    hidden = Benchmark(suite.replace("MT", "ML"))
    for entry in hidden.suite.split_classes("train"):
        listed = indices_of(hidden, entry.name)
        found, train, test = (
            {tuple(task.variation[listed]) for task in tasks}
            for tasks in (others.benchmark.tasks_of(entry.name), *(hidden.tasks_of(entry.name, of) for of in SPLITS))
        )
        assert found == test and not found & train
    world = others.world("train", 4)
    assert len(world.pools[0]) == len(hidden.tasks_of(entry.name, "test"))


def indices_of(benchmark: Benchmark, name: str) -> list[int]:
    """The components of a class that the file lists."""
    [entry] = [each for each in benchmark.suite.classes if each.name == name]
    names = benchmark.task_classes()[name].variation_space.names
    return [names.index(each) for each in entry.tasks[0].fixed]


@pytest.mark.parametrize("suite", ["ML1-Switch-choice2", "MT1-DoorOpenOutward-choice4"])
def test_a_suite_that_lists_all_its_tasks_has_no_others(suite: str) -> None:
    worlds = open_worlds({"suite": suite, "threads": 1})
    for look in (
        lambda: Benchmark(suite).others,
        lambda: Benchmark(suite).make_world("others", 4, device="cpu"),
        lambda: worlds.others,
        lambda: metatest.splits_of(worlds, "others"),
        lambda: metatest.splits_of(worlds, "unseen"),
        lambda: FinalEvaluation(other_tasks=True).check(resolve(RunConfig(suite=suite, algo="mtppo"))),
    ):
        with pytest.raises(BidexError, match="expected a suite with unseen tasks of its train classes, but it lists"):
            look()


@pytest.mark.parametrize("returned", [torch.zeros(12, 2), (torch.zeros(12, 2),), (torch.zeros(12, 2), None), None])
def test_exploring_actions_without_their_dict_are_refused_in_one_line(returned: object) -> None:
    agent = Finder()
    agent.adapt_action = lambda obs: returned  # type: ignore[method-assign]
    calls = lambda: meta_evaluate(agent, world(), 1), lambda: FromMetaWorld(agent).adapt_action(torch.zeros(12, 3))
    for call in calls:
        with pytest.raises(BidexError, match=r"Finder\.adapt_action: expected actions and a dict") as raised:
            call()
        assert "\n" not in str(raised.value) and "Return (actions, {})" in str(raised.value)
