"""The subcommands of ``bidex-meta``, one module each with a function ``main(arguments)``.

This table is all that ``bidex-meta --help`` needs; the modules are imported when they are called.
"""

from typing import NamedTuple


class Command(NamedTuple):
    """Where a subcommand lives and what it does."""

    module: str
    summary: str


COMMANDS: dict[str, Command] = {
    "run": Command("bidex_meta.commands.run", "train a learner on a suite or a task, then evaluate it"),
    "sweep": Command("bidex_meta.commands.sweep", "many runs from one file, resumed where they were stopped"),
    "evaluate": Command("bidex_meta.commands.evaluate", "success and return of a trained run, per task class"),
    "verify": Command("bidex_meta.commands.verify", "evaluate a run again and compare with what it recorded"),
    "compare": Command("bidex_meta.commands.compare", "several runs beside each other, intervals over seeds"),
    "control": Command("bidex_meta.commands.control", "held-out tasks, adapted to their own data and to others'"),
    "record": Command("bidex_meta.commands.record", "record a data set: episodes of a policy, for offline learners"),
    "data": Command("bidex_meta.commands.data", "the data sets there are, one of them, or a check of it"),
    "list": Command("bidex_meta.commands.list", "the suites, tasks, algos or objects there are"),
    "render": Command("bidex_meta.commands.render", "a picture or a film of a task, or of all of a run"),
    "play": Command("bidex_meta.commands.play_live", "a policy at work, live: in a window or in the browser"),
    "witness": Command("bidex_meta.commands.witness", "replay actions that solve a task"),
    "baseline": Command("bidex_meta.commands.baseline", "measure the references of the normalised score"),
    "plot": Command("bidex_meta.commands.plot", "learning curves of runs, as a picture"),
    "report": Command("bidex_meta.commands.report", "runs as one HTML page: tables, curves, films"),
    "completion": Command("bidex_meta.commands.completion", "a script that completes commands and flags in a shell"),
    "bench": Command("bidex_meta.commands.bench", "measure the speed of a suite's world"),
}
