import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bidex_meta.cli import COMMANDS, main
from bidex_meta.experiments.learners import choose_preset, learner_kind
from bidex_meta.runs import RunFolder, read_metrics
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.base import V2_PRESET
from tests.cli.small_runs import SMALL, final, run
from tests.pages import ROOT

# Help and errors.


SPINS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


@pytest.mark.parametrize(
    "given, after",
    [
        ({}, {"GOMP_SPINCOUNT": "1000", "KMP_BLOCKTIME": "1"}),
        ({"GOMP_SPINCOUNT": "7"}, {"GOMP_SPINCOUNT": "7", "KMP_BLOCKTIME": "1"}),
        ({"OMP_WAIT_POLICY": "active"}, {"OMP_WAIT_POLICY": "active"}),
    ],
)
def test_waiting_threads_spin_shortly_unless_the_user_says_otherwise(given: dict, after: dict) -> None:
    code = (
        "import os, subprocess, sys, bidex_meta\n"
        f"print({{name: os.environ[name] for name in {SPINS} if name in os.environ}}, flush=True)\n"
        + "subprocess.run([sys.executable, '-c', 'import torch'])"
        * (not given)  # a worker inherits them
    )
    free = {name: value for name, value in os.environ.items() if name not in SPINS}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=free | given | {"OMP_DISPLAY_ENV": "verbose"}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout.strip().splitlines()[0] == str(after)
    shown = re.findall(r"GOMP_SPINCOUNT = '(\d+)'", done.stderr)
    assert set(shown) <= {"1000"}  # what a torch with GNU's OpenMP took


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_each_help_opens_with_a_sentence_and_an_example(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    usage, sentence, example = capsys.readouterr().out.split("\n\n")[:3]
    assert usage.startswith(f"usage: bidex-meta {command}")
    assert sentence.rstrip().endswith(".")
    assert " ".join(example.split()).startswith(f"Example: bidex-meta {command} ")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("rum", "Did you mean 'run'?"),
        ("run --suite MT4 --num-evns 4", "Did you mean --num-envs?"),
        ("run --suite MT4 --learner.gama 0.9", "Did you mean --learner.gamma?"),
        ("run --suite MT4 --gamma 0.9", "Did you mean --learner.gamma?"),
        ("run --suite MT4 --lr 3e-4", "Did you mean --learner.learning-rate? See"),
        ("run --suite ML4 --algo promp --lr=1", "--learner.inner-learning-rate or --learner.outer-learning-rate?"),
        ("run --suite MT4 --xyzzy", "Unknown flag --xyzzy of bidex-meta run. See"),
        ("render --run x --out f.webp", "Unknown flag --run of bidex-meta render. Did"),
        ("run --suite MT4 --num-envs many", "--num-envs"),
        ("run --suite MT4 --num-envs 0", "--num-envs"),
        ("run --suite MT4 --steps 2.5", "2e7"),
        ("run --suite MT4 --minutes 0", "--minutes"),
        ("run --suite MT4 --minutes -1.5", "-1.5"),
        ("run --suite MT4 --minutes nan", "nan"),
        ("run --suite MT4 --minutes inf", "inf"),
        ("run --suite MT4 --minutes four", "four"),
        ("run --suite MT4 --learner.gamma 7", "gamma"),
        ("run --suite MT4 --algo mtpo", "Did you mean 'mtppo'?"),
        ("run --suite MT4 --preset lap", "Did you mean 'laptop'?"),
        ("run --suite MT4 --device gpu", "auto, cpu, cuda or cuda:N"),
        ("run --suite MT4 --device mps", "expected auto, cpu, cuda or cuda:N, got 'mps'. The physics runs on a CPU or"),
        ("run --suite MT4 --device meta", "expected auto, cpu, cuda or cuda:N, got 'meta'"),
        ("run --suite MT4 --device cpu:1", "expected auto, cpu, cuda or cuda:N, got 'cpu:1'"),
        ("train --suite MT4", "Did you mean 'run'?"),
        ("Test --suite MT4", "Did you mean 'evaluate'?"),
        ("run", "either --suite SUITE or --task TASK"),
        ("run --suite MT4 --task HandOver", "either --suite SUITE or --task TASK"),
        ("run --suite MT5", "Did you mean 'MT5-v2'?"),
        ("run --suite MT6", "MT4-v2, MT5-v2, metaworld/MT10, metaworld/MT3."),
        ("run --suite mt10", "Did you mean 'metaworld/MT10'?"),
        ("run --task handove", "Did you mean 'HandOver'?"),
        ("run --resume nowhere", "not a run folder"),
        ("list suits", "Did you mean 'suites'?"),
        ("list", "suites|tasks|hidden|algos|objects"),
        ("evaluate nowhere", "not a run folder"),
        ("evaluate nowhere --split tets", "'train', 'test'"),
        ("bench speed", "Unknown bench"),
        ("render --task HandOver --out a.gif", ".png"),
        ("render --task HandOver --out a.mp4 --width 101", "even"),
        ("render --task gymnasium/Humanoid-v5 --out a.png", "got gymnasium/Humanoid-v5. Name another."),
        ("render --task gymnasium/Humanoid-v5 --tiled --out a.png", "got gymnasium/Humanoid-v5. Name another."),
        ("render --suite metaworld/MT10 --out a.png", "got metaworld/MT10. Name another."),
        ("render --suite metaworld/MT10 --tiled --out a.png", "got metaworld/MT10. Name another."),
        ("render --suite metaworld/MT3 --task reach-v3 --out a.png", "bidex-meta's own classes"),
        ("baseline random --suite metaworld/MT3", "bidex-meta's own classes"),
        ("run --suite metaworld/MT4", "Unknown suite 'metaworld/MT4'. Did you mean 'metaworld/MT3'?"),
        ("run --suite metaworld/MT3 --preset metaworl", "Did you mean 'metaworld'?"),
        ("bench world --steps 0", "--steps of 1 or more"),
        ("bench world --repeats 0", "--repeats: expected a whole number >= 1"),
        ("bench world --suite MT5", "MT4"),
        ("bench world --device tpu", "device: expected auto"),
        ("bench world --engine d", "Unknown engine"),
        ("bench world --against HEAD", "Unknown flag --against"),
        ("witness", "--task"),
        ("witness --task HandOver --all", "--task"),
        ("witness --task HandOve", "Did you mean 'HandOver'?"),
        ("witness --all --out film.mp4", "--out"),
        ("witness --task HandOver --file a.npz", "a.npz"),
        ("witness --find", "Unknown flag --find"),
        ("run --task HandOver --points -1", "--points: "),
        ("run --suite MT4 --points 99999", "16384"),
        ("run --suite MT4 --tasks-per-class -1", "--tasks-per-class: expected a whole number >= 0, got -1."),
        ("run --suite ML1-Switch-choice2 --tasks-per-class 0", "got 0 with the listed tasks of Switch. Leave"),
        ("run --suite metaworld/MT3 --tasks-per-class 0", "got metaworld/MT3. Leave --tasks-per-class out."),
        ("run --task Switch-v2 --tasks-per-class 0", "got --task Switch-v2. Name a suite of the class"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 2
    captured = capsys.readouterr()
    assert expected in captured.err
    assert captured.err.startswith("bidex-meta: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


HUMANOID = "run --task gymnasium/Humanoid-v5 --num-envs 4 --device cpu --algo ppo"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("run --suite metaworld/MT10 --num-envs 9", "num_envs: expected at least 10"),
        ("run --suite metaworld/MT3 --engine warp", "--device cpu"),
        ("run --suite metaworld/MT10 --points 16", "own scenes have point clouds"),
        (
            "run --suite metaworld/MT10 --touch",
            "Only bidex-meta's hands have touch sensors, got metaworld/MT10. Leave --touch",
        ),
        ("run --suite ML1 --algo maml --points 16 --threads 1", "does not read point clouds"),
        *(
            (
                f"{HUMANOID} {flag} {value}",
                f"{flag} is for classes with hands, got {value} with gymnasium/Humanoid-v5",
            )
            for flag, value in (("--points", 8), ("--object", "mug"), ("--base", "moving"))
        ),
        (f"{HUMANOID} --engine warp", "CPU"),
    ],
)
def test_what_worlds_refuse_is_one_line_after_what_the_run_is(arguments, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("bidex-meta: ")] == lines[-1:] and expected in lines[-1]
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback():
    with pytest.raises(ValueError, match="Did you mean 'run'"):
        main(["rum", "--debug"])


# Config.


def test_print_config_is_json_of_everything_and_writes_nothing(shown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = json.loads(shown("run", *SMALL, "--steps", "2e7", "--learner.gamma", "0.91", "--print-config"))
    assert (config["suite"], config["task"], config["algo"], config["preset"]) == ("MT4", None, "mtppo", "laptop")
    assert (config["steps"], config["threads"], config["learner"]["gamma"]) == (20_000_000, 1, 0.91)
    assert config["learner"]["hidden"] == [8] and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "preset", "gamma"),
    [
        ("mtppo --suite MT20-v2", "v2", 0.99), ("ppo --task DoorOpenOutward-v2", "v2", 0.99),
        ("rl2 --suite ML1-v2", "v2", 0.99), ("varibad --suite ML1-v2", "v2", 0.99),
        ("pearl --suite ML1-v2", "v2", 0.99), ("maml --suite ML1-v2", "v2", 0.99),
        ("promp --suite ML1-v2", "v2", 0.99), ("rl2 --suite ML1", "laptop", 0.93),
        ("mtppo --suite MT20-v2 --preset laptop", "laptop", 0.93), ("mtppo --suite MT20", "laptop", 0.93),
        ("mtsac --suite MT20-v2", "laptop", 0.93), ("ppo --task DoorOpenOutward", "laptop", 0.93),
    ],
)  # fmt: skip
def test_the_discount_fits_the_suite(shown, words, preset, gamma):
    config = json.loads(shown("run", "--algo", *words.split(), "--device", "cpu", "--print-config"))
    assert (config["preset"], config["learner"]["gamma"]) == (preset, gamma)


