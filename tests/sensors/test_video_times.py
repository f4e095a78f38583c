"""A video gives its frames at the presentation times of its container, whatever the rate."""

import struct

import cv2
import numpy as np
import pytest

from neuroslam.errors import BadFrame
from neuroslam.sensors import open_source
from neuroslam.sensors.mp4 import read_mp4
from neuroslam.sensors.streams import Streams

PTS_MS = [0, 33, 66, 120, 150, 1200, 1233, 2000, 2010, 2500]
"""A phone in the dark: 30 Hz, a pause of a second, then slower."""


def film(path, n, fps, code="mp4v"):
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), fps, (64, 48)
    )
    for k in range(n):
        writer.write(np.full((48, 64, 3), 20 * k % 250, np.uint8))
    writer.release()
    return path


def box(kind, content):
    return struct.pack(">I", 8 + len(content)) + kind + content


def boxes(data):
    at = 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        yield kind, data[at + 8 : at + size]
        at += size


def rewritten(data, change):
    """Return boxes with the content of some of them replaced: ``change`` by kind."""
    out = b""
    for kind, content in boxes(data):
        if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts"):
            content = rewritten(content, change)
        out += box(kind, change[kind](content) if kind in change else content)
    return out


def with_times(path, pts_ms):
    """Give a video of 1000 Hz the presentation times of a list: ``stts`` of ISO 14496-12."""
    steps = [*np.diff(pts_ms).tolist(), 33]
    scale = next(  # ticks per second of the track
        struct.unpack_from(">I", content, 12)[0] for content in found(path.read_bytes(), b"mdhd")
    )
    ticks = [round(step * scale / 1000) for step in steps]
    stts = struct.pack(">II", 0, len(ticks)) + b"".join(struct.pack(">II", 1, t) for t in ticks)

    def elst(_):
        return struct.pack(">IIIiI", 0, 1, 2**31 - 1, 0, 0x10000)

    path.write_bytes(rewritten(path.read_bytes(), {b"stts": lambda _: stts, b"elst": elst}))
    return path


def found(data, wanted):
    for kind, content in boxes(data):
        if kind == wanted:
            yield content
        if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts"):
            yield from found(content, wanted)


def with_edit(path, start_s, duration_s, version=0):
    """Let an edit list show a part of an MP4."""
    data = path.read_bytes()
    movie = struct.unpack_from(">I", next(found(data, b"mvhd")), 12)[0]
    media = struct.unpack_from(">I", next(found(data, b"mdhd")), 12)[0]
    layout = ">IIQqI" if version else ">IIIiI"
    edit = struct.pack(
        layout, version << 24, 1, round(duration_s * movie), round(start_s * media), 0x10000
    )
    path.write_bytes(rewritten(data, {b"elst": lambda _: edit}))
    return path


def with_block_times(path, pts_ms):
    """Give the blocks of a Matroska file of one cluster other times (RFC 9559, section 10)."""
    data = bytearray(path.read_bytes())
    at, k = data.index(b"\x1f\x43\xb6\x75"), 0  # a cluster
    while (at := data.find(b"\xa3", at + 1)) >= 0 and k < len(pts_ms):
        length = next(n for n in range(1, 9) if data[at + 1] >> (8 - n))
        block = at + 1 + length
        if data[block] == 0x81 and struct.unpack_from(">h", data, block + 1)[0] == k:
            struct.pack_into(">h", data, block + 1, pts_ms[k])
            k += 1
    assert k == len(pts_ms)
    path.write_bytes(data)
    return path


def times_ms(source):
    return [round(1000.0 * frame.time_s, 6) for frame in source]


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.m4v"])
def test_an_mp4_of_variable_rate_keeps_its_presentation_times(name, tmp_path):
    path = with_times(film(tmp_path / name, len(PTS_MS), 1000.0), PTS_MS)
    source = open_source(path)
    assert times_ms(source) == PTS_MS
    assert source.n_frames == len(PTS_MS)
    assert times_ms(source.frames(4, 8)) == PTS_MS[4:8]


def test_a_matroska_file_of_variable_rate_keeps_its_presentation_times(tmp_path):
    path = with_block_times(film(tmp_path / "a.mkv", len(PTS_MS), 1000.0, "MJPG"), PTS_MS)
    assert times_ms(open_source(path)) == PTS_MS


