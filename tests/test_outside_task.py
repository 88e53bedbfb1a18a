"""Task classes from elsewhere, by their ``package.module:Class``: that of docs/own-task.md, alone and in a suite."""

import copy
from pathlib import Path

import pytest
import torch

from bidex_meta import Benchmark, BidexError, make_task_world
from bidex_meta.cli import main
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.utils import paths
from tests.pages import ROOT, files_of

NAME = "my_tasks:SlideBlock"
SUITE = f"""
name = "Slides"
version = 1
kind = "meta"
description = "Slide a block; throw on the way"
observation = "masked"
task_id = "class"
reward = "paper"
base = "moving"
tasks_per_class = 2
[[classes]]
name = "{NAME}"
split = "both"
[[classes]]
name = "CatchUnderarm"
"""


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    source = files_of(ROOT / "docs" / "own-task.md")["my_tasks.py"]
    (tmp_path / "my_tasks.py").write_text(source)
    # The same with an object of its own, whose file lies beside it.
    own = source.replace('"cube"', 'str(__import__("pathlib").Path(__file__).with_name("wedge"))')
    assert own != source
    (tmp_path / "with_own_object.py").write_text(own)
    cube = (paths.assets_dir() / "objects" / "cube.xml").read_text()
    (tmp_path / "wedge.xml").write_text(cube.replace('mass="0.0709"', 'mass="0.2"'))
    (tmp_path / "no_task.py").write_text(
        "from bidex_meta.tasks.base import TaskClass\nclass Half(TaskClass): ...\nclass Other: ...\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_class_of_the_working_folder_trains_and_is_evaluated(
    working_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["run", "--task", NAME, "--algo", "ppo", "--num-envs", "4", "--steps", "64", "--threads", "1"]
    assert main([*run, "--no-evaluate"]) == 0
    (folder,) = (working_folder / "runs" / "SlideBlock" / "ppo").iterdir()
    assert main(["evaluate", str(folder), "--episodes", "1", "--json"]) == 0
    assert NAME in capsys.readouterr().out


def test_a_suite_names_it_and_hides_its_goal(working_folder: Path) -> None:
    (working_folder / "slides.toml").write_text(SUITE)
    benchmark = Benchmark("slides.toml")
    assert list(benchmark.train_classes) == [NAME, "CatchUnderarm"] and list(benchmark.test_classes) == [NAME]
    world = benchmark.make_world("test", 2, device="cpu", threads=1)
    obs, _ = world.reset(seed=0)
    task_class = world.slots[0].task_class
    assert obs.shape == (2, 422) and not obs[:, task_class.layout.goal_indices()].any()
    twin, action = copy.deepcopy(world), torch.zeros(2, 52)
    assert torch.equal(twin.step(action)[0], world.step(action)[0])
    env = benchmark.train_classes[NAME]()
    env.set_task(benchmark.train_tasks[0])
    assert env.reset(seed=0)[0].shape == (422,)


@pytest.mark.parametrize("rule", ['reward = "v2"', 'reward = "paper"\nvariation = "wide"'])
def test_rules_that_it_lacks_are_refused_and_others_work(rule: str, working_folder: Path) -> None:
    suite = SUITE.replace("base", 'success = "at-end"\nstarts = "jittered"\nbase')
    (working_folder / "slides.toml").write_text(suite)
    assert Benchmark("slides.toml").make_world("test", 2, device="cpu", threads=1).reset(seed=0)[0].isfinite().all()
    (working_folder / "slides.toml").write_text(suite.replace('reward = "paper"', rule))
    with pytest.raises(BidexError, match=r"slides\.toml.*SlideBlock: .* which the class does not have") as raised:
        Benchmark("slides.toml")
    assert rule.split()[-1] in str(raised.value) and "\n" not in str(raised.value)


def test_it_has_a_version_as_other_classes_have() -> None:
    with pytest.raises(BidexError, match='got "v2", which the class does not have'):
        make_task_world(f"{NAME}-v2", 2, device="cpu", threads=1)


def test_an_object_of_its_own_lies_beside_the_file() -> None:
    world = make_task_world("with_own_object:SlideBlock", 2, device="cpu", threads=1)
    assert world.reset(seed=0)[0].shape == (2, 422)
    task = world.slots[0].task_class
    assert float(compile_scene(task).model.body("block/object").mass[0]) == 0.2


_MISTAKES = {
    '"block/position"]': ('"cube/pos"]', "Unknown sensor 'cube/pos'"),
    '*goal_blocks("goal")': ('Block("goal", 3, ("block/posture",))', "Unknown sensor 'block/posture'. Did you mean"),
    '"target": -5.0 * distance': ('"target": distance[:, None]', "'target': expected a tensor of shape (n,)"),
    "_distance(state) < _NEAR": ("_distance(state)", "success: expected a tensor of shape (n,) of bool"),
    "observe_goal(state": ('{"gaol": state.frozen["goal"]} or (state', "observe: expected blocks of the layout"),
    '{"constant": torch.ones_like(distance)': ('{"constant": 1.0', "reward_terms: 'constant': expected a tensor"),
    '"block": variation[:, :3]': ('"block": variation[0, :3]', "freeze: 'block': expected a tensor of shape (n, k)"),
}


@pytest.mark.parametrize("right", _MISTAKES)
def test_a_mistake_in_a_method_names_class_method_expected_and_received(right: str, working_folder: Path) -> None:
    wrong, told = _MISTAKES[right]
    source = (working_folder / "my_tasks.py").read_text()
    assert right in source
    name = f"mistaken_{list(_MISTAKES).index(right)}"
    source = source.replace("import goal_blocks,", "import Block, goal_blocks,").replace(right, wrong)
    (working_folder / f"{name}.py").write_text(source)
    with pytest.raises(BidexError) as raised:
        make_task_world(f"{name}:SlideBlock", 2, device="cpu", threads=1)
    assert told in str(raised.value) and ("sensor" in told or str(raised.value).startswith("SlideBlock."))


def _wrong(folder: Path, name: str, *changes: tuple[str, str]) -> str:
    """A class of the working folder with these changes to its source; its name."""
    source = (folder / "my_tasks.py").read_text()
    for right, wrong in changes:
        assert right in source
        source = source.replace(right, wrong)
    (folder / f"{name}.py").write_text(source)
    return f"{name}:SlideBlock"


_NAN = "torch.where(distance > 0.0, torch.nan, distance)"


@pytest.mark.parametrize("mode", ["SAME_STEP", "DISABLED"])
def test_a_reward_term_that_is_not_finite_names_class_and_term(mode: str, working_folder: Path) -> None:
    name = _wrong(working_folder, f"nan_reward_{mode}", ('"target": -5.0 * distance', f'"target": {_NAN}'))
    world = make_task_world(name, 4, device="cpu", threads=1, autoreset_mode=mode)
    world.reset(seed=0)
    with pytest.raises(
        BidexError, match=r"SlideBlock\.reward_terms: 'target': .* got nan .*\(4 of 4 environments\)"
    ) as raised:
        world.step(torch.zeros(4, 52))
    assert "\n" not in str(raised.value)
    with pytest.raises(BidexError, match="'target'"):  # what a learner on a GPU asks when its loss is not finite
        world.check_formulas()


def test_an_observation_or_a_start_that_is_not_finite_names_class_and_block(working_folder: Path) -> None:
    observe = 'return observe_goal(state, "block/quaternion")'
    change = (observe, 'return {"goal_pose": state.frozen["goal"] / 0.0}')
    name = _wrong(working_folder, "nan_observation", change)
    with pytest.raises(BidexError, match=r"SlideBlock\.observe: 'goal_pose': expected finite numbers"):
        make_task_world(name, 2, device="cpu", threads=1).reset(seed=0)
    change = ('place(qpos["block"], frozen["block"], draws)', 'qpos["block"][:, 0] = (draws[:, 0] - 2.0).sqrt()')
    name = _wrong(working_folder, "nan_start", change)
    with pytest.raises(BidexError, match=r"SlideBlock\.start: 'block': expected finite numbers"):
        make_task_world(name, 2, device="cpu", threads=1).reset(seed=0)


def test_broken_physics_of_a_class_of_ones_own_is_no_fault_of_its_formulas(working_folder: Path) -> None:
    world = make_task_world(NAME, 2, device="cpu", threads=1)
    world.reset(seed=0)
    world.parts[0].group.engine.qpos[0] = torch.nan
    info = world.step(torch.zeros(2, 52))[4]
    assert info["unstable"].tolist() == [True, False] and info["reward_unscaled"].isfinite().all()


def test_a_loss_that_own_rewards_broke_does_not_blame_the_learning_rate(
    working_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = _wrong(working_folder, "nan_in_a_run", ('"target": -5.0 * distance', f'"target": {_NAN}'))
    run = ["run", "--task", name, "--algo", "ppo", "--num-envs", "4", "--steps", "64", "--threads", "1"]
    assert main([*run, "--no-evaluate"]) == 2
    shown = capsys.readouterr().err
    assert "SlideBlock.reward_terms: 'target'" in shown and "learning_rate" not in shown


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("episode_steps = 125", "episode_steps = 0", "episode_steps: expected a whole number from 1 on, got 0"),
        ("start_draws = DRAWS", 'start_draws = "3"', "start_draws: expected a whole number from 0 on, got '3'"),
        ("transition_scale = 0.5", 'transition_scale = float("nan")', "transition_scale: expected a number from 0"),
        (
            "right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)",
            "right = (0.55, 0.2, 0.8)",
            "right: expected a HandPose",
        ),
        ("solver = FAST", "solver = 100", "solver: expected a Solver, got 100"),
        ('"goal_shift", 0.1, 0.25', '"goal_shift", 0.25, 0.1', "goal_shift: expected its lower end before its upper"),
    ],
)
def test_an_attribute_of_another_kind_is_refused(right: str, wrong: str, told: str, working_folder: Path) -> None:
    name = _wrong(working_folder, f"attribute_{abs(hash(wrong))}", (right, wrong))
    with pytest.raises(BidexError) as raised:
        make_task_world(name, 2, device="cpu", threads=1)
    assert told in str(raised.value) and name in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("import nowhere_at_all", "there is no nowhere_at_all"),
        ("from math import nothing", "ImportError: cannot import name 'nothing'"),
        ("x = = 1", "SyntaxError: invalid syntax"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("raise ValueError('odd')", "ValueError: odd"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("class Odd(dict, object, dict): ...", "TypeError: duplicate base class"),
        ("SlideBlock.__init__ = lambda self, base: {}['x']", "KeyError: 'x'"),
        ("class SlideBlock(SlideBlock):\n    def __init__(self): ...", "takes 1 positional argument"),
        ("SlideBlock.success = lambda self, state: state.nothing", "AttributeError"),
        ("SlideBlock.add_objects = lambda self, scene: exit(0)", "SystemExit"),
    ],
)
def test_what_a_class_raises_is_told_in_one_line_with_its_place(
    line: str, told: str, working_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = (working_folder / "my_tasks.py").read_text()
    # Of a name that no other test has imported.
    name = f"raising_{abs(hash(line))}"
    (working_folder / f"{name}.py").write_text(f"{source}\n{line}\n")
    words = ["render", "--task", f"{name}:SlideBlock", "--out", "x.png", "--steps", "1", "--policy", "random"]
    assert main(words) == 2
    shown = capsys.readouterr().err
    assert told in shown and shown.count("\n") == 1 and f"task {name}:SlideBlock" in shown
    if "nowhere" not in line:
        assert f"{name}.py" in shown
    if "positional" not in told and "nowhere" not in line:
        assert f"line {source.count(chr(10)) + 2})" in shown
    with pytest.raises((Exception, SystemExit)):
        main([*words, "--debug"])


@pytest.mark.parametrize(
    "name, told",
    [
        ("nowhere:Task", "there is no nowhere"),
        ("no_task:Missing", "expected a class Missing"),
        ("no_task:Other", "expected a subclass of bidex_meta.tasks.base.TaskClass"),
        ("no_task:Half", "expected the class to have add_objects"),
        (":Task", "expected a module"),
    ],
)
def test_what_is_no_task_is_told_in_one_line(name: str, told: str) -> None:
    with pytest.raises(BidexError, match=told) as raised:
        make_task_world(name, 2)
    assert "\n" not in str(raised.value)


_SILENT_MISTAKES = {
    'lambda: norm(state["block/position"] - state.frozen["goal"][:, :3])': (
        'lambda: norm(state["block/position"].sub_(state.frozen["goal"][:, :3]))',
        "reward_terms: expected an unchanged state",
    ),
    '"target": -5.0 * distance': ('"target": -5.0 * distance / distance.norm()', "row alone, got values that depend"),
    '"right": -reached': ('"right": torch.rand_like(reached)', "got others in a second call"),
    "episode_steps = ": ("episode_steps = 10  # ", "episode_steps: expected at least 15"),
}


@pytest.mark.parametrize("right", _SILENT_MISTAKES)
def test_a_mistake_that_would_only_change_numbers_is_refused(right: str, working_folder: Path) -> None:
    wrong, told = _SILENT_MISTAKES[right]
    name = _wrong(working_folder, f"silent_{list(_SILENT_MISTAKES).index(right)}", (right, wrong))
    rules = 'success = "at-end"\nbase' if "steps" in right else "base"
    (working_folder / "slides.toml").write_text(SUITE.replace(NAME, name).replace("base", rules))
    with pytest.raises(BidexError, match=told) as raised:
        Benchmark("slides.toml").make_world("test", 2, device="cpu", threads=1)
    assert "\n" not in str(raised.value)


def test_a_key_of_a_class_does_not_meet_one_of_ours(working_folder: Path) -> None:
    change = ('state.once("distance", ', 'state.once("solved", ')
    name = _wrong(working_folder, "same_key", change)
    world = make_task_world(name, 2, device="cpu", threads=1)
    world.reset(seed=0)
    assert not world.step(torch.zeros(2, 52))[4]["success"].any()


def test_two_classes_of_one_name_stay_two(working_folder: Path) -> None:
    (working_folder / "far.py").write_text(
        "from my_tasks import SlideBlock\n"
        "class Far(SlideBlock):\n"
        "    def reward_terms(self, state):\n"
        "        return {'seven': 7.0 + 0.0 * self._distance(state)}\n"
    )
    suite = SUITE.replace('kind = "meta"', 'kind = "multi-task"').replace('"masked"', '"one-hot"')
    suite = suite.replace('split = "both"', "").replace('name = "CatchUnderarm"', 'name = "far:Far"')
    (working_folder / "slides.toml").write_text(suite)
    world = Benchmark("slides.toml").make_world("train", 4, device="cpu", threads=1)
    world.reset(seed=0)
    rewards = world.step(torch.zeros(4, 52))[1]
    assert rewards[2:].tolist() == [7.0, 7.0] and (rewards[:2] < 2.0).all()


def test_hidden_suites_leave_out_goals_and_nothing_else(working_folder: Path) -> None:
    blocks = '*goal_blocks("goal")'
    observe = 'return observe_goal(state, "block/quaternion")'
    changes = [("import goal_blocks,", "import Block, goal_blocks,"), (blocks, f'{blocks}, Block("gap", 1)')]
    shown = ' | {"gap": 3.0 + 0.0 * state["block/position"][:, :1]}'
    name = _wrong(working_folder, "with_gap", *changes, (observe, observe + shown))
    (working_folder / "slides.toml").write_text(SUITE.replace(NAME, name))
    world = Benchmark("slides.toml").make_world("test", 2, device="cpu", threads=1)
    obs, _ = world.reset(seed=0)
    layout = world.slots[0].task_class.layout
    assert (obs[:, layout.range("gap")] == 3.0).all() and not obs[:, layout.goal_indices()].any()
    read = (blocks, 'Block("goal", 3, ("block/position",), goal=True)')
    name = _wrong(working_folder, "read_goal", changes[0], read)
    with pytest.raises(BidexError, match="expected a goal without sensors"):
        make_task_world(name, 2, device="cpu", threads=1)


def test_a_class_can_extend_ours(working_folder: Path) -> None:
    (working_folder / "thrown.py").write_text(
        "from bidex_meta.tasks.catches import CatchUnderarm\nclass Mine(CatchUnderarm):\n    name = 'Mine'\n"
    )
    world = make_task_world("thrown:Mine", 2, device="cpu", threads=1)
    assert world.reset(seed=0)[0].shape == (2, 422) and world.task_names == ["thrown:Mine"]
