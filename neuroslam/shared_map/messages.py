"""Messages of a shared map: what a robot offers, as bounded and checked bytes.

A message is a fixed header, then the body, compressed with zlib: sessions, templates, places and
links as packed little-endian records. Nothing in it is code, and nothing is believed before it is
checked: sizes before they are allocated, the SHA-256 of the body, every index, and that every
number is finite and within bounds.

====== ============ ===========================================================================
bytes  field        meaning
====== ============ ===========================================================================
4      magic        ``NSLM``
2      version      1
2      n_sessions   of the robot, and of others that links lead to
4      n_templates  new views
4      n_places     new experiences
4      n_links      new links
4      n_pixels     of a template
4      n_body       bytes of the body before compression
32     digest       SHA-256 of the body before compression: the id of the content
====== ============ ===========================================================================
"""

import hashlib
import math
import struct
import zlib
from typing import NamedTuple

import numpy as np

from neuroslam.errors import SharedMapError, counted
from neuroslam.mapping.tables import NUMBER_BITS
from neuroslam.state.sessions import ID_BITS

MAGIC, VERSION = b"NSLM", 1
_HEADER = struct.Struct("<4sHHIIIII32s")

MOST_SESSIONS = 256
"""Sessions that one message may name."""

MOST_ROWS = 20_000
"""Templates, places or links of one message: a robot that was away for hours sends several."""

MOST_PIXELS = 65_536
"""Pixels of a template."""

MOST_BODY_BYTES = 32 * 2**20
"""Bytes of a message before compression."""

MOST_TEXT_BYTES = 512
"""Bytes of the name of a source."""

MOST_METRES = 1e6
MOST_SECONDS = 1e7

PLACE = np.dtype(
    [
        ("session", "<u2"),  # row in the sessions of the message
        ("number", "<u4"),
        ("first_frame", "<u4"),
        ("template", "<u8"),  # first bytes of the digest of its pixels
        ("pose", "<f4", 3),
        ("cell", "<f4", 3),
    ]
)
"""Record of a new experience in an offer."""
LINK = np.dtype(
    [
        ("source_session", "<u2"),
        ("target_session", "<u2"),
        ("source", "<u4"),
        ("target", "<u4"),
        ("distance_m", "<f4"),
        ("heading_rad", "<f4"),
        ("facing_rad", "<f4"),
        ("duration_s", "<f4"),
    ]
)
"""Record of a link in an offer."""


class Offer(NamedTuple):
    """What a robot offers: new places with their views, and the links between places.

    Attributes:
        sessions: Ids of the sessions that places and links refer to.
        sources: Name of the source of each.
        pixels: New templates, ``uint8``, ``(templates, n_pixels)``, column after column.
        places: New experiences, records of :data:`PLACE`; a template is named by
            :func:`template_ids`, as it may have been sent before.
        links: Measured displacements, records of :data:`LINK`. A link of length 0 within the size
            of an experience says that two experiences are one.
    """

    sessions: tuple[int, ...]
    sources: tuple[str, ...]
    pixels: np.ndarray
    places: np.ndarray
    links: np.ndarray

    @property
    def empty(self) -> bool:
        """Whether there is nothing new."""
        return not (len(self.places) or len(self.links))


def template_ids(pixels: np.ndarray) -> np.ndarray:
    """Return the content ids of templates: the first 8 bytes of the SHA-256 of their pixels.

    Args:
        pixels: ``uint8``, ``(n, n_pixels)``.

    Returns:
        ``uint64``, ``(n,)``.

    Example:
        >>> [hex(int(t)) for t in template_ids(np.zeros((1, 4), np.uint8))]
        ['0xdb2fa90498613fdf']
    """
    digests = [hashlib.sha256(np.ascontiguousarray(row).data).digest()[:8] for row in pixels]
    return np.array([int.from_bytes(digest, "little") for digest in digests], dtype=np.uint64)


