"""Optuna over a learner's settings: a run for each trial, success of its evaluation as the value.

pip install "bidex-meta[tune]", then: python examples/optuna_search.py --suite MT4 --steps 500000 --trials 20

Started again, it goes on; several started alike, each with its own `--seed`, share the trials.
"""

from pathlib import Path

import optuna
import tyro

from bidex_meta.cli import main as bidex_meta
from bidex_meta.runs import RunFolder


def main(
    suite: str = "MT4",
    algo: str = "mtppo",
    steps: int = 500_000,
    trials: int = 20,
    seed: int = 0,
    out: Path = Path("runs/optuna"),
) -> optuna.Study:
    """Searches and prints the best trial.

    Args:
        suite: A multi-task suite, e.g. MT4.
        algo: A learner (`bidex-meta list algos`).
        steps: Environment steps of each run.
        trials: Runs to make.
        seed: Of the search; runs have seed 0.
        out: Where the runs and the study go.
    """

    def success(trial: optuna.Trial) -> float:
        settings = {
            "learning-rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
            "gamma": 1 - trial.suggest_float("one_minus_gamma", 0.01, 0.2, log=True),
            "epochs": trial.suggest_int("epochs", 2, 8),
        }
        folder = out / str(trial.number)
        flags = [f"--learner.{name}={value}" for name, value in settings.items()]
        words = ["run", f"--suite={suite}", f"--algo={algo}", f"--steps={steps}", f"--run-dir={folder}", "--threads=1"]
        if bidex_meta([*words, "--logger=none", *flags]):
            raise optuna.TrialPruned  # what was wrong is printed
        return RunFolder(folder).evaluation()["policy"]["aggregate"]["success"]["mean"]

    out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        direction="maximize",
        study_name=f"{suite} {algo} {steps}",
        storage=f"sqlite:///{out / 'optuna.db'}",
        sampler=optuna.samplers.TPESampler(seed=seed),
        load_if_exists=True,
    )
    study.optimize(success, n_trials=trials)
    print(f"best: {study.best_value:.1%} by {study.best_params}, {out / str(study.best_trial.number)}")
    return study


if __name__ == "__main__":
    tyro.cli(main)
