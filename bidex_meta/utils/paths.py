"""Where the two rooms of data lie: `suites/` and `assets/`. Nothing else builds such a path.

In an installed wheel they are packed beside this file; in a checkout they stand one floor up, where people read them.
"""

from pathlib import Path

from bidex_meta.errors import BidexError

_PACKAGE = Path(__file__).resolve().parent


def suites_dir() -> Path:
    """The folder of the suite files that this installation ships.

    Raises:
        BidexError: The folder is missing, which only a damaged installation shows.
    """
    return _room("suites")


def assets_dir() -> Path:
    """The folder of the models (MJCF) of hands, objects and scene.

    Raises:
        BidexError: The folder is missing, which only a damaged installation shows.
    """
    return _room("assets")


def _room(name: str) -> Path:
    packed, beside = _PACKAGE / name, _PACKAGE.parent / name
    for folder in (packed, beside):
        if folder.is_dir():
            return folder
    raise BidexError(f"Expected the folder {name}/ at {packed} or {beside}, found neither. Install bidex-meta again.")