def encode(offer: Offer) -> bytes:
    """Write an offer as one message; equal offers have equal digests.

    Raises:
        SharedMapError: If the offer is beyond the bounds of a message.

    Example:
        >>> from neuroslam.shared_map.messages import LINK, PLACE
        >>> nothing = np.zeros((0, 4), np.uint8), np.zeros(0, PLACE), np.zeros(0, LINK)
        >>> decode(encode(Offer((5,), ("a.mp4",), *nothing))).sources
        ('a.mp4',)
    """
    check(offer)
    texts = [source.encode()[:MOST_TEXT_BYTES] for source in offer.sources]
    texts = [text.decode(errors="ignore").encode() for text in texts]  # no half character
    table = b"".join(
        struct.pack("<QH", session, len(text)) + text
        for session, text in zip(offer.sessions, texts, strict=True)
    )
    body = b"".join(
        [
            table,
            np.ascontiguousarray(offer.pixels, np.uint8).tobytes(),
            np.ascontiguousarray(offer.places, PLACE).tobytes(),
            np.ascontiguousarray(offer.links, LINK).tobytes(),
        ]
    )
    if len(body) > MOST_BODY_BYTES:
        raise SharedMapError(
            f"offer: has {len(body)} bytes; expected at most {MOST_BODY_BYTES}; offer more often"
        )
    header = _HEADER.pack(
        MAGIC,
        VERSION,
        len(offer.sessions),
        len(offer.pixels),
        len(offer.places),
        len(offer.links),
        offer.pixels.shape[1],
        len(body),
        hashlib.sha256(body).digest(),
    )
    return header + zlib.compress(body, 6)


def digest_of(message: bytes) -> bytes:
    """Return the digest in the header of a message: the id of its content.

    Raises:
        SharedMapError: If it is too short to have one.
    """
    if len(message) < _HEADER.size:
        raise SharedMapError(
            f"message: has {counted(len(message), 'byte')}; expected at least {_HEADER.size}"
        )
    return message[_HEADER.size - 32 : _HEADER.size]


def decode(message: bytes) -> Offer:
    """Read a message and check everything in it.

    Args:
        message: Bytes as :func:`encode` returns them, from anywhere.

    Raises:
        SharedMapError: If it is no message, of another version, too large, damaged, or holds an
            index that does not exist, or a number that is not finite or out of bounds.
    """
    digest_of(message)
    magic, version, n_sessions, n_templates, n_places, n_links, n_pixels, n_body, digest = (
        _HEADER.unpack_from(message)
    )
    if magic != MAGIC or version != VERSION:
        raise SharedMapError(
            f"message: begins with {magic!r}, version {version}; expected {MAGIC!r}, {VERSION}"
        )
    for name, n, most in (
        ("sessions", n_sessions, MOST_SESSIONS),
        ("templates", n_templates, MOST_ROWS),
        ("places", n_places, MOST_ROWS),
        ("links", n_links, MOST_ROWS),
        ("pixels of a template", n_pixels, MOST_PIXELS),
        ("bytes", n_body, MOST_BODY_BYTES),
    ):
        if n > most:
            raise SharedMapError(f"message: has {n} {name}; expected at most {most}")
    sizes = n_templates * n_pixels, n_places * PLACE.itemsize, n_links * LINK.itemsize
    names = n_body - sum(sizes)
    if not 10 * n_sessions <= names <= (10 + MOST_TEXT_BYTES) * n_sessions:
        raise SharedMapError(
            f"message: {n_body} bytes do not hold the rows that its header names; send it again"
        )
    body = _unpacked(message[_HEADER.size :], n_body)
    if hashlib.sha256(body).digest() != digest:
        raise SharedMapError("message: its digest does not fit its content; send it again")
    sessions, sources = _sessions(body[:names], n_sessions)
    at = np.cumsum([names, *sizes])
    offer = Offer(
        sessions,
        sources,
        np.frombuffer(body, np.uint8, sizes[0], names).reshape(n_templates, n_pixels),
        np.frombuffer(body, PLACE, n_places, int(at[1])),
        np.frombuffer(body, LINK, n_links, int(at[2])),
    )
    check(offer)
    return offer


