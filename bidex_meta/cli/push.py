"""``bidex-meta push``: publish a policy or a data set with its card, on a hub or in a folder."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from bidex_meta import __version__
from bidex_meta.cli.parsing import RunPath, Switch, parse
from bidex_meta.errors import BidexError
from bidex_meta.experiments.cards import data_card, run_card
from bidex_meta.experiments.hub import (
    CARD,
    DATASETS,
    FOLDER,
    OF_A_RUN,
    OF_DATA,
    ONNX,
    called,
    checked,
    copied,
    files_of,
    library,
    new_folder,
    published,
)
from bidex_meta.runs import RunFolder
from bidex_meta.utils.files import absolute


@dataclass(frozen=True)
class PushFlags:
    """Publish a run's policy, or a data set, with a card that is made from its folder.

    Example: bidex-meta push runs/MT4/mtppo/2026-11-21_10-00-00_seed0 me/mt4-mtppo
    """

    run: RunPath  # Folder of a run or of a data set.
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Repository on the Hugging Face Hub: OWNER/NAME for a policy, datasets/OWNER/NAME for a data set; or
    folder:PATH."""
    private: Switch = False  # Make the repository private if this command creates it.


def main(arguments: Sequence[str]) -> None:
    """Write the card, publish, and print the command that pulls the publication."""
    flags = parse(PushFlags, arguments, "push")
    of_data = bool(files_of(flags.run, OF_DATA))
    if not flags.name.startswith(FOLDER) and of_data != flags.name.startswith(DATASETS):
        raise BidexError(f"Expected {DATASETS}OWNER/NAME only for a data set, got {flags.name} for {flags.run}.")
    files = files_of(flags.run, OF_DATA if of_data else OF_A_RUN)
    found = checked(flags.run)
    if not of_data and not any(name.endswith(".pt") for name in files):
        raise BidexError(f"{flags.run} has no checkpoint, so there is no policy to publish. Continue its training.")
    name = flags.name
    if name.startswith(FOLDER):
        name = FOLDER + absolute(name.removeprefix(FOLDER)).name  # cards hold no path of this machine
    if isinstance(found, RunFolder):
        if ONNX in files:
            from bidex_meta.experiments.exporting import check_export

            check_export(found, files[ONNX])
        card = run_card(found, name)
    else:
        card = data_card(found, name)
    content = published(flags.run, files) | {CARD: card.encode()}
    if flags.name.startswith(FOLDER):
        with new_folder(absolute(flags.name.removeprefix(FOLDER))) as target:
            copied(content, target)
    else:
        add = library().CommitOperationAdd
        operations = [add(name, each if isinstance(each, bytes) else str(each)) for name, each in content.items()]
        called("create_repo", flags.name, private=flags.private, exist_ok=True)
        called("create_commit", flags.name, operations=operations, commit_message=f"bidex-meta {__version__}")
    print(f"bidex-meta pull {flags.name}")
