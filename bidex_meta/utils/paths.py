"""The data folders `suites/` and `assets/`: they lie inside the package in a wheel, and next to it in a checkout."""

from pathlib import Path

from bidex_meta.errors import BidexError

_PACKAGE = Path(__file__).resolve().parents[1]


def suites_dir() -> Path:
    """Return the folder of the shipped suite files."""
    return _room("suites")


def assets_dir() -> Path:
    """Return the folder of the models (MJCF) of hands, objects and scene."""
    return _room("assets")


def shipped_policy() -> Path:
    """Return the folder of the run whose policy comes with bidex-meta: DAgger on MT20-v2."""
    return assets_dir() / "policies" / "MT20-v2"


def _room(name: str) -> Path:
    packed = _PACKAGE / name
    beside = _PACKAGE.parent / name
    for folder in (packed, beside):
        if folder.is_dir():
            return folder
    raise BidexError(f"Expected the folder {name}/ at {packed} or {beside}, found neither. Reinstall bidex-meta.")
