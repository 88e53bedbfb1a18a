"""Runs from Python: what the commands do, as functions."""

import json
import logging
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import bidex_meta
from bidex_algos.offpolicy import mtsac
from bidex_algos.onpolicy import mtppo
from bidex_meta.cli import main
from bidex_meta.config import RunConfig
from bidex_meta.data import open_dataset
from bidex_meta.errors import BidexError
from bidex_meta.experiments import sweeping
from bidex_meta.experiments.evaluating import FinalEvaluation, evaluate, meta_test
from bidex_meta.experiments.plotting import plot
from bidex_meta.experiments.recording import RecordConfig, record
from bidex_meta.experiments.run_config import resolve
from bidex_meta.experiments.run_data import implied
from bidex_meta.experiments.sweep_plan import SweepPlan
from bidex_meta.experiments.sweeping import sweep
from bidex_meta.experiments.training import Event, Stopped, train
from bidex_meta.experiments.transferring import transfer
from bidex_meta.experiments.verifying import verify
from bidex_meta.runs import RunFolder
from bidex_meta.runs.evaluations import parse_evaluation
from tests.algos.ranks import same

CONFIG = RunConfig(
    suite="MT4", algo="mtppo", learner={"hidden": [8], "rollout_steps": 4}, num_envs=6, steps=48, threads=1,
    device="cpu", logger="none",
)  # fmt: skip
WORDS = "--suite MT4 --algo mtppo --learner.hidden 8 --learner.rollout-steps 4 --num-envs 6 --steps 48 --threads 1"


def final(run: RunFolder) -> object:
    loaded = run.checkpoints.load()
    assert loaded is not None
    return loaded


def test_every_public_name_is_there() -> None:
    for name in bidex_meta.__all__:
        assert getattr(bidex_meta, name) is not None
    assert callable(bidex_meta.train) and bidex_meta.learner_class("mtppo").__name__ == "MTPPO"


def test_a_run_is_that_of_the_command(toy_worlds: None, tmp_path: Path) -> None:
    run = train(CONFIG, run_dir=tmp_path / "python")
    words = [*WORDS.split(), "--device", "cpu", "--logger", "none", "--run-dir", str(tmp_path / "command")]
    assert main(["run", *words]) == 0
    other = RunFolder.open(tmp_path / "command")
    assert run.config() == other.config() and same(final(run), final(other))
    found = evaluate(run, random=True, device="cpu", save=True)
    assert replace(run.evaluation(), run=None) == replace(other.evaluation(), run=None)
    assert 0.0 <= found.success <= 1.0 and verify(run).agrees


def test_a_resumed_run_is_that_of_an_unbroken_one(toy_worlds: None, tmp_path: Path) -> None:
    events: list[Event] = []
    half = train(replace(CONFIG, steps=24), run_dir=tmp_path / "half", on_event=events.append)
    assert [event.kind for event in events] == ["started", "iteration", "ended"]
    assert events[1].step == 24 and "Perf/steps_per_second" in events[1].metrics
    train(replace(half.config(), steps=48), resume=half)
    whole = train(CONFIG, run_dir=tmp_path / "whole")
    assert same(final(half), final(whole))
    for run in (half, whole.path):
        assert plot([run], tmp_path / "curves.png").stat().st_size > 1000
    with pytest.raises(BidexError, match=r"--seed is 0 in .*half, not 1: a resumed run keeps its config"):
        train(replace(half.config(), seed=1), resume=str(half.path))
    with pytest.raises(BidexError, match="has trained for 48 steps, expected --steps of at least that, got 24"):
        train(replace(half.config(), steps=24), resume=half)
    assert half.config().steps == 48
    with pytest.raises(BidexError, match="continues in the run's own folder"):
        train(CONFIG, run_dir=tmp_path / "other", resume=half)
    with pytest.raises(BidexError, match="Expected a config or a run to resume"):
        train()


