"""``bidex-meta completion``: a script that completes commands, flags and names in a shell."""

import contextlib
import importlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from bidex_meta.cli.parsing import flags_of, parse
from bidex_meta.experiments.learners import ALGOS
from bidex_meta.tasks import registry
from bidex_meta.worlds import suites_to_run


@dataclass(frozen=True)
class CompletionFlags:
    """Print a script that completes commands, flags, suites, tasks, algos and objects of bidex-meta.

    Example: bidex-meta completion bash > ~/.local/share/bash-completion/completions/bidex-meta

    zsh: write it to a file _bidex-meta in a folder of $fpath; fish: to ~/.config/fish/completions/bidex-meta.fish.
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]  # Shell to complete in: bash, zsh or fish.


def main(arguments: Sequence[str]) -> None:
    """Print the completion script for a shell.

    After ``run`` the script completes the learner flags of MT-PPO, the default learner.
    """
    shell = parse(CompletionFlags, arguments, "completion").shell
    from bidex_meta.cli import COMMANDS
    from bidex_meta.tasks.objects.held import EGG, shelf

    choices = {"--suite": suites_to_run(), "--task": registry.names(), "--algo": list(ALGOS)}
    choices["--object"] = [EGG, *shelf()]
    app = tyro.extras.SubcommandApp()
    for name, command in COMMANDS.items():
        found = flags_of(importlib.import_module(command.module).main)

        def takes(flags: object) -> None: ...

        # tyro reads flags from a function's annotations; a non-empty name would become a prefix of every flag.
        takes.__annotations__["flags"] = Annotated[found.options, tyro.conf.arg(name="")]
        if found.default is None:
            takes.__defaults__ = None
        else:
            takes.__defaults__ = (found.default,)
        app.command(name=name, help=command.summary)(takes)
    script = io.StringIO()
    # tyro prints and exits.
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        app.cli(prog="bidex-meta", args=["--tyro-print-completion", shell])
    for line in script.getvalue().splitlines():
        if line.startswith("COMPLETION_SPEC = "):
            # tyro's script has one line per completion, but keeps the line breaks of help texts.
            line = re.sub(r"\\+n", " ", line)
            for flag, names in choices.items():
                line = re.sub(
                    rf"({{'flags': \['{flag}'\].*?)'type': '\w+'", rf"\1'type': 'choice', 'choices': {names}", line
                )
        print(line)
