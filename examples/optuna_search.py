"""Optuna over a learner's settings: a run for each trial, success of its evaluation as the value.

pip install "bidex-meta[tune]", then: python examples/optuna_search.py --suite MT4 --steps 500000 --trials 20

Started again, it goes on; several started alike, each with its own `--seed`, share the trials.
"""

from pathlib import Path

import optuna
import tyro

from bidex_meta import RunConfig, evaluate, train


def main(
    suite: str = "MT4",
    algo: str = "mtppo",
    steps: int = 500_000,
    trials: int = 20,
    seed: int = 0,
    out: Path = Path("runs/optuna"),
) -> optuna.Study:
    """Search, and print the best trial.

    Args:
        suite: A multi-task suite, e.g. MT4.
        algo: A learner (`bidex-meta list algos`).
        steps: Environment steps of each run.
        trials: Runs to make.
        seed: Of the search. Runs have the benchmark seed 1000; report results on other seeds.
        out: Where the runs and the study go.
    """

    def success(trial: optuna.Trial) -> float:
        settings = {
            "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
            "gamma": 1 - trial.suggest_float("one_minus_gamma", 0.01, 0.2, log=True),
            "epochs": trial.suggest_int("epochs", 2, 8),
        }
        config = RunConfig(suite=suite, algo=algo, steps=steps, seed=1000, learner=settings, threads=1, logger="none")
        try:
            run = train(config, run_dir=runs / str(trial.number))
        except FloatingPointError as error:  # training diverged
            raise optuna.TrialPruned(str(error)) from None
        return evaluate(run, save=True).success

    runs = out / f"{suite}-{algo}-{steps}"
    runs.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        direction="maximize",
        study_name=f"{suite} {algo} {steps}",
        storage=f"sqlite:///{out / 'optuna.db'}",
        load_if_exists=True,
    )
    # Another start needs another seed, or it would repeat the random trials of the first.
    study.sampler = optuna.samplers.TPESampler(seed=seed + 1000 * len(study.trials))
    study.optimize(success, n_trials=trials)
    print(f"best: {study.best_value:.1%} by {study.best_params}, {runs / str(study.best_trial.number)}")
    return study


if __name__ == "__main__":
    tyro.cli(main)
