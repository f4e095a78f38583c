import csv
import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from neuroslam.errors import BadFrame, SourceError
from neuroslam.sensors import open_source
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.streams import SAME_TIME_S, Streams
from neuroslam.types import Frame, Pose, Velocity
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import ArenaSource


class Listed(IndexedSource):
    """Frames from a list; a fault in it is a bad frame. Counts how many were made."""

    def __init__(self, name, frames, rate=None):
        self.name, self.listed, self.n_frames = name, frames, len(frames)
        self.frame_rate_hz, self.made = rate, 0

    def frame(self, index):
        self.made += 1
        if isinstance(self.listed[index], str):
            raise BadFrame(self.listed[index])
        return self.listed[index]._replace(index=index)


def camera_at(times, rate=None, **more):
    image = np.zeros((2, 2), np.uint8)
    return Listed("camera", [Frame(0, float(t), image=image + k % 250, **more)
                             for k, t in enumerate(times)], rate)  # fmt: skip


def motion_at(times, velocities=None, rate=None, **more):
    velocities = [(1.0, 0.5)] * len(times) if velocities is None else velocities
    return Listed("motion", [Frame(0, float(t), velocity=Velocity(*v), **more)
                             for t, v in zip(times, velocities, strict=True)], rate)  # fmt: skip


def travelled(times, velocities, low, high):
    """Distance and turn between two times, of motion that holds over the interval before it."""
    starts = np.maximum(times[:-1], low)
    durations = np.clip(np.minimum(times[1:], high) - starts, 0.0, None)
    return durations @ np.asarray(velocities)[1:]


def refused(act):
    with pytest.raises(SourceError) as caught:
        act()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def alike(ours, theirs):
    strip = [[f._replace(image=None) for f in frames] for frames in (ours, theirs)]
    images = [[None if f.image is None else f.image[0, 0] for f in s] for s in (ours, theirs)]
    return strip[0] == strip[1] and images[0] == images[1]


def film(path, n, fps=30.0, code="MJPG"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), fps, (32, 24))
    for k in range(n):
        writer.write(np.full((24, 32, 3), 2 * k, np.uint8))
    writer.release()


def log(path, times, velocities=None):
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["time_s", "v_m_s", "w_rad_s"])
        velocities = [(1.0, 0.0)] * len(times) if velocities is None else velocities
        out.writerows([repr(float(t)), *v] for t, v in zip(times, velocities, strict=True))


instants = st.lists(st.integers(1, 400), min_size=1, max_size=30).map(
    lambda steps: np.cumsum(steps) / 997.0
)


@given(instants, instants, st.floats(-1.0, 1.0), st.integers(0, 99))
def test_distance_and_turn_are_conserved_whatever_the_two_rates_are(seen, moved, shift, seed):
    moved = moved + shift
    assume(max(seen[0], moved[0]) <= min(seen[-1], moved[-1]))
    velocities = np.random.default_rng(seed).normal(size=(len(moved), 2))
    frames = list(Streams(camera_at(seen), motion_at(moved, velocities)))
    times = np.array([f.time_s for f in frames])
    assert [f.index for f in frames] == list(range(len(frames)))
    assert np.all(np.diff(times) > SAME_TIME_S)
    assert times[0] == pytest.approx(max(seen[0], moved[0]), abs=2e-6)
    assert times[-1] == pytest.approx(min(seen[-1], moved[-1]), abs=2e-6)
    got = np.diff(times) @ np.array([f.velocity for f in frames])[1:]
    np.testing.assert_allclose(
        got, travelled(moved, velocities, times[0], times[-1]), atol=1e-5
    )  # a microsecond at each of at most 60 times
    # Every time of either that both cover is there, once.
    both = np.concatenate([t[(t >= times[0]) & (t <= times[-1])] for t in (seen, moved)])
    assert np.abs(both[:, None] - times).min(axis=1).max() < 2e-6
    assert sum(f.image is not None for f in frames) == np.sum(
        (seen >= times[0] - SAME_TIME_S) & (seen <= times[-1] + SAME_TIME_S)
    )


def test_a_camera_of_30_hz_among_motion_of_100_hz_shows_every_image_once():
    seen, moved = np.arange(31) / 30.0, np.arange(101) / 100.0
    frames = list(Streams(camera_at(seen, 30.0), motion_at(moved, rate=100.0)))
    with_image = [f for f in frames if f.image is not None]
    np.testing.assert_allclose([f.time_s for f in with_image], seen, atol=1e-9)
    assert [f.image[0, 0] for f in with_image] == list(range(31))
    assert len(frames) == 31 + 101 - 11  # they meet every tenth of a second
    assert all(f.velocity == (1.0, 0.5) for f in frames)


def test_times_that_differ_by_rounding_are_one_frame():
    times = np.arange(20) * 0.1
    frames = list(Streams(camera_at(times + 1e-9), motion_at(times)))
    assert [f.time_s for f in frames] == times.tolist()
    assert all(f.image is not None for f in frames)


