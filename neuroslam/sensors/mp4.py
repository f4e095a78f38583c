"""What an MP4 or MOV file states about its video: number of frames, and what its edit list shows.

Boxes as in ISO/IEC 14496-12 (ISO base media file format): ``mvhd`` 8.2.2, ``mdhd`` 8.4.2, ``hdlr``
8.4.3, ``stts`` 8.6.1.2, ``elst`` 8.6.6, ``stsz`` 8.7.3.2.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_MAX_MOOV_BYTES = 64 * 2**20
_CONTAINERS = (b"trak", b"mdia", b"minf", b"stbl", b"edts")


class Edited(NamedTuple):
    """What an edit list shows of a video.

    Attributes:
        duration_s: Duration of the presentation in seconds.
        longest_frame_s: Duration of its longest frame in seconds.
    """

    duration_s: float
    longest_frame_s: float


class Mp4(NamedTuple):
    """What the container states about its first video track.

    Attributes:
        n_frames: Number of frames; ``None`` if it is not stated (fragments) or an edit list leaves
            some of them out.
        edited: The presentation that the edit list shows; ``None`` if it shows all frames.
    """

    n_frames: int | None
    edited: Edited | None


def read_mp4(path: Path) -> Mp4 | None:
    """Read what an MP4 or MOV file states about its video; ``None`` if it is no such file.

    Raises:
        OSError: If the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            moov = _moov(file, path.stat().st_size)
        return None if moov is None else _video(moov)
    except (struct.error, KeyError, IndexError, ZeroDivisionError):
        return None


def _moov(file, size: int) -> bytes | None:  # noqa: ANN001
    at, first = 0, True
    while at + 8 <= size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        header = 8
        if length == 1:
            length, header = struct.unpack(">Q", file.read(8))[0], 16
        length = length or size - at
        if first and kind not in (b"ftyp", b"moov", b"wide", b"mdat", b"free", b"skip"):
            return None
        if length < header:
            return None
        if kind == b"moov":
            return file.read(length - header) if length <= _MAX_MOOV_BYTES else None
        at, first = at + length, False
    return None


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        header = 8
        if length == 1:
            length, header = struct.unpack_from(">Q", data, at + 8)[0], 16
        length = length or len(data) - at
        if length < header:
            return
        yield kind, data[at + header : at + length]
        at += length


def _found(data: bytes) -> dict[bytes, bytes]:
    """Return the boxes of a track by kind, those in containers too."""
    found: dict[bytes, bytes] = {}
    for kind, content in _boxes(data):
        if kind in _CONTAINERS:
            found = _found(content) | found
        else:
            found.setdefault(kind, content)
    return found


def _video(moov: bytes) -> Mp4 | None:
    movie_scale = None
    fragmented = False
    tracks = []
    for kind, content in _boxes(moov):
        if kind == b"mvhd":
            movie_scale = _time_scale(content)
        fragmented |= kind == b"mvex"
        if kind == b"trak":
            tracks.append(_found(content))
    video = next((t for t in tracks if t.get(b"hdlr", b"")[8:12] == b"vide"), None)
    if video is None or not movie_scale or b"stsz" not in video:
        return None
    n_frames = struct.unpack_from(">I", video[b"stsz"], 8)[0]
    if fragmented or not n_frames:
        return Mp4(None, None)
    media_scale = _time_scale(video[b"mdhd"])
    durations = _runs(video.get(b"stts", b""))
    media_s = sum(count * delta for count, delta in durations) / media_scale
    longest_s = max((delta for _, delta in durations), default=0) / media_scale
    shown_s = sum(
        duration / movie_scale for duration, start in _edits(video.get(b"elst", b"")) if start >= 0
    )
    # One frame less is rounding: the movie counts in other ticks than the track.
    if not shown_s or shown_s >= media_s - 0.5 * longest_s:
        edits = [start for _, start in _edits(video.get(b"elst", b"")) if start >= 0]
        if len(edits) <= 1:
            return Mp4(n_frames, None)
    return Mp4(None, Edited(shown_s, longest_s))


def _time_scale(header: bytes) -> int:
    """Return the ticks per second of ``mvhd`` or ``mdhd``."""
    return struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)[0]


def _runs(stts: bytes) -> list[tuple[int, int]]:
    """Return the runs of ``stts``: number of frames, and their duration in ticks."""
    n = struct.unpack_from(">I", stts, 4)[0] if len(stts) >= 8 else 0
    return list(struct.iter_unpack(">II", stts[8 : 8 + 8 * min(n, (len(stts) - 8) // 8)]))


def _edits(elst: bytes) -> list[tuple[int, int]]:
    """Return the edits of ``elst``: duration in ticks of the movie; start in the media, or -1."""
    if len(elst) < 8:
        return []
    n, layout = struct.unpack_from(">I", elst, 4)[0], ">Qqi" if elst[0] == 1 else ">Iii"
    size = struct.calcsize(layout)
    n = min(n, (len(elst) - 8) // size)
    return [
        (duration, start)
        for duration, start, _ in struct.iter_unpack(layout, elst[8 : 8 + n * size])
    ]