# Run, resume, evaluate, plot, render.


@pytest.mark.parametrize(
    ("algo", "version", "cpu", "gpu"),
    [
        ("mtppo", 1, "laptop", "paper"), ("mtppo", 2, "v2", "v2"), ("mtsac", 2, "laptop", "paper"),
        ("maml", 1, "laptop", "laptop"), ("maml", 2, "v2", "v2"), ("rl2", 1, "laptop", "paper"),
        ("rl2", 2, "v2", "gpu"), ("varibad", 1, "laptop", "laptop"), ("varibad", 2, "v2", "gpu"),
        ("pearl", 1, "laptop", "laptop"), ("pearl", 2, "v2", "gpu"), ("flashsac", 1, "laptop", "gpu"),
    ],
)  # fmt: skip
def test_the_automatic_preset_fits_version_and_device(algo, version, cpu, gpu):
    first = V2_PRESET if version == 2 else None
    found = [choose_preset(learner_kind(algo), "auto", device, first)[0] for device in ("cpu", "cuda")]
    assert found == [cpu, gpu]


def test_run_trains_evaluates_and_can_be_looked_at_again(toy_worlds, tmp_path, capsys, shown, refused):
    path = tmp_path / "r"
    assert run("--steps", 240, "--run-dir", path, "--episodes", 2, "--other-tasks") == 0
    captured = capsys.readouterr()
    assert "other tasks (seed 500000)" in captured.out
    for text in ("Near", "Far", "random return", "random"):
        assert text in captured.out
    assert "Preset laptop: the device is a CPU." in captured.err
    assert str(path) in captured.err
    assert [row["step"] for row in read_metrics(path / "metrics.jsonl")] == list(range(24, 241, 24))
    assert final(path)[1] == 240
    report = json.loads((path / "evaluation.json").read_text())
    assert report["policy"]["classes"]["Near"]["episodes"] == 6
    assert report["other_tasks"]["task_seed"] == 500_000

    found = json.loads(shown("evaluate", path, "--random", "--json", "--episodes", 2, "--other-tasks"))
    # The policy of the checkpoint is the one that was trained.
    assert found["steps"] == 240 and found | {"conditions": None} == report | {"conditions": None}
    assert set(found["return_above_random"]["Far"]) == {"value", "interval"}
    assert "Near" in shown("evaluate", path)
    assert "adapts" in refused("run", *SMALL[:6], "--algo", "maml", "--other-tasks")
    shown("plot", path)
    assert (path / "curves.png").stat().st_size > 0


