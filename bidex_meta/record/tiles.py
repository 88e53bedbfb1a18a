"""Pictures beside each other, with a name under each."""

import math
from collections.abc import Sequence

import numpy as np

_STRIP = 20
"""Height of a name, pixels."""
_BACK, _INK, _DONE = (24, 26, 30), (215, 218, 224), (110, 220, 130)


def grid(count: int) -> tuple[int, int]:
    """Columns and rows for so many tiles: as square as it goes, wider than high."""
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)


def tiled(pictures: Sequence[np.ndarray], names: Sequence[str], done: Sequence[bool]) -> np.ndarray:
    """One picture of all.

    Args:
        pictures: Each ``(height, width, 3)`` uint8, of one size.
        names: Under each.
        done: Whose name is written in green.

    Returns:
        ``(rows * (height + 20), columns * width, 3)`` uint8.
    """
    height, width, _ = pictures[0].shape
    columns, rows = grid(len(pictures))
    whole = np.empty((rows * (height + _STRIP), columns * width, 3), np.uint8)
    whole[:] = _BACK
    for place, picture in enumerate(pictures):
        top, left = place // columns * (height + _STRIP), place % columns * width
        whole[top : top + height, left : left + width] = picture
        whole[top + height : top + height + _STRIP, left : left + width] = _label(names[place], width, done[place])
    return whole


def _label(name: str, width: int, done: bool) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont

    strip = Image.new("RGB", (width, _STRIP), _BACK)
    pen = ImageDraw.Draw(strip)
    pen.text((width / 2, _STRIP / 2), name, fill=_DONE if done else _INK, font=ImageFont.load_default(13), anchor="mm")
    return np.asarray(strip)
