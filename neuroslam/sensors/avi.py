"""Pictures of a Motion-JPEG AVI file that are cut short, which decoders show half grey.

Chunks as in the RIFF and OpenDML AVI specifications: pictures are ``NNdb`` and ``NNdc`` in lists
``movi``.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from neuroslam.sensors.images import is_complete

_MOST_CHUNK_BYTES = 64 * 2**20
_LISTS = (b"RIFF", b"LIST")


def half_pictures(path: Path) -> Iterator[bool]:
    """Yield for each picture of a Motion-JPEG AVI whether it is cut short; nothing for others.

    Raises:
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        if file.read(4) == b"RIFF":
            yield from _cut(file, 0, path.stat().st_size)


def _cut(file: BinaryIO, at: int, end: int) -> Iterator[bool]:
    pending = [(at, end)]
    while pending:
        at, end = pending.pop()
        while at + 8 <= end:
            file.seek(at)
            head = file.read(12)
            if len(head) < 12:
                return
            kind, size = struct.unpack_from("<4sI", head)
            after = at + 8 + size + size % 2
            if kind in _LISTS:
                pending.append((after, end))
                at, end = at + 12, min(after, end)
                continue
            if kind[:2].isdigit() and kind[2:] in (b"dc", b"db") and size:
                if not head[8:].startswith(b"\xff\xd8") and size > 4:
                    if any(head[8:]):
                        return  # not Motion-JPEG
                    yield False  # zeros: the decoder says so
                else:
                    file.seek(at + 8)
                    yield not is_complete(file.read(min(size, _MOST_CHUNK_BYTES)))
            at = after
