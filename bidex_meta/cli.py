"""The command ``bidex-meta``: finds the subcommand, calls it, and turns errors into one line.

Nothing heavy is imported here: each subcommand is a module of ``bidex_meta.commands``, loaded when it is called.
"""

import importlib
import os
import sys
from collections.abc import Sequence

from bidex_meta.commands import COMMANDS
from bidex_meta.errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, BidexError, known_name

_EXAMPLE = "bidex-meta run --suite MT4 --algo mtppo"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: What follows ``bidex-meta``; the process's own by default.

    Returns:
        The exit code: 0, 2 for bad input, 130 after Ctrl-C.

    Raises:
        SystemExit: With another exit code, from a subcommand.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    try:
        return _dispatch(given)
    except BidexError as error:
        if debug:
            raise
        print(f"bidex-meta: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("bidex-meta: interrupted.", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader has seen enough (`| head`); without this Python complains again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help())
        return 0
    name, *rest = arguments
    if name == "--version":
        from bidex_meta import __version__

        print(__version__)
        return 0
    name = known_name("command", name, COMMANDS)
    importlib.import_module(COMMANDS[name].module).main(rest)
    return 0


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "Multi-task and meta reinforcement learning for two dexterous hands: train, judge and look at policies.",
            f"Example: {_EXAMPLE}",
            "",
            "usage: bidex-meta COMMAND [OPTIONS]",
            "",
            *commands,
            "",
            "bidex-meta COMMAND --help shows the options of a command; --debug shows the traceback of an error;",
            "--version the version.",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
