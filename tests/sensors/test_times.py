"""Times of tables, lists and file names: column, unit and order; those not recognised."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuroslam.errors import SourceError
from neuroslam.sensors import open_source
from neuroslam.sensors.images import ImageFile, in_order
from neuroslam.sensors.times import (
    PER_SECOND,
    UNIT_NAMES,
    decimal_names,
    in_seconds,
    parse_time,
    time_column,
    times_of_names,
)

UNIX_S = 1_700_000_000.0


def table(path, header, times, tail="1.0,0.1"):
    path.write_text("\n".join([header, *(f"{time},{tail}" for time in times)]) + "\n")
    return path


def images(folder, names):
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((8, 12), k % 250, np.uint8))
    return folder


def times(source):
    return [frame.time_s for frame in source]


# The time column


@pytest.mark.parametrize(
    ("header", "factor", "word"),
    [
        ("# time_s", 1, None),
        ("time", 1, "seconds"),
        ("Time", 1, "seconds"),
        ("t", 1, "seconds"),
        ("T [s]", 1, "seconds"),
        ("timestamp", 1, "seconds"),
        ("stamp", 1, "seconds"),
        ("Time Stamp (sec)", 1, "seconds"),
        ("elapsed_time", 1, "seconds"),
        ('"time"', 1, "seconds"),
        ("time_ms", 1000, "milliseconds"),
        ("Timestamp (ms)", 1000, "milliseconds"),
        ("_timestamp_ms", 1000, "milliseconds"),
        ("time [us]", 1_000_000, "microseconds"),
        ("t_\u00b5s", 1_000_000, "microseconds"),
        ("#timestamp [ns]", 1_000_000_000, "nanoseconds"),
        ("header.stamp", 1_000_000_000, "nanoseconds"),
        ("%time", 1_000_000_000, "nanoseconds"),
    ],
)
def test_a_motion_table_has_its_times_under_any_usual_name(header, factor, word, tmp_path):
    ticks = range(0, 40, 4)  # tenths of a second
    stamps = [k * factor // 10 if factor > 1 else k / 10 for k in ticks]
    path = table(tmp_path / "m.csv", f"{header},v_m_s,w_rad_s", stamps)
    source = open_source(path)
    np.testing.assert_allclose(times(source), 0.4 * np.arange(10), atol=1e-9)
    assert len(source.notes) == (word is not None)
    assert all(f"times are in {word}" in note for note in source.notes)


@pytest.mark.parametrize("name", ["good.csv", "named_time.csv", "savetxt.csv"])
def test_the_given_tables_all_end_at_9_9_s(name, cases):
    source = open_source(cases / "csv_time_column_not_known" / name)
    assert times(source)[-1] == 9.9


@pytest.mark.parametrize("unit", PER_SECOND)
@pytest.mark.parametrize("start_s", [0.0, 86_400.0, UNIX_S])
def test_a_time_column_without_a_unit_shows_it_by_step_and_size(unit, start_s, tmp_path):
    stamps = [int((start_s + 0.05 * k) * PER_SECOND[unit]) for k in range(20)]
    if unit == "s":
        stamps = [start_s + 0.05 * k for k in range(20)]
    source = open_source(table(tmp_path / "m.csv", "time,v_m_s,w_rad_s", stamps))
    np.testing.assert_allclose(times(source), start_s + 0.05 * np.arange(20), atol=1e-3)
    (note,) = source.notes
    assert UNIT_NAMES[unit] in note


@given(
    st.sampled_from(list(PER_SECOND)),
    st.floats(0.005, 1.5),
    st.sampled_from([1.2e9, 1.7e9, 2.4e9]),
    st.integers(3, 40),
)
def test_the_unit_of_unix_times_is_found_at_any_rate(unit, step_s, start_s, n):
    stamps = (start_s + step_s * np.arange(n)) * PER_SECOND[unit]
    found, how = in_seconds(stamps)
    assert how == unit
    np.testing.assert_allclose(found, start_s + step_s * np.arange(n), rtol=1e-12)


def test_a_stated_unit_holds_unless_it_is_impossible():
    slow = np.arange(5) * 3600.0
    assert in_seconds(slow, "s") == (pytest.approx(slow), "s")
    assert in_seconds(np.array([UNIX_S * 1e9, UNIX_S * 1e9 + 1e8]), "s")[1] == "ns"


def test_seconds_and_nanoseconds_in_two_columns_are_one_time(tmp_path):
    rows = [f"{1_700_000_000 + k // 4},{250_000_000 * (k % 4)},1,0" for k in range(9)]
    for header in ("secs,nsecs", "header.stamp.sec,header.stamp.nanosec", "stamp_sec,stamp_nsec"):
        path = tmp_path / "m.csv"
        path.write_text("\n".join([f"{header},v_m_s,w_rad_s", *rows]))
        source = open_source(path)
        assert times(source) == [UNIX_S + 0.25 * k for k in range(9)]
        assert "columns 1 and 2, in seconds and nanoseconds" in source.notes[0]


def test_dates_with_a_time_of_day_are_times(tmp_path):
    stamps = [f"2023-11-14 22:13:20.{k}00000" for k in range(5)]
    source = open_source(table(tmp_path / "m.csv", "datetime,v_m_s,w_rad_s", stamps))
    np.testing.assert_allclose(times(source), UNIX_S + 0.1 * np.arange(5), atol=1e-6)
    assert parse_time("2023-11-14T23:13:20+01:00") == UNIX_S


def test_comments_before_the_header_and_between_rows_are_skipped(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text("# wheels of robot 3\n# time_s,v_m_s,w_rad_s\n0,1,0\n# stop\n0.5,1,0\n")
    assert times(open_source(path)) == [0.0, 0.5]
    path.write_text("# wheels of robot 3\ntime_s,v_m_s,w_rad_s\n0,1,0\n0.5,1,0\n")
    assert times(open_source(path)) == [0.0, 0.5]


@pytest.mark.parametrize(
    ("header", "stamps"),
    [
        ("zeit", [0.0, 0.1, 0.25]),
        ("moment", [0.0, 0.1, 0.25]),
        ("recorded", [1.7e12, 1.7e12 + 50, 1.7e12 + 100]),
        ("timecode", ["a", "b", "c"]),
        ("date", ["2024-05-01", "2024-05-01", "2024-05-01"]),
    ],
)
def test_a_table_whose_times_are_not_recognised_is_refused(header, stamps, tmp_path):
    path = table(tmp_path / "m.csv", f"{header},v_m_s,w_rad_s", stamps)
    with pytest.raises(SourceError, match="times are not recognised") as caught:
        open_source(path)
    assert f"column {header!r} looks like a time; name it time_s, time_ms" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("header", ["frame", "", "distance_m", "odometer", "encoder_left"])
def test_a_table_without_times_says_what_rate_is_assumed(header, tmp_path):
    steps = [0, 1, 2] if header in ("frame", "") else [0.0, 0.1, 0.25]
    source = open_source(table(tmp_path / "m.csv", f"{header},v_m_s,w_rad_s", steps), 10.0)
    assert times(source) == [0.0, 0.1, 0.2]
    assert source.notes == (f"{tmp_path}/m.csv: has no times; 10 frames per second assumed",)


def test_a_lost_field_of_truth_costs_the_truth_of_that_row(tmp_path):
    path = tmp_path / "m.csv"
    rows = [f"{k / 10},1,0,{k},0,0" for k in range(5)]
    rows[2] = "0.2,1,0,lost,0,0"
    path.write_text("\n".join(["time_s,v_m_s,w_rad_s,x_m,y_m,theta_rad", *rows]))
    source = open_source(path)
    assert [frame.index for frame in source if frame.truth is None] == [2]
    assert "1 field of truth cannot be read, the first: " in source.notes[0]
    assert "line 4: x_m is 'lost'" in source.notes[0]


def test_time_s_comes_before_other_columns_of_time():
    header = ["stamp", "time_ms", "time_s", "v_m_s"]
    assert time_column(header).index == 2
    assert time_column(header[:2]).index == 1
    assert time_column(["v [m/s]", "t_left_wheel", "temperature", "s"]) is None


# Times of images


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("start_s", [0.0, UNIX_S])
def test_times_of_images_may_be_in_any_unit(unit, start_s, tmp_path):
    folder = images(tmp_path / "f", [f"{k}.png" for k in range(6)])
    stamps = [int((start_s + 0.1 * k) * PER_SECOND[unit]) for k in range(6)]
    lines = "\n".join(map(str, stamps))
    for name, text in (("times.txt", lines), ("times.csv", f"timestamp [{unit}]\n{lines}")):
        (folder / name).write_text(text)
        source = open_source(folder)
        np.testing.assert_allclose(times(source), start_s + 0.1 * np.arange(6), atol=1e-3)
        assert f"{name}: times are in {UNIT_NAMES[unit]}" in source.notes[0]
        (folder / name).unlink()
    listed = "\n".join(f"{stamp} f/{k}.png" for k, stamp in enumerate(stamps))
    (tmp_path / "list.txt").write_text(f"# timestamp_{unit} filename\n{listed}\n")
    np.testing.assert_allclose(
        times(open_source(tmp_path / "list.txt")), start_s + 0.1 * np.arange(6), atol=1e-3
    )


def test_the_given_times_in_nanoseconds_are_a_tenth_of_a_second_apart(cases, tmp_path, call):
    source = open_source(cases / "times_in_ns" / "f")
    np.testing.assert_allclose(times(source), UNIX_S + 0.1 * np.arange(6), atol=1e-6)
    out = tmp_path / "m"
    done = call("run", cases / "times_in_ns" / "f", "-o", out, "--no-tensorboard")
    assert (done.code, done.err) == (0, "")
    assert "times.txt: times are in nanoseconds, as their size shows" in done.out


def test_a_time_lapse_is_in_seconds(tmp_path):
    folder = images(tmp_path / "f", [f"{k}.png" for k in range(4)])
    (folder / "times.txt").write_text("0\n5\n10\n15\n")
    assert times(open_source(folder)) == [0.0, 5.0, 10.0, 15.0]


def test_a_track_may_be_in_microseconds(tmp_path):
    np.savez(tmp_path / "t.npz", t=np.arange(5) * 20_000, pos=np.arange(10.0).reshape(5, 2))
    source = open_source(tmp_path / "t.npz")
    np.testing.assert_allclose(times(source), 0.02 * np.arange(5))
    assert "t: times are in microseconds" in source.notes[0]


# Names that are times


@given(st.lists(st.integers(0, 10**8), min_size=2, max_size=30, unique=True), st.data())
def test_names_written_by_str_of_a_time_are_in_the_order_of_time(ticks, data):
    stamps = sorted(UNIX_S + tick / 1e6 for tick in ticks)
    prefix = data.draw(st.sampled_from(["", "frame_", "cam0-"]))
    files = [ImageFile(f"{prefix}{stamp}.jpg", None) for stamp in stamps]
    shuffled = data.draw(st.permutations(files))
    assert [file.name for file in in_order(shuffled)] == [file.name for file in files]


def test_the_given_names_are_in_the_order_of_time_and_are_the_times(cases):
    source = open_source(cases / "names_of_str_time" / "frames")
    stamps = [float(file.name.removesuffix(".jpg")) for file in source.images]
    assert stamps == sorted(stamps)
    assert times(source) == stamps
    assert "the names of the images are their times, in seconds" in source.notes[0]


def test_a_folder_of_time_names_beginning_at_zero_is_in_order(tmp_path):
    names = ["0.0.png", "0.05.png", "0.1.png", "0.15.png", "0.5.png", "1.0.png", "10.25.png"]
    source = open_source(images(tmp_path / "f", names))
    assert [file.name for file in source.images] == names
    assert times(source) == [k / 20 for k in range(7)]  # small numbers may be anything


def test_a_file_of_another_name_does_not_change_the_order(tmp_path):
    names = ["1700000000.25.png", "1700000000.5.png", "1700000001.0.png", "map.png"]
    source = open_source(images(tmp_path / "f", names[::-1]))
    assert [file.name for file in source.images] == names


def test_counters_with_points_stay_in_natural_order(tmp_path):
    names = [f"1.{k}.png" for k in range(1, 12)] + ["2.1.png"]
    source = open_source(images(tmp_path / "f", names))
    assert [file.name for file in source.images] == names
    burst = [f"1700000000_{k}" for k in (1, 2, 10)]
    assert decimal_names(burst) is None
    assert decimal_names(["a1", "b2"]) is None


def test_names_of_nanoseconds_are_times_and_dates_are_not():
    stamps = [f"{1403636579763555584 + 50_000_000 * k}" for k in range(3)]
    found, unit = times_of_names(stamps)
    assert unit == "ns"
    np.testing.assert_allclose(np.diff(found), 0.05, atol=1e-6)
    assert times_of_names(["20240101120000", "20240101120001"]) is None
    assert times_of_names(["1700000000", "1700000001"]) is None
    assert times_of_names(["1700000000_1", "1700000000_2"]) is None
    assert times_of_names([f"{k:06d}" for k in range(3)]) is None


def test_times_in_a_file_come_before_those_in_names(tmp_path):
    folder = images(tmp_path / "f", ["1700000000.5.png", "1700000000.75.png"])
    (folder / "times.txt").write_text("0\n0.5\n")
    assert times(open_source(folder)) == [0.0, 0.5]
    assert not math.isnan(open_source(folder).frame_rate_hz)