def _unpacked(packed: bytes, n_body: int) -> bytes:
    """Decompress exactly so many bytes; a bomb is noticed before it grows."""
    unpacker = zlib.decompressobj()
    try:
        body = unpacker.decompress(packed, n_body + 1)
    except zlib.error as error:
        raise SharedMapError(f"message: cannot be decompressed ({error}); send it again") from None
    if len(body) != n_body or not unpacker.eof or unpacker.unused_data:
        raise SharedMapError(
            f"message: its body is not the {n_body} bytes that its header names; send it again"
        )
    return body


def _sessions(table: bytes, n: int) -> tuple[tuple[int, ...], tuple[str, ...]]:
    sessions, sources, at = [], [], 0
    try:
        for _ in range(n):
            session, length = struct.unpack_from("<QH", table, at)
            text = table[at + 10 : at + 10 + length]
            at += 10 + length
            sessions.append(session)
            sources.append(text.decode("utf-8"))
    except (struct.error, UnicodeDecodeError) as error:
        raise SharedMapError(f"message: its sessions cannot be read ({error})") from None
    if at != len(table):
        raise SharedMapError(f"message: {len(table) - at} bytes of its sessions are left over")
    return tuple(sessions), tuple(sources)


def check(offer: Offer) -> None:
    """Check the content of an offer.

    Raises:
        SharedMapError: With the first thing that is wrong.
    """
    if not 1 <= len(offer.sessions) <= MOST_SESSIONS:
        raise SharedMapError(
            f"offer: names {counted(len(offer.sessions), 'session')}; expected 1 to {MOST_SESSIONS}"
        )
    if len(set(offer.sessions)) != len(offer.sessions):
        raise SharedMapError("offer: names a session twice; expected each once")
    wrong = [session for session in offer.sessions if not 0 <= session < 1 << ID_BITS]
    if wrong:
        raise SharedMapError(f"offer: session {wrong[0]}; expected a number of {ID_BITS} bits")
    for name, rows in (
        ("templates", offer.pixels),
        ("places", offer.places),
        ("links", offer.links),
    ):
        if len(rows) > MOST_ROWS:
            raise SharedMapError(
                f"offer: has {len(rows)} {name}; expected at most {MOST_ROWS}; offer more often"
            )
    places, links, n = offer.places, offer.links, len(offer.sessions)
    _within("places.session", places["session"], n - 1)
    _within("places.number", places["number"], (1 << NUMBER_BITS) - 1)
    _within("links.source_session", links["source_session"], n - 1)
    _within("links.target_session", links["target_session"], n - 1)
    for name in ("source", "target"):
        _within(f"links.{name}", links[name], (1 << NUMBER_BITS) - 1)
    keys = places["session"].astype(np.int64) << NUMBER_BITS | places["number"]
    if len(np.unique(keys)) != len(keys):
        raise SharedMapError("offer: has a place twice; expected each once")
    own = (links["source_session"] == links["target_session"]) & (
        links["source"] == links["target"]
    )
    if own.any():
        raise SharedMapError(f"offer: link {int(np.argmax(own))} leads from a place to itself")
    angle = 2.0 * math.pi
    for name, values, least, most in (
        ("places.pose", places["pose"], -MOST_METRES, MOST_METRES),
        ("places.cell", places["cell"], 0.0, 1e6),
        ("links.distance_m", links["distance_m"], 0.0, MOST_METRES),
        ("links.heading_rad", links["heading_rad"], -angle, angle),
        ("links.facing_rad", links["facing_rad"], -angle, angle),
        ("links.duration_s", links["duration_s"], 0.0, MOST_SECONDS),
    ):
        inside = (values >= least) & (values <= most)  # false for NaN
        if not inside.all():
            value = float(values[~inside].flat[0])
            raise SharedMapError(f"offer: {name} holds {value:g}; expected {least:g} to {most:g}")


def _within(name: str, values: np.ndarray, most: int) -> None:
    if len(values) and values.max() > most:
        raise SharedMapError(f"offer: {name} holds {int(values.max())}; expected at most {most}")
