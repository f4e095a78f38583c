"""Messages of a shared map: what comes back is what was sent, and nothing else is accepted."""

import hashlib
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.errors import SharedMapError
from neuroslam.shared_map.messages import (
    _HEADER,
    LINK,
    MOST_BODY_BYTES,
    MOST_ROWS,
    PLACE,
    Offer,
    decode,
    encode,
    template_ids,
)


def offer(n=5, seed=0, session=77):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (n, 12), dtype=np.uint8)
    places = np.zeros(n, PLACE)
    places["number"], places["first_frame"] = np.arange(n), 10 * np.arange(n)
    places["template"] = template_ids(pixels)
    places["pose"] = rng.normal(size=(n, 3))
    places["cell"] = rng.uniform(0, 20, (n, 3))
    links = np.zeros(n - 1, LINK)
    links["source"], links["target"] = np.arange(n - 1), np.arange(1, n)
    links["distance_m"], links["duration_s"] = 1.0, 2.0
    return Offer((session,), ("world:corridor",), pixels, places, links)


def changed(**columns):
    """An offer with other values in one column of a table."""
    one = offer()
    for name, value in columns.items():
        table, column = name.split("__")
        getattr(one, table)[column][2] = value
    return one


def test_a_message_comes_back_as_it_was_sent():
    sent = offer()
    back = decode(encode(sent))
    assert back.sessions == sent.sessions
    assert back.sources == sent.sources
    for name in ("pixels", "places", "links"):
        np.testing.assert_array_equal(getattr(back, name), getattr(sent, name))


def test_equal_offers_are_equal_bytes():
    assert encode(offer()) == encode(offer())


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"places__pose": np.nan}, "places.pose holds nan"),
        ({"places__pose": 1e9}, "places.pose holds 1e.09; expected -1e.06 to 1e.06"),
        ({"places__cell": -1.0}, "places.cell holds -1"),
        ({"places__session": 1}, "places.session holds 1; expected at most 0"),
        ({"places__number": 1 << 24}, "places.number"),
        ({"places__number": 1}, "has a place twice"),
        ({"links__distance_m": np.inf}, "links.distance_m holds inf"),
        ({"links__distance_m": -1.0}, "links.distance_m holds -1"),
        ({"links__facing_rad": 7.0}, "links.facing_rad holds 7"),
        ({"links__duration_s": np.nan}, "links.duration_s holds nan"),
        ({"links__target_session": 9}, "links.target_session holds 9"),
        ({"links__target": 2}, "leads from a place to itself"),
    ],
)
def test_what_is_out_of_bounds_is_refused(columns, reason):
    with pytest.raises(SharedMapError, match=reason):
        encode(changed(**columns))


def test_a_message_holds_no_more_rows_than_its_bounds():
    rows = np.zeros(MOST_ROWS + 1, LINK)
    with pytest.raises(SharedMapError, match="20001 links; expected at most 20000"):
        encode(offer()._replace(links=rows))


def forged(body: bytes, n_links: int, n_body: int | None = None) -> bytes:
    """A message whose header and digest are right for whatever body."""
    digest = hashlib.sha256(body).digest()
    n = len(body) if n_body is None else n_body
    return _HEADER.pack(b"NSLM", 1, 1, 0, 0, n_links, 4, n, digest) + zlib.compress(body)


def test_a_bomb_is_refused_before_it_grows():
    table = struct.pack("<QH", 7, 0)
    bomb = forged(table + bytes(20_000_000), 0, len(table))
    with pytest.raises(SharedMapError, match="not the 10 bytes"):
        decode(bomb)
    with pytest.raises(SharedMapError, match=f"expected at most {MOST_BODY_BYTES}"):
        decode(forged(table, 0, 2**32 - 1))


def test_a_forged_message_is_checked_too():
    link = np.zeros(1, LINK)
    link["source_session"] = 5
    with pytest.raises(SharedMapError, match="source_session holds 5"):
        decode(forged(struct.pack("<QH", 7, 0) + link.tobytes(), 1))
    with pytest.raises(SharedMapError, match="do not hold the rows"):
        decode(forged(struct.pack("<QH", 7, 0), 9))
    with pytest.raises(SharedMapError, match="expected a number of 40 bits"):
        decode(forged(struct.pack("<QH", 1 << 41, 0), 0))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_a_damaged_message_is_refused_and_never_believed(data):
    message = bytearray(encode(offer()))
    at = data.draw(st.integers(0, len(message) - 1))
    cut = data.draw(st.booleans())
    if cut:
        del message[at:]
    else:
        message[at] ^= data.draw(st.integers(1, 255))
    try:
        back = decode(bytes(message))
    except SharedMapError:
        return
    # Only what carries no content may differ, such as the level that zlib notes of itself.
    assert encode(back) == encode(offer())


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_whatever_bytes_come_are_no_message(noise):
    with pytest.raises(SharedMapError):
        decode(noise)