def test_a_motion_that_lasts_is_shared_out_over_the_frames_in_it():
    moved, velocities = [0.0, 1.0, 2.0], [(9.0, 9.0), (1.0, 0.1), (2.0, -0.2)]
    frames = list(Streams(camera_at([0.5, 0.75, 1.25, 1.75]), motion_at(moved, velocities)))
    assert [(f.time_s, f.velocity) for f in frames] == [
        (0.5, (1.0, 0.1)),
        (0.75, (1.0, 0.1)),
        (1.0, (1.0, 0.1)),
        (1.25, (2.0, -0.2)),
        (1.75, (2.0, -0.2)),
    ]


def test_what_is_sensed_is_that_of_a_sample_within_half_a_period_or_none():
    moved = np.arange(5) * 1.0
    motion = Listed(
        "motion",
        [Frame(0, t, velocity=Velocity(0, 0), heading_rad=t, truth=Pose(t, 0, 0)) for t in moved],
        rate=2.0,  # as if every other sample were missing: half a period is 0.25 s
    )
    frames = list(Streams(camera_at([0.0, 1.2, 1.5, 1.9, 4.0]), motion))
    assert [(f.time_s, f.heading_rad) for f in frames] == [
        (0.0, 0.0), (1.0, 1.0), (1.2, 1.0), (1.5, None), (1.9, 2.0), (2.0, 2.0), (3.0, 3.0),
        (4.0, 4.0),
    ]  # fmt: skip
    assert all((f.truth is None) == (f.heading_rad is None) for f in frames)


def test_the_motion_source_has_priority_over_the_camera():
    times = np.arange(4.0)
    camera = camera_at(times, 1.0, truth=Pose(1, 1, 1), ranges=np.ones(3))
    motion = motion_at(times, rate=1.0, truth=Pose(2, 2, 2), walls=np.zeros((1, 2)))
    for frame in Streams(camera, motion):
        assert frame.truth == (2, 2, 2)
        assert frame.ranges.tolist() == [1, 1, 1]
        assert frame.walls.shape == (1, 2)


def test_reading_from_the_middle_gives_what_reading_from_the_start_does():
    rng = np.random.default_rng(0)
    seen, moved = (np.cumsum(rng.uniform(0.01, 0.1, 200)) for _ in range(2))
    source = Streams(camera_at(seen), motion_at(moved, rng.normal(size=(200, 2))))
    whole = list(source)
    assert alike(list(source), whole)
    assert alike(list(source.frames(37, 90)), whole[37:90])
    assert alike(list(source.frames(len(whole) - 3)), whole[-3:])
    assert list(source.frames(len(whole))) == []
    assert list(source.frames(5, 5)) == []


def test_which_is_named_first_does_not_matter():
    seen, moved = np.arange(40) / 7.0, np.arange(60) / 11.0
    one, two = camera_at(seen), motion_at(moved)
    assert alike(list(Streams(one, two)), list(Streams(two, one)))
    assert Streams(two, one).camera is one


def test_no_more_is_read_ahead_than_a_frame_of_each():
    seen, moved = np.arange(300) / 30.0, np.arange(1000) / 100.0
    camera, motion = camera_at(seen), motion_at(moved)
    source = Streams(camera, motion)
    camera.made = motion.made = 0
    for frame in source:
        assert camera.made <= np.sum(seen <= frame.time_s + 1e-6) + 1
        assert motion.made <= np.sum(moved <= frame.time_s + 1e-6) + 1


def test_a_bad_frame_is_raised_or_skipped_and_reported_once():
    seen, moved = np.arange(10) / 5.0, np.arange(20) / 10.0
    camera, motion = camera_at(seen), motion_at(moved, np.column_stack([moved, moved]))
    camera.listed[3], motion.listed[10] = "camera: frame 3 is torn", "motion: frame 10 is mad"
    source = Streams(camera, motion)
    delivered = []
    with pytest.raises(BadFrame, match="frame 3 is torn"):
        delivered.extend(source)
    assert delivered[-1].time_s < 0.6
    faults = []
    frames = list(source.frames(on_bad_frame=faults.append))
    assert [str(f) for f in faults] == ["camera: frame 3 is torn", "motion: frame 10 is mad"]
    assert sum(f.image is not None for f in frames) == 9
    (at_1s,) = (f for f in frames if f.time_s == 1.0)
    assert at_1s.velocity == (1.1, 1.1)  # that of the next sample, which now lasts from 0.9 s on
    late = []
    assert alike(list(source.frames(13, None, late.append)), frames[13:])
    assert late == []


def test_times_that_fall_are_bad_frames():
    source = Streams(camera_at(np.arange(5.0)), motion_at([0.0, 1.0, 0.5, 2.0, 4.0]))
    assert "motion: frame 2: its time 0.5 s is not after 1 s; times must rise" in refused(
        lambda: list(source)
    )
    assert [f.time_s for f in source.frames(on_bad_frame=[].append)] == [0, 1, 2, 3, 4]