def test_a_resolved_config_is_complete_and_stays_as_it_is() -> None:
    config = resolve(RunConfig(suite="mt4-v2", learner={"gamma": 0.9}, seed=3))
    assert config.suite == "MT4-v2" and config.learner.gamma == 0.9 and config.num_envs > 0 < config.steps
    assert None not in (config.num_envs, config.steps, config.threads) and resolve(config) == config
    assert resolve(RunConfig(suite="MT4", learner=mtppo.PRESETS["paper"], device="cpu")).preset == "paper"


@pytest.mark.parametrize(("suite", "algo", "rows"), [("ML1-Switch-v2", "rl2", 16), ("ML4-v2", "varibad", 48)])
def test_learners_of_whole_trials_take_few_environments_of_each_class(suite: str, algo: str, rows: int) -> None:
    assert resolve(RunConfig(suite=suite, algo=algo, device="cpu")).num_envs == rows


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"suite": None}, "Name what to train on"),
        ({"learner": {"gama": 0.9}}, "Did you mean 'gamma'?"),
        ({"learner": {1: 2}}, "expected names of options, got 1"),
        ({"learner": None}, "expected a MTPPOConfig or a mapping of options, got None"),
        ({"learner": mtsac.PRESETS["laptop"]}, "expected a MTPPOConfig or a mapping of options"),
        ({"learner": {"gamma": 9.0}}, "gamma"),
        ({"algo": "mtpp"}, "Did you mean 'mtppo'"),
        ({"num_envs": 3}, "at least 4"),
    ],
)
def test_bad_configs_are_refused_before_anything_is_written(
    change: dict[str, object], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(BidexError, match=expected):
        train(replace(CONFIG, **change), run_dir=tmp_path / "r")
    assert not list(tmp_path.iterdir())


def test_a_meta_test_and_an_evaluation_each_know_their_learners(
    adapted: Path, toy_worlds: None, tmp_path: Path
) -> None:
    with pytest.raises(BidexError, match=r"Use meta_test\(run\)"):
        evaluate(adapted)
    run = train(CONFIG, run_dir=tmp_path / "r2")
    with pytest.raises(BidexError, match=r"Use evaluate\(run\)"):
        meta_test(run)


def test_a_meta_test_is_that_of_the_command(adapted: Path) -> None:
    found = json.loads(json.dumps(meta_test(adapted, device="cpu").to_json()))
    recorded = RunFolder.open(adapted).evaluation()
    assert parse_evaluation(found, "found") == recorded


def test_a_sweep_of_configs_is_trained_once_and_resumed(toy_worlds: None, tmp_path: Path, monkeypatch) -> None:
    def work(runs, cores) -> int:
        return sum(main(run.begin) != 0 for run in runs)

    monkeypatch.setattr(sweeping, "work", work)  # in this process, on toy worlds
    final = FinalEvaluation(episodes=1)
    plan = SweepPlan.of(tmp_path / "gammas", {f"g{gamma}": gamma_config(gamma) for gamma in (0.9, 0.95)})
    plan = replace(plan, runs=[replace(run, final=final) for run in plan.runs])
    result = sweep(plan)
    assert [state.state for state in result.states] == ["done", "done"] and not result.failures
    assert RunFolder.open(tmp_path / "gammas" / "g0.95").config().learner_values["gamma"] == 0.95
    monkeypatch.setattr(sweeping, "work", lambda runs, cores: pytest.fail("trained twice") if runs else 0)
    assert sweep(plan).states == result.states
    with pytest.raises(BidexError, match=r"g0\.9 is a run with another config: its learner\.gamma is 0\.9, not"):
        sweep(SweepPlan.of(tmp_path / "gammas", {"g0.9": gamma_config(0.8)}))
    with pytest.raises(BidexError, match="Expected the name of a folder"):
        SweepPlan.of(tmp_path, {"../up": CONFIG})
    with pytest.raises(BidexError, match="Expected the name of a folder"):
        SweepPlan.of(tmp_path, {"..": CONFIG})


def gamma_config(gamma: float) -> RunConfig:
    return replace(CONFIG, learner={**CONFIG.learner, "gamma": gamma})


def test_a_data_set_is_that_of_the_command(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    small = {"size": 20, "num_envs": 2, "device": "cpu", "threads": 1}
    found = record(RecordConfig("random", task="HandOver", out=tmp_path / "python-v0", **small))
    words = "random --task HandOver --size 20 --num-envs 2 --device cpu --threads 1 --out"
    assert main(["record", *words.split(), str(tmp_path / "command-v0")]) == 0
    other = open_dataset(tmp_path / "command-v0")
    assert found.num_steps == other.num_steps >= 20
    with pytest.raises(BidexError, match="record random takes no run folders, got 1"):
        record(RecordConfig("random", runs=(tmp_path,)))


def test_the_policy_of_a_run_is_recorded_on_the_tasks_of_the_run(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    small = replace(CONFIG, suite="MT1-Switch-v2", tasks_per_class=2)
    run = train(small, run_dir=tmp_path / "r")
    settings = RecordConfig("medium", (run.path,), size=500, num_envs=4, device="cpu", threads=1, out=tmp_path / "d-v0")
    found = record(settings)
    assert set(found.table["task_index"].tolist()) == {0, 1}
    assert implied([found])["tasks_per_class"] == 2


def test_a_run_leaves_torch_as_it_was(toy_worlds: None, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        run = train(replace(CONFIG, deterministic=True), run_dir=tmp_path / "r")
        evaluate(run, device="cpu")
        assert torch.get_num_threads() == 3 and not torch.are_deterministic_algorithms_enabled()
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_a_run_learns_where_gradients_are_off(toy_worlds: None, tmp_path: Path, context: Callable[[], Any]) -> None:
    with context():
        run = train(CONFIG, run_dir=tmp_path / "without")
    assert same(final(run), final(train(CONFIG, run_dir=tmp_path / "with")))


def test_paths_and_numbers_of_numpy_are_taken(tmp_path: Path) -> None:
    learner = {"gamma": np.float32(0.5), "rollout_steps": np.int64(4)}
    given = RunConfig(suite=tmp_path / "a.toml", teacher=(tmp_path,), seed=np.int64(3), learner=learner)  # type: ignore[arg-type]
    assert (given.suite, given.teacher, given.seed) == (str(tmp_path / "a.toml"), (str(tmp_path),), 3)
    assert given.learner == {"gamma": 0.5, "rollout_steps": 4} and type(given.learner["gamma"]) is float
    json.dumps(given.to_json())


def test_a_run_makes_at_least_one_step() -> None:
    with pytest.raises(BidexError, match="--steps: expected a whole number >= 1, got 0"):
        RunConfig(suite="MT4", steps=0)


def test_a_transfer_needs_held_out_classes_and_ppo(toy_worlds: None, tmp_path: Path) -> None:
    run = train(CONFIG, run_dir=tmp_path / "r")
    with pytest.raises(BidexError, match="Expected a run on a suite with classes that are not trained on"):
        transfer(run, tmp_path / "t")
    assert not (tmp_path / "t").exists()


def test_a_signal_saves_and_raises(toy_worlds: None, tmp_path: Path) -> None:
    def interrupt(event: Event) -> None:
        if event.kind == "iteration":
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped) as stopped:
        train(CONFIG, run_dir=tmp_path / "r", on_event=interrupt)
    assert stopped.value.number == signal.SIGINT and stopped.value.step == 24
    assert stopped.value.folder.checkpoints.newest_step() == 24


def test_nothing_is_printed_and_everything_is_logged(
    toy_worlds: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "bidex_meta")
    run = train(CONFIG, run_dir=tmp_path / "r")
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "")
    assert f"Run folder: {run.path}" in caplog.messages
