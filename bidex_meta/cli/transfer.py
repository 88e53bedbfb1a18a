"""``bidex-meta transfer``: measure how much a run's policy helps on unseen classes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import RunPath, parse
from bidex_meta.cli.run_flags import run_flags
from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.config import Several, Steps
from bidex_meta.errors import EXIT_FAILED
from bidex_meta.experiments.transfer_tables import demonstrations_table, reinforcement_table
from bidex_meta.experiments.transferring import transfer
from bidex_meta.runs import RunFolder
from bidex_meta.training.launch import say
from bidex_meta.utils.validation import Environments, Few, Whole

_SPARE = ("seeds", "return")  # columns that a narrow terminal leaves out first


@dataclass(frozen=True)
class TransferFlags:
    """Measure how much a run's policy helps to learn held-out classes.

    Example: bidex-meta transfer results/ML20-mtppo-seed0 --classes LiftUnderarm --out runs/transfer

    The command trains on each class from the run's policy and from scratch, by reinforcement learning and by imitation
    of demonstrations. If the command is interrupted, run it again to continue. Flags after -- are passed to `bidex-meta
    run` for every run, such as `-- --learner.critic-first 20000` (docs/transfer.md).
    """

    run: RunPath  # Folder of the run whose policy is measured; its suite must have held-out classes.
    out: Path  # Folder that receives the runs, transfer.json and figures.
    start_from: tuple[Path, ...] = ()  # Further runs to start from; their observations must have the same form.
    classes: tuple[str, ...] = ()  # Held-out classes to learn; none: all held-out classes of the run's suite.
    steps: Steps = 1_000_000  # Environment steps of each reinforcement-learning run; 0: no such runs.
    demonstrations: tuple[Whole, ...] = (0, 1, 5, 25)
    """Numbers of demonstrations to learn from, one run per number; --demonstrations without a number: no such runs."""
    data: Several = ()
    """Data set of demonstrations of one class (a name from `bidex-meta data list`, or a folder), instead of its
    script's demonstrations. Repeat the flag for several classes."""
    seeds: Few = 3  # Number of runs of each kind, with seeds 0, 1, ...
    num_envs: Environments = 256  # Environments stepped together in each run.
    workers: Few | None = None
    """Number of runs at a time, each on its own core. None: one run, or one run per core in --cores."""
    cores: str | None = None
    """Cores that the runs are bound to (Linux only), such as 1 or 0,2-3. None: the first available cores."""


def main(arguments: Sequence[str]) -> None:
    """Train the runs that are not finished and print the tables; exit with code 1 if a run has failed."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    flags = parse(TransferFlags, arguments[:at], "transfer")
    suite = RunFolder.open(flags.run).config().suite or "MT4"  # a run without a suite is refused by ``transfer``
    words = [f"--suite={suite}", "--preset=laptop", "--logger=none", "--learner.demonstration-cloning=5000"]
    words += [*arguments[at + 1 :], "--algo=ppo", f"--num-envs={flags.num_envs}"]
    run = run_flags(words)
    result = transfer(
        flags.run, flags.out, start_from=flags.start_from, classes=flags.classes, steps=flags.steps,
        demonstrations=flags.demonstrations, data=flags.data, seeds=flags.seeds, config=run.config, final=run.final,
        workers=flags.workers, cores=flags.cores,
    )  # fmt: skip
    if result.reinforcement:
        print_table(plain_table(*reinforcement_table(result.reinforcement, flags.steps), spare=_SPARE))
    if result.demonstrations:
        print_table(plain_table(*demonstrations_table(result.demonstrations), spare=_SPARE))
    say(f"Tables and figures: {result.folder}")
    if result.failures:
        say(f"{result.failures} failed or were stopped. Start it again to go on with them.")
        raise SystemExit(EXIT_FAILED)
