"""``bidex-meta completion``: a script that completes commands, flags and names in a shell."""

import contextlib
import dataclasses
import importlib
import io
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field
from typing import Annotated, Any, Literal

import tyro

from bidex_meta.commands.parsing import flags_of, parse


@dataclass(frozen=True)
class CompletionFlags:
    """Print a script that completes commands, flags, suites, tasks, algos and objects of bidex-meta.

    Example: bidex-meta completion bash > ~/.local/share/bash-completion/completions/bidex-meta

    zsh: write it to a file _bidex-meta in a folder of $fpath; fish: to ~/.config/fish/completions/bidex-meta.fish.
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """The shell."""


def main(arguments: Sequence[str]) -> None:
    """Print the script. Flags of ``run`` that are the learner's are MT-PPO's."""
    shell = parse(CompletionFlags, arguments, "completion").shell
    from bidex_meta.commands import COMMANDS

    app = tyro.extras.SubcommandApp()
    names = _names()
    for name, command in COMMANDS.items():
        found = flags_of(importlib.import_module(command.module).main)
        app.command(name=name, help=command.summary)(_takes(_with_names(found.options, names)))
    script = io.StringIO()
    # tyro prints and exits.
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        app.cli(prog="bidex-meta", args=["--tyro-print-completion", shell])
    # tyro's script gives a line to each completion, but keeps the line breaks of help texts.
    lines = script.getvalue().splitlines()
    lines = [line.replace("\\n", " ") if line.startswith("COMPLETION_SPEC = ") else line for line in lines]
    print("\n".join(lines))


def _names() -> dict[str, list[str]]:
    """What the values of flags may be, by the flag's name."""
    from bidex_meta.commands.learners import ALGOS
    from bidex_meta.tasks import registry
    from bidex_meta.tasks.objects.held import EGG, shelf
    from bidex_meta.worlds import suites_to_run

    things = [EGG, *shelf()]
    return {"suite": suites_to_run(), "task": registry.names(), "algo": list(ALGOS), "object": things}


def _with_names(options: type, names: dict[str, list[str]]) -> type:
    """A dataclass of flags in which some are a choice of names."""
    fields = [entry for entry in dataclasses.fields(options) if entry.name in names]
    # Any of the names serves as a default, which a completion does not show.
    chosen = [
        (entry.name, Literal[tuple(known)], field() if entry.default is MISSING else field(default=known[0]))
        for entry in fields
        for known in [names[entry.name]]
    ]
    return dataclasses.make_dataclass(options.__name__, chosen, bases=(options,), frozen=True)


def _takes(options: type) -> Any:
    """A function of the flags, which is how tyro is told of a subcommand."""

    def command(flags: Any) -> None: ...

    # A name of its own would stand before every flag.
    command.__annotations__["flags"] = Annotated[options, tyro.conf.arg(name="")]
    return command