def test_what_a_run_publishes_holds_no_path_of_this_machine(toy_worlds, tmp_path, shown):
    suite = Path(shutil.copyfile(ROOT / "suites" / "MT4.toml", tmp_path / "mine.toml"))
    for gamma in (0.9, 0.8):
        words = [
            *SMALL[2:],
            "--suite",
            suite,
            "--learner.gamma",
            gamma,
            "--steps",
            24,
            "--run-dir",
            tmp_path / f"r{gamma}",
        ]
        assert main(["run", *map(str, words)]) == 0
    runs = [tmp_path / "r0.9", tmp_path / "r0.8"]
    shown("report", *runs, "--out", tmp_path / "page.html")
    shown("baseline", "zero", "--suite", suite, "--out", tmp_path / "zero.json", "--episodes", 1)
    written = [tmp_path / "page.html", tmp_path / "zero.json", runs[0] / "evaluation.json", *runs[0].glob("events*")]
    texts = [path.read_bytes() for path in written] + [shown("evaluate", runs[0], "--json").encode()]
    assert len(texts) == 5 and not any(str(tmp_path).encode() in text for text in texts)


def test_whatever_takes_long_is_noted(toy_worlds, tmp_path, noted):
    assert run("--steps", 48, "--run-dir", tmp_path / "r", "--episodes", 1) == 0
    expected = ["run, starting", "Building the world of MT4", "Making the learner", "Iteration 1", "Saving"]
    expected += ["Playing episodes to evaluate"]
    places = [next(i for i, what in enumerate(noted) if part in what) for part in expected]
    assert places == sorted(places)


