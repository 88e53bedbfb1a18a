"""Read the flags of ``bidex-meta run`` as a resolved config."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Generic

import tyro

from bidex_meta.cli.parsing import Switch, parse, peek, peek_all
from bidex_meta.config import LearnerSettings, RunConfig
from bidex_meta.experiments.evaluating import USUAL_EVALUATION, FinalEvaluation
from bidex_meta.experiments.learners import USUAL_SETTINGS
from bidex_meta.experiments.run_config import resolve
from bidex_meta.runs.folder import AnyConfig, RunFolder

_USUAL: dict[str, tuple[str, ...]] = {
    "task": ("--suite", "--task", "--algo", "--preset", "--seed"),
    "budget": ("--steps", "--minutes", "--stop-at-success", "--num-envs", "--device"),
    "data": ("--start-from", "--dataset", "--teacher"),
    "output": ("--run-dir", "--resume", "--logger", "--evaluate-every", "--no-evaluate", "--print-config"),
}  # fmt: skip
"""Flags that ``run --help`` shows, by heading; ``USUAL_SETTINGS`` has those of the learners."""


@dataclass(frozen=True)
class RunFlags(Generic[LearnerSettings]):
    """Train a learner on a suite or on a single task, then compare it with a random policy.

    Example: bidex-meta run --suite MT4 --algo mtppo --learner.gamma 0.99
    """

    config: Annotated[RunConfig[LearnerSettings], tyro.conf.arg(name="")]
    run_dir: Path | None = None  # Folder of this run; None: runs/SUITE/ALGO/DATE_seedSEED.
    resume: Path | None = None
    """Continue the run in this folder from its last checkpoint, with its stored config. Only --steps and --minutes
    (totals, including what is already done), --logger, --evaluate-every, --video-every and --stop-at-... may change."""
    evaluate: bool = True  # Evaluate the policy when training ends.
    print_config: Switch = False  # Print the resolved config as JSON and exit.
    final: Annotated[FinalEvaluation, tyro.conf.arg(name="")] = USUAL_EVALUATION


def run_flags(arguments: Sequence[str]) -> RunFlags:
    """Return the flags with a resolved config; raise BidexError for bad input.

    The learner, its preset and the device decide the other flags and their defaults, so these three are read first.
    """
    folder = None
    if resume := peek(arguments, "--resume"):
        folder = RunFolder.open(Path(resume))
    default = _defaults(arguments, folder)
    # The learner's flags belong to its config. Lists begin empty, because flags append to them.
    options: type[RunFlags] = RunFlags[type(default.learner)]  # pyright: ignore
    start = RunFlags(replace(default, dataset=(), demonstrations=(), teacher=()))
    settings = [f"--learner.{name.replace('_', '-')}" for name in USUAL_SETTINGS]
    flags = parse(options, arguments, "run", start, _USUAL | {f"learner ({default.algo})": settings})
    is_named = folder is not None or any(peek(arguments, f"--{name}") for name in ("suite", "task", "dataset"))
    config = flags.config
    if not is_named:
        config = replace(config, suite=None)  # a config without a named suite is refused
    demonstrations = config.demonstrations or default.demonstrations
    config = replace(config, demonstrations=demonstrations, teacher=config.teacher or default.teacher)
    config = resolve(replace(config, dataset=default.dataset, algo=default.algo, preset=default.preset))
    flags.final.check(config)
    return replace(flags, config=config)


def _defaults(arguments: Sequence[str], folder: RunFolder | None) -> AnyConfig:
    """Return the config that has the default values of the flags.

    With ``folder``, this is the config of the run to be resumed. Otherwise it is the default config for the learner,
    preset, suite and device that ``arguments`` name.
    """
    names = ("suite", "task", "object", "algo", "preset", "device")
    given: dict[str, Any] = {name: value for name in names if (value := peek(arguments, f"--{name}"))}
    if dataset := peek_all(arguments, "--dataset"):
        given["dataset"] = tuple(dataset)
    if folder is not None:
        return resolve(replace(folder.config(), **given), str(folder.config_path))
    if not given.keys() & {"suite", "task", "dataset"}:
        given["suite"] = "MT4"  # `run --help` shows its defaults; a run without a suite is refused later
    return resolve(RunConfig(**given))
