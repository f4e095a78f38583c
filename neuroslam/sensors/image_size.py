"""Size of an encoded image by its header, before the pixels take memory.

PNG (RFC 2083, 4.1.1), JPEG (ITU-T T.81, B.2.2), BMP, TIFF 6.0, WebP (RFC 9649) and PNM.
"""

import re
import struct

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_BIG_TIFF = {b"II+\0": "<", b"MM\0+": ">"}
_NO_SOF = (0xC4, 0xC8, 0xCC)  # of 0xC0 to 0xCF: tables of codes, reserved, conditioning
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+?(\d{1,9})(?:\s+|#[^\n]*\n)+?(\d{1,9})\s")
_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 322, 323
_MOST_TAGS = 1000


def image_size(data: bytes) -> tuple[int, int] | None:
    r"""Return the height and the width that an encoded image states.

    Args:
        data: The image; of a TIFF in tiles, the larger of image and tile counts.

    Returns:
        ``None`` if it is of none of these formats, or its header is damaged.

    Example:
        >>> image_size(b"P5 640 480 255\n")
        (480, 640)
    """
    try:
        size = _stated(data)
    except (struct.error, IndexError):
        return None
    return size if size is not None and min(size) > 0 else None


def _stated(data: bytes) -> tuple[int, int] | None:
    if data.startswith(_PNG):
        width, height = struct.unpack_from(">II", data, 16)
        return height, width
    if data.startswith(b"\xff\xd8"):
        return _jpeg(data)
    if data.startswith(b"BM"):
        core = struct.unpack_from("<I", data, 14)[0] == 12
        width, height = struct.unpack_from("<HH" if core else "<ii", data, 18)
        return abs(height), abs(width)
    if data[:4] in _TIFF:
        return _tiff(data, _TIFF[data[:4]], "I", "H", 4)
    if data[:4] in _BIG_TIFF:
        return _tiff(data, _BIG_TIFF[data[:4]], "Q", "Q", 8)
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return _webp(data)
    match = _PNM.match(data[:4096])
    return (int(match[2]), int(match[1])) if match else None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    at = 2
    while True:
        at = data.find(b"\xff", at)
        if at < 0:
            return None
        kind = data[at + 1]
        if kind == 0xFF:  # fill
            at += 1
        elif kind in (0x00, 0x01) or 0xD0 <= kind <= 0xD8:  # without content
            at += 2
        elif 0xC0 <= kind <= 0xCF and kind not in _NO_SOF:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return height, width
        elif kind in (0xD9, 0xDA):  # the end, or pixels before the size
            return None
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]


def _tiff(data: bytes, order: str, offset: str, count: str, at: int) -> tuple[int, int] | None:
    first = struct.unpack_from(order + offset, data, at)[0]
    n = struct.unpack_from(order + count, data, first)[0]
    entry, value = (20, 12) if offset == "Q" else (12, 8)
    tags: dict[int, int] = {}
    start = first + struct.calcsize(order + count)
    for k in range(min(n, _MOST_TAGS)):
        here = start + k * entry
        tag, kind = struct.unpack_from(order + "HH", data, here)
        if tag in (_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT):
            layout = {3: "H", 4: "I", 16: "Q"}.get(kind, "I")
            tags[tag] = struct.unpack_from(order + layout, data, here + value)[0]
    if _WIDTH not in tags or _HEIGHT not in tags:
        return None
    height, width = tags[_HEIGHT], tags[_WIDTH]
    tile = tags.get(_TILE_HEIGHT, 0), tags.get(_TILE_WIDTH, 0)
    return tile if tile[0] * tile[1] > height * width else (height, width)


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return height, width
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return height & 0x3FFF, width & 0x3FFF
    return None
