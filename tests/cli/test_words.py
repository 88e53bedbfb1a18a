"""Names, hints and completion: the words of the command line."""

import json
import re
import shutil
import subprocess
import sys

import pytest

from bidex_algos.onpolicy.mtppo import MTPPO, PRESETS
from bidex_meta.cli import COMMANDS, main
from bidex_meta.experiments import catalogue
from bidex_meta.experiments.learners import ALGOS, learner_kind
from bidex_meta.suite_files import suite_names
from bidex_meta.tasks import registry


def test_help_and_lists_need_no_torch():
    heavy = {"torch", "mujoco", "metaworld", "scipy", "tensorboard", "bidex_algos.learner", "bidex_meta.world"}
    lines = [["--help"], ["list", "suites"], ["list", "tasks"], ["list", "algos"]]
    code = f"import sys; from bidex_meta.cli import main; [*map(main, {lines})]; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    named = [*COMMANDS, "MT10", "MT20-v2", *registry.names(), *ALGOS]
    assert all(name in done.stdout for name in named) and done.stdout.rstrip().endswith("set()")
    assert "None" not in done.stdout


def test_the_help_of_run_fits_three_screens_and_that_of_all_flags_names_them_all(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    for algo in ("mtppo", "mtsac", "maml"):
        brief = help_of("--algo", algo, "--help", capsys=capsys)
        assert len(brief.splitlines()) <= 3 * 24 and "--suite" in brief and "--learner.gamma" in brief
        assert max(map(len, brief.splitlines())) <= 80
    every = help_of("--help-all", capsys=capsys)
    flags = set(re.findall(r"^  (--[a-z-]+(?:\.[a-z-]+)?)", every, re.MULTILINE))
    assert flags >= {"--engine", "--learner.desired-kl", "--split"} and "--learner.desired-kl" not in brief


def help_of(*words, capsys):
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(["run", *words])
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_lists_read_from_source_are_as_the_classes_say(shown):
    suites = {row["name"]: row for row in json.loads(shown("list", "suites", "--json"))}
    assert suites["ML4"]["test_classes"] == ["TwoCatchUnderarm"]
    for row in json.loads(shown("list", "tasks", "--json")):
        task = registry.get(row["name"])
        assert (row["observation"], row["action"]) == (task.observation_size, task.action_size)
        assert (row["episode_steps"], row["summary"]) == (task.episode_steps, task.summary)
    for row in json.loads(shown("list", "algos", "--json")):
        kind = learner_kind(row["name"])
        assert row["presets"] == list(kind.presets) and "arXiv" in row["summary"]
        assert (kind.learner_class.__doc__ or "").startswith(row["summary"])


def test_a_class_whose_docstring_gives_no_size_is_named(monkeypatch, capsys):
    monkeypatch.setattr(catalogue, "_docstring", lambda *place: "Throw an egg.")
    assert main(["list", "tasks"]) == 2
    told = capsys.readouterr().err
    assert "HandOver: expected the observation's size" in told and told.count("\n") == 1


def test_a_listed_learner_without_presets_has_those_of_its_module(monkeypatch):
    monkeypatch.setattr(MTPPO, "presets", {})
    assert learner_kind("mtppo").presets == PRESETS


def test_names_are_taken_in_any_case_and_kept_as_they_are_written(capsys):
    for flags, expected in (
        (["--suite", "mt4", "--algo", "MTPPO", "--preset", "Paper"], ("MT4", None, "mtppo", "paper")),
        (["--suite", "MetaWorld/mt3", "--algo", "mtsac"], ("metaworld/MT3", None, "mtsac", "metaworld")),
        (["--task", "handover", "--algo", "PPO"], (None, "HandOver", "ppo", "laptop")),
    ):
        assert main(["Run", *flags, "--device", "cpu", "--print-config"]) == 0
        config = json.loads(capsys.readouterr().out)
        assert (config["suite"], config["task"], config["algo"], config["preset"]) == expected
    assert main(["list", "SUITES", "--json"]) == 0


# A line of bash that completes the last of its words with the script that is read from a file.
_COMPLETE = """
source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_tyro_bidex_meta bidex-meta "${COMP_WORDS[$COMP_CWORD]}" ""; echo "${COMPREPLY[*]}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_flags_and_names(tmp_path, capsys):
    assert main(["completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    for words, expected in (
        ("ru", {"run"}),
        ("run --learner.gam", {"--learner.gamma"}),
        ("run --suite MT", {name for name in suite_names() if name.startswith("MT")}),
        ("run --suite ML1-Switch-c", {"ML1-Switch-choice2", "ML1-Switch-choice4"}),
        ("run --algo mtp", {"mtppo"}),
        ("witness --task Hand", {"HandOver"}),
        ("run --object ha", {"hammer"}),
        ("run --base ", {"own", "moving", "fixed"}),
    ):
        command = ["bash", "-c", _COMPLETE, "bash", str(tmp_path / "script"), "bidex-meta", *words.split(" ")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert set(done.stdout.split()) == expected, words


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_a_script_too(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(f"'{name}'" in script for name in COMMANDS)
