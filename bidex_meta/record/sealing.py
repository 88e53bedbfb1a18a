"""A checkpoint's content under a seal: a format number, and a digest over every number and tensor in it.

``torch.load`` looks at no checksum: a flipped bit would be loaded as another weight. Files without a seal, written
before there was one, are still held to the checksums that every zip archive carries.
"""

import hashlib
import zipfile
from pathlib import Path
from typing import IO, Any

from bidex_meta.errors import BidexError, shortened
from bidex_meta.reading import open_regular, whole

FORMAT = 2
"""Goes up when older code could not read a checkpoint; 1 had no seal."""
_DEEPEST = 100


def sealed(content: dict[str, Any]) -> dict[str, Any]:
    """Content to be saved, with its format and digest."""
    return {**content, "format": FORMAT, "digest": _digest(content)}


def opened(path: Path) -> dict[str, Any]:
    """What :func:`sealed` gave, read from a file without running any code of it; at least ``step`` and ``state``.

    Raises:
        BidexError: It is no regular file, or of a newer format.
        Exception: torch's own, of a dozen kinds, where the file is damaged or something else.
    """
    import torch

    with open_regular(path, "a checkpoint") as file:
        _check_archive(file)
        # weights_only: a checkpoint from somebody else must not be able to run code.
        content = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(content, dict) or not isinstance(content.get("state"), dict):
        raise ValueError("it holds no training's state")
    if not whole(0).fits(content.get("step")):
        raise ValueError(f"its step is {shortened(content.get('step'))}, no whole number")
    version, digest = content.pop("format", 1), content.pop("digest", None)
    if not whole(1, FORMAT).fits(version):
        raise BidexError(f"format {shortened(version)} is none this version knows (1 to {FORMAT})")
    if version > 1 and digest != _digest(content):
        raise ValueError("its content does not have the digest it was saved with")
    return content


def _check_archive(file: IO[bytes]) -> None:
    """Refuses an archive that is damaged, or whose parts are larger than the file: torch stores them as they are."""
    with zipfile.ZipFile(file) as archive:
        for part in archive.infolist():
            if part.compress_type != zipfile.ZIP_STORED or part.file_size != part.compress_size:
                raise ValueError(f"its part {shortened(part.filename)} is compressed")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"its part {shortened(damaged)} does not have its checksum")
    file.seek(0)


def _digest(content: dict[str, Any]) -> str:
    found = hashlib.blake2b(digest_size=32)
    _feed(content, found, 0)
    return found.hexdigest()


def _feed(value: Any, found: Any, depth: int) -> None:
    """Feeds a hash with a value, its type and its shape, so that no two contents look alike."""
    import torch

    if depth > _DEEPEST:
        raise ValueError(f"it is nested more than {_DEEPEST} deep")
    if isinstance(value, torch.Tensor):
        found.update(f"tensor {value.dtype} {tuple(value.shape)}:".encode())
        flat = value.detach().cpu().contiguous()
        # Of a single number the stride can be any, and a view of bytes asks for 1.
        flat = flat.as_strided((flat.numel(),), (1,))
        found.update(flat.view(torch.uint8).numpy().data)
    elif isinstance(value, dict):
        found.update(f"dict {len(value)}:".encode())
        for name, each in value.items():
            _feed(name, found, depth + 1)
            _feed(each, found, depth + 1)
    elif isinstance(value, list | tuple):
        found.update(f"{'list' if isinstance(value, list) else 'tuple'} {len(value)}:".encode())
        for each in value:
            _feed(each, found, depth + 1)
    else:
        # Of floats repr gives every bit but NaN's.
        told = value if isinstance(value, bytes) else repr(value).encode()
        found.update(f"{type(value).__name__} {len(told)}:".encode())
        found.update(told)
