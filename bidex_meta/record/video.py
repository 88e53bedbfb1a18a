"""Pictures and films from rendered frames. PNG and WebP need nothing extra, MP4 the extra ``video``."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError

SUFFIXES = (".png", ".mp4", ".webp")


def check_suffix(path: Path) -> str:
    """The ending of ``path`` in lower case.

    Raises:
        BidexError: It is another than these three.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise BidexError(f"A picture ends in .png, a film in .mp4 or .webp, but {path.name!r} in none of them.")
    return suffix


def write_image(path: Path, frame: np.ndarray) -> None:
    """Write one frame as PNG.

    Args:
        path: The file; missing folders are made.
        frame: ``(height, width, 3)`` uint8.
    """
    import imageio.v3 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, frame, extension=".png")


def check_films() -> None:
    """Refuse MP4 where it cannot be written.

    Raises:
        BidexError: imageio-ffmpeg is missing.
    """
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise BidexError("Films need imageio-ffmpeg: pip install 'bidex-meta[video]', or write .webp.") from None


def write_animation(path: Path, frames: Iterable[np.ndarray], fps: float, quality: int = 60) -> None:
    """Write frames as an animated WebP that plays for ever, as web pages show it without a player.

    Args:
        path: The file; missing folders are made.
        frames: ``(height, width, 3)`` uint8 each.
        fps: Frames per second.
        quality: Of the pictures, 0 to 100; smaller makes smaller files.
    """
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = (Image.fromarray(frame) for frame in frames)
    options: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0, "quality": quality, "method": 6}
    next(pictures).save(path, save_all=True, append_images=pictures, **options)


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float) -> int:
    """Write frames as an MP4 (H.264), one at a time, so that a long film needs no memory.

    Args:
        path: The file; missing folders are made.
        frames: ``(height, width, 3)`` uint8 each; height and width even, as H.264 demands.
        fps: Frames per second.

    Returns:
        How many frames were written.

    Raises:
        BidexError: imageio-ffmpeg is missing.
    """
    check_films()
    import imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    # macro_block_size 2: the default of 16 would resize 1000x750 in silence.
    with imageio.get_writer(path, format="FFMPEG", fps=fps, codec="libx264", macro_block_size=2) as writer:  # type: ignore[arg-type]
        for frame in frames:
            writer.append_data(frame)  # type: ignore[attr-defined]
            count += 1
    return count
