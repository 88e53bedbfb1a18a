"""``open_worlds``: own suites, single classes and Meta-World's suites answer the same questions."""

from pathlib import Path
from typing import Any

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.utils import paths
from bidex_meta.worlds import WorldsConfig, open_worlds

CORE = Path(paths.__file__).parents[1]


@pytest.fixture
def named(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, object]:
    """A config; the suite ``mine.toml`` is a file of the user's, with the tasks of MT1."""
    if request.param.get("suite") != "mine.toml":
        return {"threads": 1, **request.param}
    file = tmp_path / "mine.toml"
    file.write_text((paths.suites_dir() / "MT1.toml").read_text())
    return {"threads": 1, "suite": str(file)}


# For each split: slots, tasks of each, rows of an evaluation world, observations and actions.
WORLDS: list[Any] = [
    ({"suite": "MT4"}, {"train": (4, 50, 200, 450, 52)}),
    ({"suite": "ML1"}, {"train": (1, 3, 3, 422, 52), "test": (1, 1, 1, 422, 52)}),
    ({"suite": "mine.toml"}, {"train": (4, 1, 4, 426, 52)}),
    ({"task": "HandOver"}, {"train": (1, 50, 50, 398, 40)}),
    ({"task": "HandOver", "base": "moving"}, {"train": (1, 50, 50, 422, 52)}),
    ({"suite": "metaworld/MT3"}, {"train": (3, 50, 15, 42, 4)}),
]


@pytest.mark.parametrize(("named", "expected"), WORLDS, indirect=["named"])
def test_worlds_of_each_split(named: dict[str, object], expected: dict[str, tuple[int, ...]]) -> None:
    source = open_worlds(named)
    assert source.name == (named.get("suite") or named["task"])
    assert source.splits == list(expected)
    for split, (slots, tasks, rows, observations, actions) in expected.items():
        world = source.world(split)
        assert list(source.tasks(split)) == list(world.task_names) and world.num_tasks == slots
        assert [len(pool) for pool in source.tasks(split).values()] == [tasks] * slots
        assert world.num_envs == rows and world.autoreset_mode.name == "DISABLED"
        assert world.single_observation_space.shape == (observations,)
        assert world.single_action_space.shape == (actions,)
        world.close()
    training = source.world("train", 12, "SAME_STEP")
    assert training.num_envs == 12 and training.autoreset_mode.name == "SAME_STEP"
    training.close()


def test_tasks_are_called_as_the_suite_file_calls_them() -> None:
    ml1 = open_worlds({"suite": "ML1"})
    assert ml1.tasks("train") == {"CatchUnderarm": ["original", "left", "right"]}
    assert ml1.tasks("test") == {"CatchUnderarm": ["back"]} and open_worlds({"suite": "MT4"}).tasks("test") == {}


def test_defaults_follow_the_source() -> None:
    own, alone, foreign = (
        open_worlds(config) for config in ({"suite": "ML1"}, {"task": "HandOver"}, {"suite": "metaworld/MT10"})
    )
    assert [s.hides_goals for s in (own, alone, foreign)] == [True, False, False]
    assert [s.on_gpu for s in (own, alone, foreign)] == [True, True, False]
    assert [s.default_episodes for s in (own, alone, foreign)] == [4, 4, 1]
    assert [s.preset and s.preset[0] for s in (own, alone, foreign)] == [None, None, "metaworld"]
    of_version_2 = (open_worlds(config) for config in ({"suite": "ML1-v2"}, {"task": "HandOver-v2"}))
    assert [s.preset and s.preset[0] for s in of_version_2] == ["v2", "v2"]
    assert own.rows_and_steps("cpu", adapts=True) == (300, 20_000_000)
    assert alone.rows_and_steps("cuda:0", adapts=False) == (8192, 200_000_000)
    assert foreign.rows_and_steps("cpu", adapts=False) == (40, 20_000_000)


def test_a_meta_suite_may_show_its_goals(tmp_path: Path) -> None:
    file = tmp_path / "shown.toml"
    file.write_text((paths.suites_dir() / "ML4.toml").read_text().replace('"masked"', '"plain"'))
    shown = open_worlds({"suite": str(file), "threads": 1})
    assert not shown.hides_goals and shown.splits == ["train", "test"]


def test_a_multi_task_suite_may_hide_its_goals(tmp_path: Path) -> None:
    file = tmp_path / "hidden.toml"
    file.write_text((paths.suites_dir() / "MT4.toml").read_text().replace('"one-hot"', '"masked"'))
    hidden = open_worlds({"suite": str(file), "threads": 1})
    world: Any = hidden.world("train", 4)
    assert hidden.hides_goals and world.hides_goals and hidden.splits == ["train"]


def test_references_are_of_moving_bases() -> None:
    assert open_worlds({"suite": "MT4"}).references().keys() >= {"CatchUnderarm"}
    for config in ({"task": "HandOver"}, {"suite": "metaworld/MT3"}, {"task": "gymnasium/Humanoid-v5"}):
        assert open_worlds(config).references() == {}
    assert open_worlds({"task": "HandOver", "base": "moving"}).references()


def test_a_policy_is_judged_on_every_task_of_its_slots() -> None:
    source = open_worlds({"task": "Switch", "threads": 1})
    world = source.world()
    found = source.evaluate(ZeroAgent(world.action_space), world, source.protocol("train", 1, 3))
    world.close()
    assert len(found.classes["Switch"].returns) == 50 and found.classes["Switch"].reference is not None


@pytest.mark.parametrize(
    ("config", "told"),
    [
        ({"suite": "MT5"}, "Unknown suite 'MT5'. Did you mean"),
        ({"suite": "none.toml"}, "Expected a suite file at none.toml"),
        ({"task": "HandOvr"}, "Unknown task 'HandOvr'. Did you mean 'HandOver'?"),
        ({"suite": "metaworld/MT4"}, "Unknown suite 'metaworld/MT4'. Did you mean 'metaworld/MT3'?"),
    ],
)
def test_an_unknown_name_is_one_line(config: dict[str, object], told: str) -> None:
    with pytest.raises(BidexError) as error:
        open_worlds(config)
    assert str(error.value).startswith(told) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("config", "split", "told"),
    [
        ({"suite": "MT4"}, "test", "MT4 has the splits train, got 'test'"),
        ({"task": "HandOver"}, "test", "A run on the single task HandOver has no test split. Leave --split out."),
        ({"suite": "metaworld/MT3"}, "test", "metaworld/MT3 has only the split train, got 'test'."),
        ({"task": "gymnasium/Humanoid-v5"}, "test", "gymnasium/Humanoid-v5 has only the split train, got 'test'."),
        ({"suite": "metaworld/MT3", "device": "cuda"}, "train", "got --device cuda. Add --device cpu."),
        ({"suite": "metaworld/MT3", "engine": "warp"}, "train", "got --engine warp. Add --device cpu."),
    ],
)
def test_a_world_that_cannot_be_is_refused(config: dict[str, object], split: str, told: str) -> None:
    with pytest.raises(BidexError) as error:
        open_worlds(config).world(split)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_a_config_is_taken_as_it_is_or_from_a_run() -> None:
    config = WorldsConfig(task="HandOver", seed=1, task_seed=5)
    of_run = {"task": "HandOver", "suite": None, "algo": "ppo", "seed": 1, "task_seed": 5}
    assert WorldsConfig.of(of_run) == config == open_worlds(config).config
    assert open_worlds(of_run).seed == 5
