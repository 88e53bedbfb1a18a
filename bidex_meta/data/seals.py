"""Digests of a data set's files, so that a flipped bit is detected.

The user block of an HDF5 file holds the file's length and the CRC-32 of all bytes after the user block; the last entry
of ``metadata.json`` is the digest of all text before this entry. Digests do not protect against intentional changes.
"""

import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from bidex_meta.errors import BidexError
from bidex_meta.utils.files import open_regular

BLOCK = 512  # bytes of the user block; HDF5 accepts no smaller one
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PIECE = 1 << 20
_LAST = ',\n  "digest": '
_MARK = "sealed"  # second entry in the metadata: one flipped bit cannot remove both this entry and the digest


def block(file: IO[bytes]) -> bytes:
    """Return the user block (first 512 bytes) for an HDF5 file: the file's length and the digest of all other bytes."""
    length = file.seek(0, 2)
    digest = 0
    file.seek(BLOCK)
    while piece := file.read(_PIECE):
        digest = zlib.crc32(piece, digest)
    return _line(length, f"{digest:08x}\n").ljust(BLOCK, b"\n")


def _line(length: int, digest: str) -> bytes:
    return f"bidex-meta: {length} bytes, CRC-32 of those after the first {BLOCK}: {digest}".encode()


def check_file(path: Path) -> bool:
    """Read a file and compare it with its stored digest; return False if the file has no digest.

    Raises BidexError if the digest or the length is wrong.
    """
    with open_regular(path, "a file of a data set") as file:
        first = file.read(BLOCK)
        if first.startswith(_HDF5):
            return False
        # The length is checked first, so that a huge file is rejected without being read.
        if not first.startswith(_line(file.seek(0, 2), "")) or first != block(file):
            raise _changed(path, "Bring it back from a copy, or delete it and record it again")
    return True


def sealed_text(content: Mapping[str, object], ours: Mapping[str, object]) -> bytes:
    """Return a data set's metadata as JSON with one entry per line and a digest.

    The metadata are ``content``, and ``ours`` under the key ``bidex``.
    """
    whole = {**content, "bidex": {**ours, _MARK: True}}
    rows = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in whole.items() if name != "digest"]
    text = ("{\n" + ",\n".join(rows)).encode()
    return text + _ending(text)


def _ending(text: bytes) -> bytes:
    return f'{_LAST}"{zlib.crc32(text):08x}"\n}}\n'.encode()


def check_text(path: Path, data: bytes) -> bool:
    """Compare metadata with their stored digest; return False if the metadata have no digest.

    ``data`` is the content of the file ``path``. Raises BidexError if the metadata have changed.
    """
    text, found, _ = data.rpartition(_LAST.encode())
    if not found and not re.search(rb'"%s"\s*:\s*true' % _MARK.encode(), data):
        return False
    if data != text + _ending(text):
        mend = f"Bring it back from a copy; if you changed it on purpose, take out its entries digest and {_MARK}"
        raise _changed(path, mend)
    return True


def _changed(path: Path, mend: str) -> BidexError:
    return BidexError(f"{path} is damaged: expected the length and digest it was written with, found others. {mend}.")
