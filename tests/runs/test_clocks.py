"""A camera and a source of motion whose clocks differ: an offset given, or found by turn rates."""

import json

import cv2
import numpy as np
import pytest

from neuroslam.config import BrainConfig
from neuroslam.errors import RunError, SourceError
from neuroslam.runs.clocks import (
    Turns,
    best_offset,
    find_joint_start,
    joint_start,
    resolve_offset,
    scale_of,
)
from neuroslam.runs.reading import read_plan
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.open import absolute_spec, seeded_spec, with_offset

EPOCH_S = 1_700_000_000.0
RATE_HZ = 20.0
N = 240


def turn_rates(seed, n=N):
    """Smooth turn rates in rad/s, as of a robot that steers at random."""
    noise = np.random.default_rng(seed).normal(size=n + 60)
    return 0.9 * np.convolve(noise, np.hanning(15) / 4.0, "same")[30 : n + 30]


def film(path, rates):
    """Film a wide wall while turning by these rates: one column is 1 / 40 rad."""
    strip = cv2.resize(
        np.random.default_rng(9).integers(0, 256, (1, 700), dtype=np.uint8), (2800, 48)
    )
    headings = np.cumsum(rates) / RATE_HZ
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, (96, 48))
    for heading in headings:
        at = 1400 - round(40.0 * heading)  # a left turn shows what is farther to the left
        writer.write(cv2.cvtColor(strip[:, at : at + 96], cv2.COLOR_GRAY2BGR))
    writer.release()


