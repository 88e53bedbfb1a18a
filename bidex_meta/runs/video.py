"""Pictures and films from rendered frames. PNG and WebP need no extra package; MP4 needs the extra ``video``."""

import errno
import io
import math
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_atomic

FILMS = {".mp4": "video/mp4", ".webp": "image/webp"}  # Suffixes of films, and their media types on web pages.
SUFFIXES = (".png", *FILMS)
LABEL = 20  # Height of a name under a tile, pixels.
_BACK = (24, 26, 30)
_INK = (215, 218, 224)
_DONE = (110, 220, 130)


def check_suffix(path: Path) -> str:
    """Return the suffix of ``path`` in lower case; raises BidexError unless it is one of ``SUFFIXES``."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise BidexError(f"A picture ends in .png, a film in .mp4 or .webp, but {path.name!r} does not.")
    return suffix


def write_image(path: Path, frame: np.ndarray) -> None:
    """Write one frame ``(height, width, 3)``, uint8, as PNG; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = encoded([frame], "PNG")
    write_atomic(path, lambda file: file.write(picture))


def film_suffix() -> str:
    """Return the default suffix of a film: .mp4 if MP4 can be written, otherwise .webp."""
    if find_spec("imageio_ffmpeg"):
        return ".mp4"
    return ".webp"


def check_films() -> None:
    """Raise BidexError if MP4 cannot be written, because imageio-ffmpeg is missing."""
    if film_suffix() != ".mp4":
        raise BidexError("Films need imageio-ffmpeg: pip install 'bidex-meta[video]', or write .webp.")


def encoded(frames: Iterable[np.ndarray], kind: str, **options: int) -> bytes:
    """Encode frames ``(height, width, 3)``, uint8, in a Pillow format with its options.

    Except in PNG, several frames form an animation.
    """
    out = io.BytesIO()
    pictures = (Image.fromarray(frame) for frame in frames)
    if kind == "PNG":
        animation = {}
    else:
        animation = {"save_all": True, "append_images": pictures, "loop": 0}
    next(pictures).save(out, kind, **animation, **options)
    return out.getvalue()


def write_film(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames as a film in the format of the path's suffix, one of ``FILMS``."""
    if path.suffix.lower() == ".mp4":
        write = write_video
    else:
        write = write_animation
    write(path, frames, fps)


def write_animation(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write frames ``(height, width, 3)``, uint8, as a WebP that loops forever on web pages."""
    path.parent.mkdir(parents=True, exist_ok=True)
    film = encoded(frames, "WEBP", duration=round(1000 / fps), quality=60, method=6)
    write_atomic(path, lambda file: file.write(film))


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float) -> int:
    """Write frames as an MP4 (H.264), one at a time, so that a long film needs no memory; return the frame count.

    Frames are ``(height, width, 3)``, uint8, height and width even. Raises BidexError if imageio-ffmpeg is missing, and
    OSError if the file cannot be written; in both cases an earlier file is kept.
    """
    check_films()
    import imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.part.mp4")
    count = 0
    # macro_block_size is 2, because the default of 16 would silently resize 1000x750.
    try:
        with imageio.get_writer(partial, format="FFMPEG", fps=fps, codec="libx264", macro_block_size=2) as writer:  # type: ignore[arg-type]
            for frame in frames:
                writer.append_data(frame)  # type: ignore[attr-defined]
                count += 1
        if not _whole(partial):
            raise OSError(errno.EIO, "ffmpeg could not write all of the film; is the disk full?", str(path))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return count


def _whole(path: Path) -> bool:
    """Return whether an MP4 is complete, that is, ends in its frame table, which is written last.

    This check is needed because imageio does not report ffmpeg's exit status.
    """
    with path.open("rb") as file:
        end = file.seek(0, 2)
        offset = 0
        kind = b""
        while offset < end:
            file.seek(offset)
            size = int.from_bytes(file.read(4))
            kind = file.read(4)
            # A size of 1 means that a length of eight bytes follows.
            size = int.from_bytes(file.read(8)) if size == 1 else size
            if size < 8:
                return False
            offset += size
        return offset == end and kind == b"moov"


def grid(count: int) -> tuple[int, int]:
    """Return columns and rows for ``count`` tiles: as square as possible, wider than high."""
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)


def tiled(pictures: Sequence[np.ndarray], names: Sequence[str], done: Sequence[bool]) -> np.ndarray:
    """Tile pictures of one shape ``(height, width, 3)``, uint8, with their names, which are green if ``done``.

    Returns ``(rows * (height + 20), columns * width, 3)``, uint8.
    """
    height, width, _ = pictures[0].shape
    columns, rows = grid(len(pictures))
    whole = np.empty((rows * (height + LABEL), columns * width, 3), np.uint8)
    whole[:] = _BACK
    for number, picture in enumerate(pictures):
        top = number // columns * (height + LABEL)
        left = number % columns * width
        whole[top : top + height, left : left + width] = picture
        whole[top + height : top + height + LABEL, left : left + width] = _label(names[number], width, done[number])
    return whole


def _label(name: str, width: int, done: bool) -> np.ndarray:
    strip = Image.new("RGB", (width, LABEL), _BACK)
    pen = ImageDraw.Draw(strip)
    pen.text((width / 2, LABEL / 2), name, fill=_DONE if done else _INK, font=ImageFont.load_default(13), anchor="mm")
    return np.asarray(strip)
