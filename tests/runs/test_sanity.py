"""Impossible units and jumps are told in a line with the number; one camera has no metres."""

import numpy as np
import pytest

from neuroslam.config import BrainConfig
from neuroslam.runs.sanity import is_animal, unit_warnings

N, DT_S = 200, 0.1


def trace(speed=0.5, rate=0.1, truth=None):
    speed = np.broadcast_to(np.asarray(speed, float), N)
    rate = np.broadcast_to(np.asarray(rate, float), N)
    x = np.full(N, np.nan) if truth is None else np.asarray(truth, float)
    known = np.where(np.isfinite(x), 0.0, np.nan)
    return {
        "time_s": DT_S * np.arange(N), "dt_s": np.full(N, DT_S), "v_m_s": speed,
        "w_rad_s": rate, "truth_x_m": x, "truth_y_m": known,
    }  # fmt: skip


def jumping(height, at=50):
    speed = np.full(N, 0.5)
    speed[at] = height
    return speed


@pytest.mark.parametrize("speed", [0.0, 0.5, 2.0, -1.0])
def test_plausible_motion_needs_no_word(speed):
    for animal in (True, False):
        assert unit_warnings(trace(speed), animal) == []
    assert unit_warnings(trace(30.0), animal=False) == []  # a car
    assert unit_warnings(trace(0.5, truth=0.05 * np.arange(N)), animal=False) == []


@pytest.mark.parametrize(
    ("given", "animal", "says"),
    [
        (trace(20.0), True, "speeds of 20 m/s (median 20 m/s), above 3 m/s in 200 frames"),
        (trace(80.0), False, "speeds of 80 m/s (median 80 m/s), above 50 m/s in 200 frames"),
        (trace(jumping(12.0)), True, "1 jump in the motion, the largest 1.2 m within 0.1 s"),
        (trace(jumping(300.0)), False, "(300 m/s) at 5 s; the median speed is 0.5 m/s"),
        (trace(rate=28.6), False, "turn rates of 28.6 rad/s; expected at most 10 rad/s"),
        (
            trace(truth=5.0 * np.arange(N)), False,
            "the motion covers 9.95 m, the truth 995 m: is the truth in centimetres?",
        ),
        (
            trace(0.5, truth=5e-4 * np.arange(N)), False,
            "the motion covers 9.95 m, the truth 0.0995 m: is the motion in centimetres?",
        ),
    ],
)  # fmt: skip
def test_what_is_impossible_is_one_line_with_its_number(given, animal, says):
    (warning,) = unit_warnings(given, animal)
    assert says in warning
    assert "\n" not in warning


def test_an_animal_is_known_by_its_source_or_by_its_cells():
    place = BrainConfig(cells=("place",))
    assert is_animal("motion.csv", place)
    assert is_animal("arena:square?laps=1", BrainConfig())
    assert is_animal("/data/RAT.NPZ", BrainConfig())
    assert not is_animal("motion.csv", BrainConfig())


def test_a_run_prints_its_warnings_and_keeps_them(tmp_path, call):
    motion = tmp_path / "motion.csv"
    motion.write_text("v_m_s,w_rad_s\n" + "25,0.5\n" * 60)  # a rat in cm/s
    done = call("run", motion, "-o", tmp_path / "m", "--preset", "slrb", "--no-tensorboard")
    assert "neuroslam run: warning: speeds of 25 m/s (median 25 m/s), above 3 m/s" in done.err
    assert '"warnings": [\n    "speeds of 25 m/s' in (tmp_path / "m" / "metrics.json").read_text()


def test_a_track_in_centimetres_is_told(tmp_path, call):
    angle = np.linspace(0, 6, 200)
    track = 40.0 * np.column_stack([np.cos(angle), np.sin(angle)])  # cm
    np.savez(tmp_path / "rat.npz", pos=track, t=0.05 * np.arange(200))
    done = call("run", tmp_path / "rat.npz", "-o", tmp_path / "m", "--no-tensorboard")
    assert "warning: speeds of 24.1 m/s" in done.err
    assert "are they in centimetres?" in done.err


def test_one_camera_alone_has_an_arbitrary_unit_everywhere(tmp_path, call):
    world = "world:corridor?width=64&height=40&frames_per_lap=60&laps=1&odometry=false"
    camera, wheels = tmp_path / "camera", tmp_path / "wheels"
    alone = call("run", world, "-o", camera, "--no-tensorboard", "--stop", "40")
    assert "ATE (rigid): map" in alone.out
    assert alone.out.count("arbitrary unit") >= 1
    assert call("run", world.replace("false", "true"), "-o", wheels, "--no-tensorboard").code == 0
    assert "arbitrary unit" in call("inspect", camera).out
    assert "arbitrary unit" not in call("inspect", wheels).out
    planned = call("plan", camera, "0").out.splitlines()[0]
    assert "arbitrary unit" in planned
    assert " m," not in planned
    assert "warning" not in alone.err


def test_times_in_days_are_told_by_their_step():
    days = trace() | {"dt_s": np.full(N, DT_S / 86400.0)}
    (line,) = unit_warnings(days, animal=False)
    assert line.startswith("times advance by 1.16e-06 s a frame; expected at least 0.0001 s")
