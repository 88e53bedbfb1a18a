"""``bidex-meta push``: a policy or a data set with its card, to a hub or a folder."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from bidex_meta import __version__
from bidex_meta.cli.cards import data_card, run_card
from bidex_meta.cli.hub import CARD, DATASETS, FOLDER, OF_A_RUN, OF_DATA, called, copied, files_of, library
from bidex_meta.cli.parsing import RunPath, Switch, parse
from bidex_meta.errors import BidexError
from bidex_meta.runs import RunFolder
from bidex_meta.utils.files import absolute


@dataclass(frozen=True)
class PushFlags:
    """Publish a run's policy, or a data set, with a card that is made from its folder.

    Example: bidex-meta push runs/MT4/mtppo/2026-11-21_10-00-00_seed0 me/mt4-mtppo
    """

    run: RunPath  # Folder of a run, or of a data set.
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Repository of the Hugging Face Hub, of a data set datasets/OWNER/NAME; or folder:PATH."""
    private: Switch = False  # A repository that is made now is private.


def main(arguments: Sequence[str]) -> None:
    """Write the card, publish, print the command that pulls."""
    flags = parse(PushFlags, arguments, "push")
    files = files_of(flags.run, OF_DATA)
    if files:
        card = data_card(flags.run, flags.name)
    else:
        folder = RunFolder.open(flags.run)
        files = files_of(flags.run, OF_A_RUN)
        if not any(name.endswith(".pt") for name in files):
            raise BidexError(f"{flags.run} has no checkpoint, so that there is no policy to publish. Train it on.")
        card = run_card(folder, flags.name)
    if flags.name.startswith(FOLDER):
        target = absolute(flags.name.removeprefix(FOLDER))
        copied(files, target)
        (target / CARD).write_text(card, encoding="utf-8")
    else:
        if bool(files_of(flags.run, OF_DATA)) != flags.name.startswith(DATASETS):
            raise BidexError(f"Expected {DATASETS}OWNER/NAME for a data set alone, got {flags.name} for {flags.run}.")
        add = library().CommitOperationAdd
        content = [add(name, str(path)) for name, path in files.items()] + [add(CARD, card.encode())]
        called("create_repo", flags.name, private=flags.private, exist_ok=True)
        called("create_commit", flags.name, operations=content, commit_message=f"bidex-meta {__version__}")
    print(f"bidex-meta pull {flags.name}")