@pytest.mark.parametrize("name", ["vfr.mkv", "vfr.mp4"])
def test_the_given_videos_of_variable_rate_have_the_times_of_their_list(name, shared):
    folder = shared / "cases" / "vfr_video"
    if not folder.is_dir():
        pytest.skip("no ../shared/cases beside the checkout")
    expected_ms = np.loadtxt(folder / "pts_ms.txt")
    np.testing.assert_allclose(times_ms(open_source(folder / name)), expected_ms, atol=1e-6)
    merged = Streams(open_source(folder / name), open_source(folder / "motion.csv"))
    seen_ms = [1000.0 * frame.time_s for frame in merged if frame.image is not None]
    inside = expected_ms[expected_ms <= 10200.0]
    np.testing.assert_allclose(seen_ms, inside, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mkv", "MJPG")]
)
def test_a_video_of_constant_rate_has_the_multiples_of_its_period(name, code, tmp_path):
    source = open_source(film(tmp_path / name, 12, 12.5, code))
    assert [frame.time_s for frame in source] == [k / 12.5 for k in range(12)]


@pytest.mark.parametrize(
    ("name", "code"), [("a.mpg", "PIM1"), ("a.wmv", "WMV2"), ("a.3gp", "mp4v")]
)
def test_a_frame_without_a_presentation_time_follows_the_one_before_it(name, code, tmp_path):
    times = [frame.time_s for frame in open_source(film(tmp_path / name, 30, 25.0, code))]
    np.testing.assert_allclose(
        times, np.arange(30) / 25.0, atol=1e-9
    )  # an .mpg has none at its end


def test_a_raw_stream_without_times_has_the_rate_of_its_decoder(tmp_path):
    images = [np.full((48, 64), 20 * k, np.uint8) for k in range(5)]
    data = b"".join(cv2.imencode(".jpg", image)[1].tobytes() for image in images)
    (tmp_path / "a.mjpeg").write_bytes(data)
    source = open_source(tmp_path / "a.mjpeg")
    assert [frame.time_s for frame in source] == [k / source.frame_rate_hz for k in range(5)]


@pytest.mark.parametrize("version", [0, 1])
def test_an_edit_list_ends_a_video_without_an_error(version, tmp_path):
    path = with_edit(film(tmp_path / "a.mp4", 30, 10.0), 0.0, 2.0, version)
    source = open_source(path)
    assert source.n_frames is None
    assert times_ms(source) == [100 * k for k in range(20)]


def test_an_edit_list_that_begins_later_shows_the_rest(tmp_path):
    path = with_edit(film(tmp_path / "a.mp4", 30, 10.0), 1.0, 2.0)
    shown = [int(frame.image.mean()) for frame in open_source(path)]
    whole = [int(f.image.mean()) for f in open_source(film(tmp_path / "b.mp4", 30, 10.0))]
    assert shown == whole[10:]


def test_a_file_cut_within_its_edit_list_is_reported(tmp_path):
    path = with_edit(film(tmp_path / "a.mp4", 30, 10.0), 0.0, 2.0)
    data = bytearray(path.read_bytes())
    # The samples after the tenth are lost: as a download that was filled with zeros.
    (stsz,) = found(bytes(data), b"stsz")
    sizes = struct.unpack_from(">30I", stsz, 12)
    begin = data.index(b"mdat") + 4 + sum(sizes[:10])
    data[begin : begin + sum(sizes[10:])] = bytes(sum(sizes[10:]))
    path.write_bytes(data)
    with pytest.raises(BadFrame, match=r"is missing; expected frames until 2 s, as the container"):
        list(open_source(path))


def test_a_whole_mp4_states_its_number_of_frames(tmp_path):
    stated = read_mp4(film(tmp_path / "a.mp4", 7, 10.0))
    assert (stated.n_frames, stated.edited) == (7, None)
    assert read_mp4(film(tmp_path / "a.avi", 7, 10.0, "MJPG")) is None
    (tmp_path / "none.mp4").write_bytes(b"")
    assert read_mp4(tmp_path / "none.mp4") is None


@pytest.mark.parametrize("cut", range(0, 400, 7))
def test_damaged_boxes_of_an_mp4_are_no_error(cut, tmp_path):
    data = bytearray(film(tmp_path / "a.mp4", 3, 10.0).read_bytes())
    at = data.index(b"moov") - 4
    damaged = tmp_path / "cut.mp4"
    data[(at + cut) % len(data)] ^= 0xFF
    damaged.write_bytes(data)
    stated = read_mp4(damaged)
    assert stated is None or stated.n_frames is None or stated.n_frames >= 0
    damaged.write_bytes(data[: at + cut])
    read_mp4(damaged)
