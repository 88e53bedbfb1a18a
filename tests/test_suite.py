import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.ladder import HIDDEN_NUMBERS, parts_of, rung_of
from bidex_meta.rules import V1, V2
from bidex_meta.suite_files import load_suite, suite_names
from bidex_meta.tasks import registry

HEAD = """
name = "own"
version = 1
kind = "meta"
description = "two classes"
observation = "masked"
task_id = "class"
reward = "paper"
base = "moving"
"""

META = f"""{HEAD}
tasks_per_class = 5

[[classes]]
name = "CatchUnderarm"
split = "train"

[[classes]]
name = "HandOver"
split = "test"
"""

LISTED = f"""{HEAD.replace('"class"', '"task"')}
[[classes]]
name = "CatchUnderarm"
split = "both"

[[classes.tasks]]
name = "near"
fixed = {{ goal_x = 0.0 }}

[[classes.tasks]]
name = "far"
split = "test"
fixed = {{ goal_x = 0.1 }}
"""


def write(folder: Path, text: str) -> Path:
    file = folder / "own.toml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize("name", suite_names())
def test_shipped_suite_is_sound(name: str) -> None:
    suite = load_suite(name)
    assert suite.name == name
    assert {entry.class_name for entry in suite.classes} <= set(registry.names())
    v2 = name.endswith("-v2") or parts_of(name) is not None
    shown = "plain" if v2 and name.startswith("MT1-") else "one-hot"  # there is one class, and no list of tasks
    assert suite.observation == ("masked" if suite.kind == "meta" else shown)
    assert suite.rules == (V2 if v2 else V1) and suite.version == 1 + v2
    assert suite.splits == (("train", "test") if suite.kind == "meta" else ("train",))


def test_composition_of_mt20_and_ml20() -> None:
    """Appendix, section D: eleven classes at a tenth of their reward, five held out."""
    mt20, ml20 = load_suite("MT20"), load_suite("ML20")
    assert {c.name for c in mt20.classes} == set(registry.names()) and len(mt20.classes) == 20
    scaled = """GraspAndPlace DoorOpenOutward DoorOpenInward BottleCap StackBlock DoorCloseInward DoorCloseOutward
        LiftUnderarm ReOrientation OpenScissors SwingCup"""
    for suite in (mt20, ml20):
        assert {c.name for c in suite.classes if c.reward_scale == 0.1} == set(scaled.split())
        assert {c.reward_scale for c in suite.classes} == {0.1, 1.0}
    held_out = {"DoorCloseOutward", "HandOver", "LiftUnderarm", "OpenScissors", "TwoCatchUnderarm"}
    assert {c.name for c in ml20.split_classes("test")} == held_out
    assert {c.name for c in ml20.split_classes("train")} == set(registry.names()) - held_out
    assert mt20.tasks_per_class == ml20.tasks_per_class == load_suite("ML4").tasks_per_class == 50


def test_a_class_takes_its_options(tmp_path: Path) -> None:
    head = META[: META.index("[[classes]]")].replace("meta", "multi-task")
    text = head + '[[classes]]\nname = "PourWater"\noptions = { water = 30 }\n'
    suite = load_suite(write(tmp_path, text))
    assert dict(suite.classes[0].options) == {"water": 30}
    assert Benchmark(suite.file).task_classes()["PourWater"].water == 30  # type: ignore[attr-defined]
    with pytest.raises(BidexError, match=r"Unknown option of PourWater 'watr'\. Did you mean 'water'"):
        Benchmark(write(tmp_path, text.replace("water =", "watr =")))


def test_a_refusal_names_values_that_the_file_takes(tmp_path: Path) -> None:
    text = META.replace('split = "test"', 'split = "test"\noptions = { moving_base = 1 }')
    with pytest.raises(BidexError, match="expected no moving_base") as raised:
        Benchmark(write(tmp_path, text))
    named = re.findall(r'"(\w+)"', str(raised.value))
    assert len(named) == 2
    for base in named:
        assert load_suite(write(tmp_path, META.replace('base = "moving"', f'base = "{base}"'))).base == base


