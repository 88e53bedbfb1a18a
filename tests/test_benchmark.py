import copy
import multiprocessing
import pickle
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st

import bidex_meta.benchmark
from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.ladder import parts_of
from bidex_meta.metaworld import CustomML
from bidex_meta.rules import V1, V2
from bidex_meta.suite_files import suite_names
from bidex_meta.tasks import registry
from bidex_meta.tasks.task import Task

MT4_CLASSES = ["CatchUnderarm", "HandOver", "CatchAbreast", "TwoCatchUnderarm"]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of worlds there is what they are asked for."""
    make = lambda slots, config: SimpleNamespace(slots=slots, num_envs=config.num_envs, config=config)  # noqa: E731
    monkeypatch.setattr(bidex_meta.benchmark, "World", make)


def own_suite(folder: Path, **replaced: str) -> Path:
    text = (
        'name = "own"\nversion = 1\nkind = "multi-task"\ndescription = "own"\nobservation = "one-hot"\n'
        'task_id = "class"\nreward = "paper"\nbase = "moving"\ntasks_per_class = 3\n[[classes]]\nname = "HandOver"\n'
    )
    for old, new in replaced.items():
        text = text.replace(old, new)
    file = folder / "own.toml"
    file.write_text(text, encoding="utf-8")
    return file


def begun(benchmark: Benchmark) -> list[np.ndarray]:
    """The first observations of a world, and of one environment on its first task."""
    world = benchmark.make_world(num_envs=2, device="cpu", threads=1)
    env, task = next(iter(benchmark.train_classes.values()))(), benchmark.train_tasks[0]
    env.set_task(task)
    return [world.reset()[0].numpy(), env.reset(seed=5)[0]]


FLASK = Path(__file__).parents[1] / "examples/objects/flask.xml"
OWN = {
    "listed": {"tasks_per_class = 3": "", '"HandOver"': '"HandOver"\n[[classes.tasks]]\nname = "near"\nfixed = {}'},
    "objects": {'"HandOver"': f'"BottleCap"\nobjects = ["{FLASK}"]\n[points]\ncount = 64'},
}


@pytest.mark.parametrize("own", OWN)
def test_suites_and_benchmarks_pickle(own: str, tmp_path: Path) -> None:
    benchmark = Benchmark(own_suite(tmp_path, **OWN[own]), seed=3)
    (tmp_path / "own.toml").unlink()
    for copied in (pickle.loads(pickle.dumps(benchmark)), copy.deepcopy(benchmark)):
        assert copied.suite == benchmark.suite and repr(copied) == repr(benchmark)
        assert copied.train_tasks == benchmark.train_tasks and copied.train_classes == benchmark.train_classes
        for a, b in zip(begun(copied), begun(benchmark), strict=True):
            np.testing.assert_array_equal(a, b)


def test_benchmarks_go_to_other_processes() -> None:
    benchmark = CustomML(["HandOver"], ["CatchUnderarm"], seed=1)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(begun, (benchmark,))
    for a, b in zip(there, begun(benchmark), strict=True):
        np.testing.assert_array_equal(a, b)


@given(st.lists(st.floats(width=64), max_size=12))
def test_task_keeps_every_bit_of_its_variation(numbers: list[float]) -> None:
    task = Task.from_variation("HandOver", np.array(numbers))
    assert len(task.data) == 8 * len(numbers)
    np.testing.assert_array_equal(task.variation, np.array(numbers))


def test_classes_and_task_counts() -> None:
    mt4, ml4 = Benchmark("MT4"), Benchmark("ML4")
    in_suite = mt4.task_classes()["HandOver"]  # moves there; alone its base is fixed (tests/worlds)
    assert (in_suite.observation_size, in_suite.action_size) == (422, 52)
    assert list(mt4.train_classes) == MT4_CLASSES and mt4.test_classes == {} and mt4.test_tasks == []
    assert [task.env_name for task in mt4.train_tasks] == [name for name in MT4_CLASSES for _ in range(50)]
    assert [*ml4.train_classes] == MT4_CLASSES[:3] and [*ml4.test_classes] == MT4_CLASSES[3:]
    assert (len(ml4.train_tasks), len(ml4.test_tasks)) == (150, 50)


@pytest.mark.parametrize("name", suite_names())
def test_tasks_are_distinct_and_disjoint(name: str) -> None:
    benchmark = Benchmark(name, seed=3)
    tasks = benchmark.train_tasks + benchmark.test_tasks * ("-choice" not in name)
    assert len({(task.env_name, task.data) for task in tasks}) == len(tasks)
    classes = benchmark.task_classes("train") | benchmark.task_classes("test")
    if "-choice" in name:
        assert len(tasks) == int(name[-1]) and benchmark.test_tasks in ([], benchmark.train_tasks)
    if "-shared" in name:
        assert all(len(set(task.variation)) == 1 for task in tasks)
        for of in benchmark.train_classes:
            angles = [task.variation[0] for task in benchmark.tasks_of(of)]
            few = [min(angles), *sorted(angles[:10]), max(angles)]  # an evaluation may play only the first tasks
            assert max(b - a for a, b in pairwise(few)) < 0.2 * (few[-1] - few[0])
    if not benchmark.suite.classes[0].tasks or parts_of(name) is not None:
        assert all(classes[task.env_name].variation_space.contains(task.variation) for task in tasks)


@pytest.mark.parametrize("name", ["MT1", "MT4", "MT20", "ML1", "ML4", "ML20"])
def test_version_2_has_version_1s_classes_splits_and_sizes(name: str) -> None:
    one, two = Benchmark(name), Benchmark(f"{name}-v2")
    assert two.padded_size == one.padded_size and two.suite.splits == one.suite.splits
    for split in one.suite.splits:
        classes = two.task_classes(split)
        assert list(classes) == list(one.task_classes(split)) and all(c.action_size == 52 for c in classes.values())
        assert len(two.train_tasks if split == "train" else two.test_tasks) == 50 * len(classes)
    if name in ("MT4", "ML4", "ML20"):
        a, b = (each.make_world(num_envs=15, device="cpu", threads=1) for each in (one, two))
        assert a.single_observation_space.shape == b.single_observation_space.shape
        assert (a.num_id_columns, a.hides_goals) == (b.num_id_columns, b.hides_goals)


RULES = {"reward": "v2", "variation": "wide", "success": "at-end", "starts": "jittered"}


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_of_version_2_works_alone(rule: str, tmp_path: Path) -> None:
    """What it changes, and what it leaves as it is bit for bit; in worlds and in single environments."""
    plain = {'"HandOver"': '"PushBlock"'}
    given = plain | {'reward = "paper"\n': f'{rule} = "{RULES[rule]}"\n' + 'reward = "paper"\n' * (rule != "reward")}
    found = []
    for replaced in (plain, given):
        benchmark = Benchmark(own_suite(tmp_path, **replaced))
        world = benchmark.make_world(num_envs=4, device="cpu", threads=1, stagger=False)
        world.reset(seed=0)
        world.episodes.success |= True
        env = next(iter(benchmark.train_classes.values()))()
        env.set_task(benchmark.train_tasks[0])
        found.append((*world.step(torch.zeros(4, 52)), env.reset(seed=0)[0], env.step(np.zeros(52, np.float32))[1]))
    assert vars(benchmark.suite.rules) == vars(V1) | {rule: RULES[rule]}
    (obs, reward, *_, info, first, gain), (new, paid, *_, told, start, got) = found
    same = rule not in ("variation", "starts")
    assert torch.equal(obs, new) == np.array_equal(first, start) == same
    assert torch.equal(reward, paid) == (rule == "success") == (gain == got)
    assert (paid.max() < 1.0) == (rule == "reward")
    assert info["running"]["success"].all() and told["running"]["success"].any() == (rule != "success")


VERSION_2 = {'reward = "paper"\n': "".join(f'{name} = "{value}"\n' for name, value in RULES.items())}


@pytest.mark.parametrize("name", ["PushBlock-v2", "Switch-V2", "CatchUnderarm-v2"])
def test_a_class_with_a_version_is_refused_among_other_rules(name: str, tmp_path: Path) -> None:
    """It would mix version 2's length and variation with the suite's reward and success."""
    mixed = [{}, *({'reward = "paper"\n': f'reward = "paper"\n{rule} = "{RULES[rule]}"\n'} for rule in [*RULES][1:])]
    mixed.append({'reward = "paper"': 'reward = "v2"'})
    for rules in mixed:
        with pytest.raises(BidexError, match=f"own.toml: classes: .* got {name}") as error:
            Benchmark(own_suite(tmp_path, **{'"HandOver"': f'"{name}"'}, **rules))
        assert f'Write name = "{name[:-3]}"' in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(BidexError, match="Write name"):
        suite = Benchmark("MT1").suite
        replace(suite, classes=tuple(replace(entry, class_name=name) for entry in suite.classes))


def test_a_class_with_a_version_means_itself_in_a_suite_of_version_2(tmp_path: Path) -> None:
    found = []
    for name in ("CatchUnderarm", "CatchUnderarm-v2"):
        suite = Benchmark(own_suite(tmp_path, **{'"HandOver"': f'"{name}"\nobjects = ["egg", "mug"]'}, **VERSION_2))
        found.append(suite)
        world = suite.make_world(num_envs=2, device="cpu", threads=1)
        assert world.task_names == ["CatchUnderarm-egg", "CatchUnderarm-mug"] == list(suite.task_classes())
        assert list(suite.train_classes) == ["CatchUnderarm-v2-egg", "CatchUnderarm-v2-mug"]
        for task in suite.train_tasks:
            classes = suite.train_classes
            assert classes[task.env_name] is classes[task.env_name.replace("-v2", "")]
            classes[task.env_name]().set_task(task)
        assert suite.tasks_of("CatchUnderarm-egg") == suite.tasks_of("CatchUnderarm-v2-egg") == suite.train_tasks[:3]
    assert found[0].suite == found[1].suite and found[0].train_tasks == found[1].train_tasks
    with pytest.raises(BidexError, match="each name once"):
        twice = {'"HandOver"': '"HandOver"\n[[classes]]\nname = "HandOver-v2"'}
        Benchmark(own_suite(tmp_path, **twice, **VERSION_2))
    with pytest.raises(BidexError, match="Unknown class of MT4 'HandOver-v2'"):
        Benchmark("MT4").tasks_of("HandOver-v2")


def test_a_class_has_one_version(tmp_path: Path) -> None:
    task_class = registry.get("Switch-v2", True)
    task_class.adopt(V2)
    for rules in (V1, replace(V2, reward="paper")):
        with pytest.raises(BidexError, match="one version"):
            task_class.adopt(rules)
    with pytest.raises(BidexError, match="other than v2"):
        make_task_world("CatchUnderarm", object=str(tmp_path / "v2.xml"))
    assert registry.resolve("handover-V2") == "HandOver-v2"
    assert registry.name_among("Switch-v2", Benchmark("MT20-v2").task_classes()) == "Switch"
    assert registry.name_among("Switch-v2", Benchmark("MT20").task_classes()) == "Switch-v2"
    assert registry.name_among("CatchUnderarm-v2-mug", {"CatchUnderarm-mug": task_class}) == "CatchUnderarm-mug"


def test_tasks_depend_on_seed_class_and_split_only(tmp_path: Path) -> None:
    mt4, ml4 = Benchmark("MT4", seed=5), Benchmark("ML4", seed=5)
    assert ml4.train_tasks == mt4.train_tasks[:150]
    assert set(ml4.test_tasks).isdisjoint(mt4.train_tasks)
    assert Benchmark("MT4", seed=6).train_tasks != mt4.train_tasks
    own = Benchmark(own_suite(tmp_path, **{"= 3": "= 50"}), seed=5)
    assert own.train_tasks == mt4.train_tasks[50:100]


def test_listed_tasks_fix_the_goal_and_share_the_drawn_rest() -> None:
    mt1, ml1, other = Benchmark("MT1"), Benchmark("ML1"), Benchmark("MT1", seed=1)
    names = mt1.task_classes()["CatchUnderarm"].variation_space.names
    goal = [names.index(f"goal_{axis}") for axis in "xyz"]
    expected = [(0.0, -0.79, 0.54), (0.03, -0.79, 0.54), (-0.03, -0.79, 0.54), (0.0, -0.82, 0.54)]
    np.testing.assert_array_equal([task.variation[goal] for task in mt1.train_tasks], expected)
    assert ml1.train_tasks + ml1.test_tasks == mt1.train_tasks
    assert list(ml1.train_classes) == list(ml1.test_classes) == ["CatchUnderarm"]
    assert other.train_tasks != mt1.train_tasks


def test_evaluation_worlds_keep_their_tasks(asked: None) -> None:
    for mode in ("DISABLED", "Disabled", AutoresetMode.DISABLED):
        config = Benchmark("MT4").make_world(autoreset_mode=mode).config
        assert config.autoreset_mode is AutoresetMode.DISABLED and config.task_sampling == "fixed"
    for mode in ("same-step", "SameStep", "next_step"):
        assert Benchmark("MT4").make_world(autoreset_mode=mode).config.task_sampling == "uniform"


def test_discount_and_reward_scale_reach_slot_and_world(tmp_path: Path) -> None:
    file = own_suite(tmp_path, **{'"HandOver"': '"HandOver"\ngamma = 0.97\nreward_scale = 0.1'})
    world = Benchmark(file).make_world(num_envs=4, device="cpu")
    assert world.slots[0].reward_scale == 0.1
    gammas = {slot.name: slot.gamma for slot in world.slots}
    assert gammas.pop("HandOver") == 0.97 and not any(gammas.values())
    assert world.gammas == tuple(0.97 if name == "HandOver" else None for name in world.task_names)
    assert Benchmark("ML1").make_world("train", num_envs=3, device="cpu").gammas == (None,)


def test_task_world_has_the_tasks_of_the_suites(asked: None) -> None:
    world = make_task_world("CatchAbreast", num_envs=3, device="cpu", seed=2)
    expected = [t.variation for t in Benchmark("MT4", seed=2).train_tasks if t.env_name == "CatchAbreast"]
    np.testing.assert_array_equal(world.slots[0].tasks, expected)
    assert world.config.pad_to is None and world.config.task_sampling == "uniform"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 3}, "num_envs: expected at least 4, one each for CatchUnderarm, HandOver"),
        ({"num_envs": 4.5}, "num_envs: expected a whole number"),
        ({"split": "test"}, "MT4 has the splits train, got 'test'"),
        ({"autoreset_mode": "LAST_STEP"}, "Unknown autoreset_mode 'LAST_STEP'"),
        ({"device": "gpu"}, "device: expected auto, cpu, cuda or cuda:N, got 'gpu'"),
        ({"device": "mps"}, "device: expected auto, cpu, cuda or cuda:N, got 'mps'. The physics runs on a CPU or"),
        ({"seed": -1}, "seed: expected a whole number"),
    ],
)
def test_bad_worlds(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(BidexError, match=message):
        Benchmark("MT4").make_world(**arguments)


def test_bad_names_and_seeds(tmp_path: Path) -> None:
    with pytest.raises(BidexError, match="Did you mean 'HandOver'"):
        make_task_world("HandOve")
    with pytest.raises(BidexError, match=r"own\.toml: classes: Unknown task class 'HandOvr'\. Did you mean 'HandOver'"):
        Benchmark(own_suite(tmp_path, HandOver="HandOvr"))
    tasks = '"HandOver"\n[[classes.tasks]]\nname = "a"\nfixed = { goal_q = 0 }'
    with pytest.raises(BidexError, match="Unknown component of HandOver 'goal_q'"):
        Benchmark(own_suite(tmp_path, **{"tasks_per_class = 3\n": "", '"HandOver"': tasks}))
    with pytest.raises(BidexError, match="seed: expected a whole number"):
        Benchmark("MT4", seed=0.5)  # type: ignore[arg-type]


def test_classes_of_different_actions_are_refused(tmp_path: Path) -> None:
    more = {'"HandOver"': '"HandOver"\n[[classes]]\nname = "CatchUnderarm"'}
    Benchmark(own_suite(tmp_path, **more))
    with pytest.raises(BidexError, match="base: expected classes with one number of actions"):
        Benchmark(own_suite(tmp_path, **more, moving="alone"))