def test_sources_that_do_not_overlap_are_refused_with_both_ranges():
    camera, motion = camera_at(np.arange(0.0, 3.0)), motion_at(np.arange(10.0, 15.0))
    for one, two in ((camera, motion), (motion, camera)):
        assert refused(lambda one=one, two=two: Streams(one, two)) == (
            "camera runs from 0 s to 2 s and motion runs from 10 s to 14 s; "
            "expected an overlap; check that both use one clock, or give --offset S, the seconds "
            "to add to the times of the motion, or --offset auto"
        )


def test_a_video_of_unknown_length_is_refused_after_reading(tmp_path):
    film(tmp_path / "a.mkv", 9, 10.0, "mp4v")
    log(tmp_path / "m.csv", np.arange(5.0, 9.0))
    source = open_source(f"{tmp_path}/a.mkv+{tmp_path}/m.csv")
    message = refused(lambda: list(source))
    assert "a.mkv runs from 0 s to 0.8 s" in message
    assert "m.csv runs from 5 s to 8 s" in message


def test_images_before_and_after_the_motion_are_counted():
    merged = Streams(camera_at(np.arange(10.0)), motion_at([1.0, 2.0, 3.5]))
    assert merged.unused == ()
    for _ in range(2):
        assert [f.time_s for f in merged] == [1.0, 2.0, 3.0, 3.5]
        assert merged.unused == (
            "motion begins at 1 s; 1 image before it was not used",
            "motion ends at 3.5 s; 6 images after it were not used",
        )
    inside = Streams(camera_at([1.0, 2.0]), motion_at(np.arange(5.0)))
    list(inside)
    assert inside.unused == ()
    unknown = camera_at(np.arange(10.0))
    merged = Streams(unknown, motion_at([0.0, 2.0]))
    unknown.frames, unknown.n_frames = lambda **_: iter(unknown.listed), None
    list(merged)
    assert merged.unused == ("motion ends at 2 s; the images after it were not used",)


def test_two_of_a_kind_are_refused():
    times = np.arange(3.0)
    assert "neither source has images; expected a camera and a source of motion" in refused(
        lambda: Streams(motion_at(times), motion_at(times))
    )
    assert "camera has no motion" in refused(lambda: Streams(camera_at(times), camera_at(times)))
    bad = Listed("log", ["torn"])
    assert "log: has no usable frame" in refused(lambda: Streams(camera_at(times), bad))


def test_a_video_and_a_log_are_opened_by_their_names_with_a_plus(tmp_path):
    film(tmp_path / "drive.avi", 31)
    moved = np.arange(101) / 100.0
    log(tmp_path / "motion.csv", moved, np.column_stack([moved, -moved]))
    names = [f"{tmp_path}/drive.avi", f"{tmp_path}/motion.csv"]
    source = open_source("+".join(names))
    assert isinstance(source, Streams)
    frames = list(source)
    assert sum(f.image is not None for f in frames) == 31
    assert alike(frames, list(open_source("+".join(names[::-1]))))
    distance = sum(b.velocity.v_m_s * (b.time_s - a.time_s) for a, b in pairwise(frames))
    assert distance == pytest.approx(sum(moved[1:]) * 0.01)


def test_a_file_with_a_plus_in_its_name_is_that_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log(tmp_path / "a+b.csv", [0.0, 1.0])
    assert open_source("a+b.csv").n_frames == 2
    film(tmp_path / "c+d.avi", 3, 1.0)
    merged = open_source("a+b.csv+c+d.avi")
    assert isinstance(merged, Streams)
    assert [f.time_s for f in merged] == [0.0, 1.0]
    message = refused(lambda: open_source("a+b.csv+none.avi"))
    assert "a+b.csv+none.avi: a+b.csv exists, 'none.avi' does not" in message


def test_a_camera_may_be_merged_with_a_walk_and_its_walls(tmp_path):
    walk = roam(named_arena("two_rooms"), 0.5, np.random.default_rng(0), rate_hz=50.0)
    film(tmp_path / "rat.avi", 100, 7.0)
    source = Streams(open_source(tmp_path / "rat.avi"), ArenaSource(walk))
    frames = list(source)
    assert sum(f.image is not None for f in frames) == 100
    assert all(f.walls is not None and f.heading_rad is not None for f in frames)
    x, y = walk.positions[0]
    for before, frame in pairwise(frames):
        dt = frame.time_s - before.time_s
        heading = walk.headings_rad[np.searchsorted(walk.times_s, frame.time_s - 1e-9)]
        x += frame.velocity.v_m_s * dt * math.cos(heading)
        y += frame.velocity.v_m_s * dt * math.sin(heading)
    expected = [np.interp(frames[-1].time_s, walk.times_s, p) for p in walk.positions.T]
    np.testing.assert_allclose([x, y], expected, atol=1e-9)