@pytest.mark.parametrize(("name", "told"), [("crate", "Unknown object 'crate'"), ("missing.xml", "missing.xml")])
def test_an_object_that_is_not_there_is_named(name: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(BidexError, match=rf"own\.toml.*{told}"):
        Benchmark(write(tmp_path, META.replace('split = "test"', f'split = "test"\nobjects = ["{name}"]')))


def test_rungs_count_what_the_classes_hide() -> None:
    for name in registry.names():
        hidden = sum(len(part.names) for part in registry.get(f"{name}-v2").hides())
        assert HIDDEN_NUMBERS[name] == hidden, name
    rungs = {name: rung_of(name, [entry.name for entry in load_suite(name).classes]) for name in suite_names()}
    of = {"ML1-Switch-choice2": 0, "ML1-SwingCup-v2": 1, "ML1-Switch-shared": 1, "ML1-Switch-v2": 2, "ML5-v2": 3}
    of |= {"ML2-Doors-shared": 3, "MT2-Doors-shared": None}
    of |= {"ML1-PushBlock-v2": 4, "ML20-v2": 5, "MT1-Switch-choice2": None, "ML1": None}
    assert of.items() <= rungs.items()


def test_names_and_paths(tmp_path: Path) -> None:
    file = write(tmp_path, META)
    assert load_suite(file) == load_suite(str(file)) and load_suite(file).classes[0].reward_scale == 1.0
    with pytest.raises(BidexError, match=r"absent\.toml, but No such file"):
        load_suite(tmp_path / "absent.toml")
    choices = "ML1-CLASS-choice2, ML1-CLASS-choice4, ML1-CLASS-shared, ML1-CLASS-v2"
    meta = f"ML1, {choices}, ML1-objects, ML1-v2, ML1-wide, ML2-Doors-shared, ML20, ML20-v2, ML4, ML4-v2, ML5-v2"
    known = f"{meta}, MT1, MT1-CLASS-choice2"
    with pytest.raises(BidexError, match=rf"Did you mean 'MT4'\? Known: {known}"):
        load_suite("MT44")
    with pytest.raises(BidexError, match=r"Did you mean 'ML1-Switch-choice\d'\?"):
        load_suite("ml1-switch-choice")
    assert load_suite("ml1-switch-CHOICE2").name == "ML1-Switch-choice2"


def test_tasks_without_number(tmp_path: Path) -> None:
    suite = load_suite(write(tmp_path, META))
    fresh = load_suite(write(tmp_path, META.replace("tasks_per_class = 5", "tasks_per_class = 0")))
    assert (fresh.train_tasks, fresh.tasks_per_class, fresh.drawn_tasks("train")) == (0, 50, 50)
    asked = suite.with_train_tasks(0)
    assert (asked.train_tasks, asked.drawn_tasks("train"), asked.drawn_tasks("test")) == (0, 5, 5)
    assert suite.with_train_tasks(9).drawn_tasks("train") == 9 and suite.with_train_tasks(None) == suite
    assert len({each.digest for each in (suite, fresh, asked, suite.with_train_tasks(9))}) == 4


BOTH = 'split = "test"', 'objects = ["egg"]\noptions = {object = "egg"}'
TABLE = "version = 1\nrandomisation = {"
COUNTED = "version = 1\ntasks_per_class = 3"
ENDLESS = "version = 1\ntasks_per_class = 0"
FAULTS = {
    "unknown key": (META, 'base = "moving"', 'base = "moving"\nbasis = 1', "basis: unknown entry, did you mean 'base'"),
    "unknown key in a class": (META, 'split = "test"', 'splitt = "test"', "classes[1].splitt: unknown entry"),
    "missing key": (META, 'reward = "paper"\n', "", "reward: expected it to be there"),
    "text for a number": (META, "version = 1", 'version = "1"', "version: expected"),
    "boolean for a number": (META, "version = 1", "version = true", "version: expected"),
    "number for a text": (META, 'name = "own"', "name = 3", "name: expected"),
    "blank name": (META, 'name = "own"', 'name = " "', "name: expected printable"),
    "a bell": (META, '"two classes"', '"two\\u0007"', "description: expected printable"),
    "unknown choice": (META, '"masked"', '"hidden"', "observation: expected"),
    "no tasks": (META, "tasks_per_class = 5", "tasks_per_class = -1", "tasks_per_class: expected"),
    "tasks neither drawn nor listed": (META, "tasks_per_class = 5\n", "", "tasks_per_class: expected"),
    "empty split": (META, 'split = "test"', 'split = "train"', "a meta suite with the splits train, test, got train"),
    "test split in MT": (META, '"meta"', '"multi-task"', "a multi-task suite with the splits train, got train, test"),
    "class twice": (META, '"HandOver"', '"CatchUnderarm"', "classes.name: expected each name once"),
    "no class": (META, META[META.index("[[") :], "classes = []", "classes: expected"),
    "class is no table": (META, META[META.index("[[") :], 'classes = ["HandOver"]', "classes[0]: expected"),
    "one-hot over tasks that are not listed": (META, '"class"', '"task"', 'task_id: expected "class"'),
    "negative scale": (META, 'split = "test"', "reward_scale = -1", "classes[1].reward_scale: expected"),
    "discount of 1": (META, 'split = "test"', 'split = "test"\ngamma = 1.0', "classes[1].gamma: expected"),
    "a text option": (META, 'split = "test"', 'options = {water = "3"}', "classes[1].options.water: expected"),
    "a number as object": (META, 'split = "test"', "options = {object = 3}", "classes[1].options.object: expected"),
    "object and objects": (META, *BOTH, "classes[1].objects: expected either"),
    "no objects": (META, 'split = "test"', "objects = []", "classes[1].objects: expected"),
    "a number of objects": (META, 'split = "test"', "objects = 3", "classes[1].objects: expected"),
    "a number among objects": (META, 'split = "test"', 'objects = ["egg", 3]', "objects[1]: expected"),
    "an object twice": (META, 'split = "test"', 'objects = ["egg", "egg"]', "each name once"),
    "points as a number": (META, "version = 1", "version = 1\npoints = 3", "points: expected"),
    "no points": (META, "version = 1", "version = 1\npoints = {count = 0}", "points.count: expected"),
    "points by another name": (META, "version = 1", "version = 1\npoints = {kind = 1}", "points.kind: unknown"),
    "too many points": (META, "version = 1", "version = 1\npoints = {count = 20000}", "points.count: expected"),
    "overlap": (LISTED, "goal_x = 0.1", "goal_x = 0.0", "train and test tasks that differ, got 'near' and 'far'"),
    "task twice": (LISTED, '"far"', '"near"', "classes[0].tasks.name: expected each name once"),
    "listed split absent": (LISTED, 'split = "both"', 'split = "test"', "classes"),
    "listed and without number": (LISTED, "version = 1", ENDLESS, "tasks_per_class: expected classes whose tasks are"),
    "listed and counted": (LISTED, "version = 1", COUNTED, "tasks_per_class: expected nothing"),
    "value is no number": (LISTED, "goal_x = 0.1", 'goal_x = "0.1"', "classes[0].tasks[1].fixed[...]: expected"),
    "value is not finite": (LISTED, "goal_x = 0.1", "goal_x = nan", "classes[0].tasks[1].fixed[...]: expected"),
    "ids of other classes in each split": (META, '"masked"', '"one-hot"', "observation: expected masked or plain"),
    "unknown reward": (META, '"paper"', '"v3"', "reward: expected"),
    "unknown variation": (META, "version = 1", 'version = 1\nvariation = "v2"', "variation: expected"),
    "unknown success": (META, "version = 1", 'version = 1\nsuccess = "at_end"', "success: expected"),
    "starts as a switch": (META, "version = 1", "version = 1\nstarts = true", "starts: expected"),
    "unknown randomisation": (META, "version = 1", f"{TABLE}frictoin = [0.5, 1]}}", "randomisation.frictoin: unknown"),
    "a factor of 0": (META, "version = 1", f"{TABLE}friction = [0, 1]}}", "randomisation.friction[0]: expected"),
    "no range": (META, "version = 1", f"{TABLE}gravity = 1.1}}", "randomisation.gravity: expected a list"),
    "a falling range": (META, "version = 1", f"{TABLE}object_mass = [1.5, 0.5]}}", "two rising numbers, got 1.5 0.5"),
    "half a step of delay": (
        META,
        "version = 1",
        f"{TABLE}action_delay = [0, 1.5]}}",
        "action_delay[1]: expected a whole",
    ),
    "far too large": (META, "version = 1", f"{TABLE}object_size = [1, 2]}}", "randomisation.object_size[1]: expected"),
    "no TOML": (META, 'name = "own"', "name: own", "expected a suite file in TOML, but"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_names_file_key_and_mend(fault: str, tmp_path: Path) -> None:
    text, old, new, message = FAULTS[fault]
    assert old in text
    load_suite(write(tmp_path, text))
    file = write(tmp_path, text.replace(old, new, 1))
    with pytest.raises(BidexError) as raised:
        load_suite(file)
    told = str(raised.value)
    assert told.startswith(str(file)) and message in told and "\n" not in told


KEYS = ["name", "version", "kind", "observation", "task_id", "reward", "base", "tasks_per_class", "classes", "other"]
KEYS += ["variation", "success", "starts", "randomisation"]
VALUES = ["3", "-1", "true", '"train"', '"class"', "[]", "{}", "1.5", "[{}]", '[{ name = "HandOver" }]']


@given(st.dictionaries(st.sampled_from(KEYS), st.sampled_from(VALUES)))
def test_any_other_content_is_a_bidex_error(tmp_path_factory: pytest.TempPathFactory, content: dict[str, str]) -> None:
    text = "\n".join(f"{key} = {value}" for key, value in content.items())
    with pytest.raises(BidexError):
        load_suite(write(tmp_path_factory.getbasetemp(), text))