def log(path, times_s, rates):
    rows = [f"{t:.6f},0.3,{w:.6f}" for t, w in zip(times_s, rates, strict=True)]
    path.write_text("\n".join(["time_s,v_m_s,w_rad_s", *rows]) + "\n")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A video that starts at 0 s, and motion by a Unix clock that starts 1.3 s before it."""
    home = tmp_path_factory.mktemp("drive")
    early = 26
    rates = turn_rates(0, N + early)
    film(home / "drive.avi", rates[early:])
    log(home / "motion.csv", EPOCH_S + np.arange(N + early) / RATE_HZ, rates)
    return home, -EPOCH_S - early / RATE_HZ


def find_offset(spec, config):
    return find_joint_start(spec, config).offset


def pair(home, motion="motion.csv"):
    return f"{home}/drive.avi+{home}/{motion}"


def test_the_offset_is_found_by_the_turn_rates(drive):
    home, true_s = drive
    found = find_offset(pair(home), BrainConfig())
    assert found.offset_s == pytest.approx(true_s, abs=0.01)
    assert found.correlation > 0.9
    swapped = f"{home}/motion.csv+{home}/drive.avi"
    assert find_offset(swapped, BrainConfig()).offset_s == pytest.approx(true_s, abs=0.01)


def test_the_scale_of_turns_is_that_of_the_field_of_view(drive):
    start = find_joint_start(pair(drive[0]), BrainConfig())
    true_deg = np.degrees(96 / 40)  # a picture of 96 columns, each 1 / 40 rad
    assert BrainConfig().odometry.fov_deg / start.turn_scale == pytest.approx(true_deg, rel=0.05)
    assert start.compass is None
    _, notes = resolve_offset(pair(drive[0]), "auto", BrainConfig())
    assert any("odometry.fov_deg" in note for note in notes)


class WithCompass(Source):
    """A source of motion with a compass."""

    name, n_frames, frame_rate_hz = "motion with a compass", None, RATE_HZ

    def __init__(self, motion, headings_rad):
        self.motion, self.headings_rad = motion, headings_rad

    def frames(self, start=0, stop=None, on_bad_frame=None):
        for frame in self.motion.frames(start, stop, on_bad_frame):
            yield frame._replace(heading_rad=float(self.headings_rad[frame.index]))


def test_a_compass_that_lags_is_found_by_its_turns(drive):
    home, true_s = drive
    rates = turn_rates(0, N + 26)
    times_s = np.arange(len(rates)) / RATE_HZ
    heading = 2.0 + np.interp(times_s - 0.15, times_s, np.cumsum(rates) / RATE_HZ)
    heading += np.radians(0.3) * np.random.default_rng(4).standard_normal(len(heading))
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    motion = WithCompass(open_source(home / "motion.csv"), wrapped)
    found = joint_start(open_source(home / "drive.avi"), motion, BrainConfig())
    assert found.offset.offset_s == pytest.approx(true_s, abs=0.01)
    assert found.compass.offset_s == pytest.approx(-0.15, abs=0.03)


def test_scales_average_noise_of_the_camera_and_are_unknown_without_motion():
    t, rng = np.arange(0.0, 120.0, 0.05), np.random.default_rng(1)
    turned, moved = 0.05 * turn_rates(3, len(t) - 1), rng.uniform(0.0, 0.03, len(t) - 1)
    noisy = 1.3 * turned + 0.005 * rng.standard_normal(len(turned))
    seen, measured = Turns(t, noisy, 40.0 * moved), Turns(t + 7.0, turned, moved)
    assert scale_of(seen, measured, -7.0) == pytest.approx(1.3, rel=0.02)
    assert scale_of(seen, measured, -7.0, "moved_m") == pytest.approx(40.0, rel=1e-6)
    still = Turns(t, np.zeros_like(turned))
    assert np.isnan(scale_of(seen, still, 0.0))
    assert np.isnan(scale_of(still, measured, -7.0, "moved_m"))  # no distances
    assert np.isnan(scale_of(seen, measured, 500.0))


@pytest.mark.parametrize("late_s", [-3.21, 0.0, 0.017, 4.5])
def test_an_offset_within_a_period_is_found_at_another_rate(drive, tmp_path, late_s):
    home, true_s = drive
    source = open_source(home / "motion.csv")
    times_s = np.array([frame.time_s for frame in source])
    rates = np.array([frame.velocity.w_rad_s for frame in source])
    fine_s = np.arange(times_s[0], times_s[-1], 0.01)  # 100 Hz: the rate holds until its time
    at = np.searchsorted(times_s, fine_s)
    log(tmp_path / "fine.csv", fine_s + late_s, rates[at])
    found = find_offset(f"{home}/drive.avi+{tmp_path}/fine.csv", BrainConfig())
    assert found.offset_s == pytest.approx(true_s - late_s, abs=0.012)


def test_a_real_cars_video_and_its_motion_by_another_clock_are_aligned(shared, tmp_path):
    folder = shared / "data" / "circuit_launch"
    motion = np.array([f.velocity for f in open_source(folder / "odometry_vo.csv")])[100:700]
    log(tmp_path / "m.csv", EPOCH_S + 0.123 + np.arange(100, 700) / 20.0, motion[:, 1])
    found = find_offset(f"{folder}/video.avi+{tmp_path}/m.csv", BrainConfig())
    assert found.offset_s == pytest.approx(-EPOCH_S - 0.123, abs=0.005)


def test_a_run_with_an_offset_pairs_images_and_motion_and_can_be_read_again(drive, tmp_path, call):
    home, _ = drive
    done = call("run", pair(home), "--offset", "auto", "-o", tmp_path, "--no-tensorboard")
    assert (done.code, done.err) == (0, "")
    assert "added to the times of the motion; the turn rates correlate by 0.9" in done.out
    assert "offset -1700000001." in done.out  # in full, not as 1.7e+09
    source = read_plan(tmp_path).source
    assert source.startswith(f"{home}/drive.avi+{home}/motion.csv?offset=-17000000")
    assert sum(frame.image is not None for frame in open_source(source)) == N
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["measured_motion"] is True
    assert metrics["frames"] >= N
    again = call("report", tmp_path)
    assert again.code == 0


def test_a_given_offset_moves_the_motion(drive, tmp_path, call):
    home, true_s = drive
    out = tmp_path / "m"
    args = ("run", pair(home), "-o", out, "--no-tensorboard", "--stop", 5)
    done = call(*args, "--offset", repr(true_s))
    assert done.code == 0
    assert read_plan(out).source == f"{pair(home)}?offset={true_s!r}"
    assert f"{true_s:.2f}".rstrip("0") + " s are added to its times" in done.out


def test_clocks_without_an_overlap_say_what_to_do_with_times_in_full(drive, tmp_path, mistake):
    home, _ = drive
    said = mistake("run", pair(home), "-o", tmp_path / "m")
    assert "drive.avi runs from 0 s to 12 s" in said
    assert "motion.csv runs from 1700000000 s to 1700000013.25 s" in said
    assert (
        "give --offset S, the seconds to add to the times of the motion, or --offset auto" in said
    )


def test_turn_rates_that_do_not_agree_are_refused(drive, tmp_path, mistake):
    home, _ = drive
    log(tmp_path / "other.csv", np.arange(N) / RATE_HZ, turn_rates(5))
    said = mistake("run", f"{home}/drive.avi+{tmp_path}/other.csv", "--offset", "auto",
                   "-o", tmp_path / "m")  # fmt: skip
    assert "the turn rates of camera and motion do not agree at any offset" in said
    assert "give --offset S in seconds" in said
    log(tmp_path / "straight.csv", np.arange(N) / RATE_HZ, np.zeros(N))
    with pytest.raises(RunError, match="one of the two does not turn"):
        find_offset(f"{home}/drive.avi+{tmp_path}/straight.csv", BrainConfig())


def test_turns_of_the_wrong_sign_are_named():
    times_s, turned = np.arange(N) / RATE_HZ, turn_rates(0)[1:]
    with pytest.raises(ValueError, match=r"one has the wrong sign; expected positive .* left"):
        best_offset(Turns(times_s, turned), Turns(times_s, -turned))


def test_laps_that_are_all_alike_have_no_single_offset():
    times_s = np.arange(2400) / RATE_HZ
    turned = np.tile(turn_rates(1, 100), 24)[1:]
    with pytest.raises(ValueError, match="agree at more than one offset, "):
        best_offset(Turns(times_s, turned), Turns(times_s, turned))


def test_one_wrong_time_takes_no_memory():
    times_s, turned = np.arange(N) / RATE_HZ, turn_rates(0)[1:]
    wrong = Turns(np.append(times_s[:-1], 1e12), turned)
    with pytest.raises(ValueError, match=r"span 1000000000000 s, expected at most 100000 s"):
        best_offset(Turns(times_s, turned), wrong)


@pytest.mark.parametrize(
    ("offset", "words"),
    [("soon", "expected a number of seconds, or auto"), ("inf", "expected a number of seconds")],
)
def test_an_offset_that_is_no_number_is_refused(drive, offset, words):
    with pytest.raises(SourceError, match=words):
        resolve_offset(pair(drive[0]), offset, BrainConfig())


def test_an_offset_needs_two_sources_and_is_given_once(drive):
    home, _ = drive
    with pytest.raises(SourceError, match="expected a camera and motion as drive"):
        resolve_offset(f"{home}/drive.avi", "1", BrainConfig())
    twice = with_offset(pair(home), 1.0)
    with pytest.raises(SourceError, match="has an offset already"):
        resolve_offset(twice, "2", BrainConfig())
    with pytest.raises(SourceError, match="offset is 'x'; expected a number of seconds"):
        open_source(pair(home) + "?offset=x")


def test_the_offset_stays_in_the_name_of_the_source(drive, monkeypatch):
    home, _ = drive
    monkeypatch.chdir(home)
    short = "drive.avi+motion.csv?offset=-2.5"
    assert absolute_spec(short) == f"{pair(home)}?offset=-2.5"
    assert seeded_spec(short, 3) == short
    rendered = "world:corridor?laps=1+world:corridor?laps=1&odometry=true&offset=2"
    assert seeded_spec(rendered, 3).endswith("odometry=true&seed=3&offset=2")
