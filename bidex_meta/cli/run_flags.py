"""Read the flags of ``bidex-meta run`` as a resolved config."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Generic, Literal

import tyro

from bidex_meta.cli.parsing import Switch, parse, peek, peek_all
from bidex_meta.config import LearnerSettings, RunConfig
from bidex_meta.experiments.run_config import check, check_resumed, resolve
from bidex_meta.runs.folder import AnyConfig, RunFolder
from bidex_meta.utils.validation import Count, Few, Shots

_EXAMPLE = "MT4"  # a suite whose defaults `run --help` shows


@dataclass(frozen=True)
class RunFlags(Generic[LearnerSettings]):
    """Train a learner on a suite or on a single task, then compare it with a random policy.

    Example: bidex-meta run --suite MT4 --algo mtppo --learner.gamma 0.99
    """

    config: Annotated[RunConfig[LearnerSettings], tyro.conf.arg(name="")]
    run_dir: Path | None = None  # Folder of this run; None: runs/SUITE/ALGO/DATE_seedSEED.
    resume: Path | None = None
    """Continue this run from its last checkpoint, with its own config; only --steps and --minutes may change, which
    count what it has done already, and --logger, --evaluate-every, --video-every and --stop-at-...."""
    evaluate: bool = True  # Evaluate at the end.
    episodes: Few | None = None
    """Episodes of each task in that evaluation; None: 4, or 1 where a task fixes its start (metaworld/...); for
    learners that adapt, as many as --rollouts."""
    other_tasks: Switch = False
    """Evaluate on as many tasks that the run was not trained on, too; learners that adapt have --split others."""
    split: Literal["auto", "train", "test", "others", "both"] = "auto"
    """Tasks of that evaluation where the learner adapts (maml, promp, rl2, ...). auto: train and test, on ML20
    fifteen classes beside the five unseen ones; others: tasks of the train classes that the run was not trained on."""
    shots: Shots | None = None  # There: adapt so often, one after the other. None: 1.
    rollouts: Few | None = None  # There: episodes of each task in a shot. None: as in training, but 40 at most.
    tasks: Count | None = None  # There: the first so many tasks of each class. None: 5.
    print_config: Switch = False  # Print the resolved config as JSON and stop.


def run_flags(arguments: Sequence[str]) -> RunFlags:
    """Return the flags with a resolved and checked config.

    The learner, its preset and the device decide the other flags and their defaults, so these three are read first.
    BidexError is raised for bad input.
    """
    resume = peek(arguments, "--resume")
    folder = RunFolder.open(Path(resume)) if resume else None
    default = _defaults(arguments, folder)
    # The learner's flags are among those of its config; lists begin empty, since flags add to them.
    options: type[RunFlags] = RunFlags[type(default.learner)]  # pyright: ignore
    flags = parse(options, arguments, "run", RunFlags(replace(default, dataset=(), demonstrations=(), teacher=())))
    is_named = folder is not None or any(peek(arguments, f"--{name}") for name in ("suite", "task", "dataset"))
    config = replace(
        flags.config,
        suite=flags.config.suite if is_named else None,  # a config without a named suite is refused
        dataset=default.dataset,
        demonstrations=flags.config.demonstrations or default.demonstrations,
        teacher=flags.config.teacher or default.teacher,
        algo=default.algo,
        preset=default.preset,
    )
    config = resolve(config)
    check(config, with_memory=not flags.print_config)
    if folder is not None:
        check_resumed(folder, config)
    return replace(flags, config=config)


def config_of_words(arguments: Sequence[str]) -> AnyConfig:
    """Return the resolved config of a run by the words that follow ``bidex-meta run``."""
    return run_flags(arguments).config


def _defaults(arguments: Sequence[str], folder: RunFolder | None) -> AnyConfig:
    """Return the config of a run of the given learner, suite and device, or of the run to be resumed."""
    names = ("suite", "task", "object", "algo", "preset", "device")
    given: dict[str, Any] = {name: value for name in names if (value := peek(arguments, f"--{name}"))}
    if dataset := peek_all(arguments, "--dataset"):
        given["dataset"] = tuple(dataset)
    if folder is not None:
        return resolve(replace(folder.config(), **given), str(folder.config_path))
    if not given.keys() & {"suite", "task", "dataset"}:
        given["suite"] = _EXAMPLE  # only --help uses this suite: a run without one is refused later
    return resolve(RunConfig(**given))
