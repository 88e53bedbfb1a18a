"""``bidex-meta pull``: fetch a policy or a data set from a hub or a folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import parse
from bidex_meta.errors import BidexError
from bidex_meta.experiments.hub import (
    CARD,
    FOLDER,
    OF_A_RUN,
    OF_DATA,
    SUITES,
    called,
    checked,
    copied,
    files_of,
    new_folder,
)
from bidex_meta.runs import RunFolder
from bidex_meta.utils.files import absolute


@dataclass(frozen=True)
class PullFlags:
    """Fetch a policy or a data set that `bidex-meta push` published.

    Example: bidex-meta pull me/mt4-mtppo

    `bidex-meta evaluate` then plays the policy, and `bidex-meta data info` describes the data set.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Repository on the Hugging Face Hub: OWNER/NAME for a policy, datasets/OWNER/NAME for a data set; or
    folder:PATH."""
    out: Path | None = None  # Folder to create; None: pulled/NAME.


def main(arguments: Sequence[str]) -> None:
    """Download a policy or a data set, and print the path of its folder."""
    flags = parse(PullFlags, arguments, "pull")
    wanted = (*OF_A_RUN, *OF_DATA, SUITES, CARD)
    if flags.name.startswith(FOLDER):
        source = root = absolute(flags.name.removeprefix(FOLDER))
    else:
        source = Path(called("snapshot_download", flags.name, allow_patterns=list(wanted)))
        root = source.parents[1]  # a snapshot in the cache links to files next to the snapshots' folder
    files = files_of(source, wanted, root)
    if not {"config.json", "data/metadata.json"} & files.keys():
        raise BidexError(
            f"{flags.name} holds neither a run's config.json nor a data set. Give the name that was pushed."
        )
    out = flags.out or Path("pulled") / Path(flags.name.removeprefix(FOLDER)).name
    with new_folder(absolute(out)) as folder:
        copied(files, folder)
        try:
            found = checked(folder)
        except BidexError as error:
            raise BidexError(f"{flags.name} is damaged and was deleted: {error}") from None
        if isinstance(found, RunFolder):
            _name_suite(found, absolute(out))
    print(out)


def _name_suite(run: RunFolder, out: Path) -> None:
    """Set the suite in a fetched run's config to the full path of the suite file, if one was published with the run."""
    config = run.config()
    if config.suite is not None and config.suite in [path.name for path in run.path.glob(SUITES)]:
        run.change_config(replace(config, suite=str(out / config.suite)))
