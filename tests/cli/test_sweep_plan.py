"""What a sweep's file asks for: names, words, order, the grid; and files that are wrong."""

from pathlib import Path

import pytest

from bidex_meta.cli.parsing import peek_all
from bidex_meta.errors import BidexError
from bidex_meta.experiments.sweep_plan import PlannedRun, SweepPlan
from tests.pages import ROOT, blocks

FILE = """
name = "tiny"
tasks = ["HandOver"]
algos = ["ppo"]
seeds = [0, 1]
overrides = { steps = 6, num_envs = 8 }
"""


@pytest.fixture
def runs(tmp_path: Path):
    """The runs of a file of this text."""

    def read(text: str, *change: str) -> list[PlannedRun]:
        path = tmp_path / "s.toml"
        path.write_text(text.replace(*change) if change else text)
        return list(SweepPlan.read(path).runs)

    return read


def test_seeds_are_outermost_and_words_are_those_of_run(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(
        'name = "two words"\nsuites = ["MT4", "own.toml"]\nalgos = ["mtppo"]\nseeds = [3, 1]\n'
        "[overrides]\nsteps = 1_000\nlearner.hidden = [64, 32]\n[grid]\nlearner.gamma = [0.9, 0.99]\n"
        '[[arms]]\nname = "my arm"\nalgo = "mtsac"\ntasks = ["HandOver"]\n'
        "overrides = { learner = { policy_heads = false } }\n"
    )
    sweep = SweepPlan.read(path)
    names = [run.name for run in sweep.runs]
    half = len(names) // 2
    assert all("seed3" in name for name in names[:half]) and all("seed1" in name for name in names[half:])
    assert names[:5] == [
        "MT4-mtppo-gamma=0.9-seed3", "own-mtppo-gamma=0.9-seed3", "MT4-mtppo-gamma=0.99-seed3",
        "own-mtppo-gamma=0.99-seed3", "HandOver-my-arm-gamma=0.9-seed3",
    ]  # fmt: skip
    assert sweep.runs[1].given.suite == str(tmp_path / "own.toml") and sweep.folder == Path("runs/two-words")
    assert sweep.runs[4].begin == [
        "run", "--task=HandOver", "--algo=mtsac", "--steps=1000", "--seed=3", "--threads=1",
        "--learner.hidden", "64", "32", "--learner.gamma=0.9", "--learner.no-policy-heads",
        "--run-dir=runs/two-words/HandOver-my-arm-gamma=0.9-seed3",
    ]  # fmt: skip


def test_values_with_slashes_make_no_folders(runs) -> None:
    text = FILE.replace('"ppo"', '"bc"') + (
        '[grid]\ndataset = ["HandOver/medium-v0", "/data/mine", ["a/x", "b/x"]]\nlearner.gamma = [-0.5]\n'
    )
    found = runs(text)[:3]
    named = ["HandOver-medium-v0", "data-mine", "a-xxb-x"]
    assert [run.name for run in found] == [f"HandOver-bc-dataset={each}-gamma=-0.5-seed0" for each in named]
    assert [run.arm for run in found] == [f"bc dataset={each} gamma=-0.5" for each in named]
    assert all(run.path.parent == Path("runs/tiny") for run in found)
    with pytest.raises(BidexError, match="two runs are called HandOver-bc-dataset=HandOver-medium-v0"):
        runs(text, '"/data/mine"', '"HandOver-medium-v0"')


def test_a_flag_may_name_the_subject_and_several_data_sets_are_named_one_by_one(runs) -> None:
    run = runs(FILE, "steps = 6", 'steps = 6, demonstrations = "{subject}/script-v0", dataset = ["a/x", "b/x"]')[0]
    assert run.subject == "HandOver" and "--demonstrations=HandOver/script-v0" in run.begin
    assert peek_all(run.begin, "--dataset") == ["a/x", "b/x"]


def test_an_arm_that_sets_a_key_of_the_grid_is_not_run_once_a_value(runs) -> None:
    every = runs(
        FILE.replace("[0, 1]", "[0]") + "[grid]\nnum_envs = [8, 16]\nlearner.gamma = [0.8, 0.9]\n"
        '[[arms]]\nname = "x"\nalgo = "ppo"\noverrides = { num-envs = 4 }\n'
    )
    own = [run for run in every if run.arm.startswith("x")]
    assert [run.arm for run in own] == ["x gamma=0.8", "x gamma=0.9"] and len(every) == 4 + 2
    assert [word for word in own[0].begin if word.startswith("--num-envs")][-1] == "--num-envs=4"


def test_an_arm_may_leave_seeds_out(runs) -> None:
    text = FILE + (
        '[[arms]]\nname = "x"\nalgo = "ppo"\nseeds = [1]\n'
        '[[arms]]\nname = "y"\nalgo = "ppo"\nstart_from = "ppo"\nseeds = [0]\n'
    )
    found = runs(text)
    assert [(run.arm, run.seed) for run in found] == [("ppo", 0), ("y", 0), ("ppo", 1), ("x", 1)]
    assert found[1].after == found[0].path
    with pytest.raises(BidexError, match="the arm 'x', of which there are 0 runs on HandOver"):
        runs(text, 'start_from = "ppo"', 'start_from = "x"')


@pytest.mark.parametrize(
    "change, told",
    [
        (("seeds = [0, 1]", "seeds = []"), "seeds: expected a list"),
        (("seeds = [0, 1]", "seeds = [0, 0]"), "two runs are called HandOver-ppo-seed0"),
        (("algos", "algoss"), "algoss: unknown entry"),
        (('algos = ["ppo"]', ""), "expected algos"),
        (('tasks = ["HandOver"]', ""), "expected suites or tasks"),
        (('"tiny"', '"../up"'), "name: expected"),
        (("steps = 6", "seed = 6"), "overrides.seed: other entries of the file"),
        (("steps = 6", "threads = 6"), "overrides.threads: other entries of the file"),
        (("[0, 1]", "[0, 1]\ngrid = { num_envs = 3 }"), "grid.num_envs: expected a list of values"),
        (("[0, 1]", '[0, 1]\narms = [{ name = "x" }]'), r"arms\[.*algo: expected it to be there"),
        (
            ("[0, 1]", '[0, 1]\narms = [{ name = "x", algo = "ppo", seeds = [2] }]'),
            "expected seeds of the file's, got",
        ),
        (("[0, 1]", "[0, 1"), "expected a sweep in TOML"),
    ],
)
def test_a_bad_file_is_one_line(runs, change: tuple[str, str], told: str) -> None:
    with pytest.raises(BidexError, match=told):
        runs(FILE, *change)


TOO_FEW = (
    ('arms = [{ name = "x", algo = "pearl", suites = ["ML1-v2"] }]', "CatchUnderarm has 50 tasks and 8 environments"),
    (
        'arms = [{ name = "x", algo = "rl2", suites = ["ML5-v2"], overrides = { num_envs = 2 } }]',
        "4 mini-batches need as many environments, got 2",
    ),
    ('arms = [{ name = "x", algo = "maml", suites = ["ML4-v2"] }]', "has 2 environments for 3 tasks of a meta-batch"),
)
"""Arms of learners that need more environments than FILE has."""
TWICE = 'arms = [{ name = "x", algo = "ppo" }, { name = "y", algo = "ppo", overrides = { shots = 3 } }]'
"""Two arms with the same config; the second has an evaluation that its learner does not support."""


def test_what_run_would_refuse_is_told_before_anything_begins(tmp_path: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(tmp_path)
    for change, told in (
        (('["ppo"]', '["ppoo"]'), "ppoo on HandOver: Unknown algo 'ppoo'"),
        (('"HandOver"', '"HandOvr"'), "Unknown task 'HandOvr'"),
        (("steps = 6", 'learner = { gama = "x" }'), "Did you mean 'gamma'?"),
        (("steps = 6", "learner = { gamma = 3.0 }"), "gamma"),
        *[(('algos = ["ppo"]', line), told) for line, told in TOO_FEW],
        (('["ppo"]', '["promp"]'), "promp adapts to hidden goals, but HandOver shows them"),
        (('algos = ["ppo"]', TWICE), "ppo does not adapt to tasks, got --shots 3"),
    ):
        Path("s.toml").write_text(FILE.replace(*change))
        error = refused("sweep", "s.toml")
        assert told in error and error.count("\n") == 1 and not Path("runs").exists()


def test_the_sweeps_of_the_repository_are_what_run_takes(tmp_path: Path, monkeypatch, shown) -> None:
    monkeypatch.chdir(tmp_path)
    for teachers in ("results", "assets"):
        (tmp_path / teachers).symlink_to(ROOT / teachers)
    # Data sets must be recorded before the sweep; its file lists them.
    monkeypatch.setattr("bidex_meta.experiments.run_data.open_datasets", lambda names: [])
    monkeypatch.setattr("bidex_meta.experiments.run_data.check_offline", lambda *_: None)
    for path in sorted((ROOT / "results" / "sweeps").glob("*.toml")):
        if "seeds" in path.read_text():
            assert f"--run-dir=runs/{path.stem}/" in shown("sweep", path, "--dry-run")
    assert not (tmp_path / "runs").exists()


def test_the_sweep_of_the_page_is_what_run_takes(tmp_path: Path, monkeypatch, shown) -> None:
    monkeypatch.chdir(tmp_path)
    (text,) = [block.text for block in blocks(ROOT / "docs" / "sweeps.md") if block.language == "toml"]
    Path("mystudy.toml").write_text(text)
    Path("own.toml").write_text((ROOT / "suites" / "MT1.toml").read_text())
    found = shown("sweep", "mystudy.toml", "--dry-run")
    assert found.count("--run-dir=runs/mystudy/") == 2 * 2 * 2 * 3 + 2 + 2 * 2 * 3
