"""Checks of a config's fields, each with one line that names the field; imports no torch."""

from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.fields import check_fields


def types(config: Any) -> None:
    """Refuses fields that are not of their type, and numbers that no field can mean: before all other checks."""
    check_fields(config, config.algo)


def network_bytes(hidden: tuple[int, ...], width: int, copies: int) -> int:
    """Bytes of a network's layers on observations of a width, with gradient and Adam's two moments, so many times."""
    widths = (width, *hidden)
    return 4 * 4 * copies * sum(a * b for a, b in zip(widths, hidden, strict=False))


def at_least(config: Any, least: float, *names: str) -> None:
    """Refuses fields below ``least``."""
    for name in names:
        if not getattr(config, name) >= least:
            raise BidexError(f"{config.algo}: {name} must be at least {least:g}, got {getattr(config, name)}.")


def positive(config: Any, *names: str) -> None:
    """Refuses fields that are not above zero."""
    for name in names:
        if not getattr(config, name) > 0.0:
            raise BidexError(f"{config.algo}: {name} must be positive, got {getattr(config, name)}.")


def between(config: Any, low: float, high: float, *names: str) -> None:
    """Refuses fields outside [low, high]."""
    for name in names:
        if not low <= getattr(config, name) <= high:
            raise BidexError(f"{config.algo}: {name} must lie in [{low:g}, {high:g}], got {getattr(config, name)}.")


def rising(config: Any, *names: str) -> None:
    """Refuses pairs that are not two rising positive numbers."""
    for name in names:
        low, high = getattr(config, name)
        if not 0.0 < low <= high:
            raise BidexError(f"{config.algo}: {name} must be two rising positive numbers, got {low} {high}.")


def widths(config: Any, *names: str) -> None:
    """Refuses layers that are none, or of no width."""
    for name in names:
        if not getattr(config, name) or min(getattr(config, name)) < 1:
            raise BidexError(
                f"{config.algo}: {name} must be one or more widths of at least 1, got {getattr(config, name)}."
            )