def test_of_a_flag_given_twice_the_last_one_counts(shown):
    config = json.loads(shown("run", *SMALL, "--algo", "mtppo", "--algo", "mttrpo", "--print-config"))
    assert config["algo"] == "mttrpo" and "max_kl" in config["learner"]


def test_a_run_can_start_from_the_policy_of_another(toy_worlds, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    assert run("--steps", 48, "--run-dir", first, "--no-evaluate") == 0
    capsys.readouterr()
    assert run("--start-from", first, "--steps", 24, "--run-dir", second, "--no-evaluate", "--seed", 1) == 0
    assert f"Starting from the policy of {first} at 48 steps." in capsys.readouterr().err
    assert RunFolder.open(second).config().start_from == str(first)
    flags = ["--start-from", first, "--steps", 24, "--run-dir", tmp_path / "other", "--no-evaluate"]
    assert run(*flags, "--suite", "MT4-v2") == 0
    note = f"Note: {first} learned MT4 by other rules than those of MT4-v2: reward paper, not v2, variation narrow, "
    note += "not wide, success once, not at-end, starts plain, not jittered."
    assert capsys.readouterr().err.count(note) == 1
    mt4 = (ROOT / "suites" / "MT4.toml").read_text()
    (tmp_path / "other.toml").write_text(mt4.replace('"HandOver"', '"SwingCup"').replace("MT4", "other"))
    assert run(*flags[:-2], tmp_path / "swapped", "--no-evaluate", "--suite", tmp_path / "other.toml") == 0
    assert "learned other classes: CatchUnderarm HandOver CatchAbreast Two" in capsys.readouterr().err
    layers = [final(path)[0]["learner"]["policy"]["weights"]["actor.mean.body.0.weight"] for path in (first, second)]
    assert 0 < (layers[0] - layers[1]).abs().max() < 0.02  # one update away; fresh weights of seed 1 differ by 1
    assert main(["run", "--resume", str(second), "--steps", "48", "--no-evaluate"]) == 0
    assert "Starting from" not in capsys.readouterr().err
    for flags, expected in (
        (["--start-from", tmp_path / "none"], "not a run folder"),
        (["--start-from", first, "--learner.activation", "tanh"], "activation = tanh, got elu"),
        (["--resume", second, "--start-from", second], "--start-from is"),
    ):
        folder = [] if "--resume" in flags else ["--run-dir", tmp_path / "third"]
        assert run(*flags, *folder) == 2
        shown = capsys.readouterr().err
        assert expected in shown and shown.rstrip().count("\n") <= 2
        assert not (tmp_path / "third").exists()


def test_a_single_task_can_be_played_with_moving_bases_as_in_suites(shown, refused):
    for flags, actions in (([], 40), (["--base", "moving"], 52), (["--base", "fixed"], 40)):
        config = json.loads(shown("run", "--task", "HandOver", "--algo", "ppo", "--print-config", *flags))
        source = open_worlds(config | {"threads": 1})
        world = source.world()
        assert source.moving_bases == (actions == 52) and world.single_action_space.shape == (actions,)
        world.close()
    assert "--base moving goes with --task" in refused("run", "--suite", "MT4", "--base", "moving", "--print-config")


def test_a_single_task_has_its_own_column_of_table_42(shown):
    layers, entries = [1024, 1024, 512], ("hidden", "num_minibatches", "epochs", "rollout_steps", "gamma")
    for task, column in (
        ("CatchUnderarm", [layers, 4, 5, 8, 0.96]),
        ("LiftUnderarm", [layers, 4, 10, 20, 0.96]),
        ("StackBlock", [layers, 8, 2, 8, 0.9]),
    ):
        config = json.loads(shown("run", "--task", task, "--algo", "ppo", "--preset", "paper", "--print-config"))
        assert [config["learner"][name] for name in entries] == column
