"""All methods on the same drives."""

import json

import numpy as np
import pytest

from neuroslam.experiments.compare import (
    LANDMARKS,
    LOSSES,
    METHODS,
    SENSES,
    compare,
    config_of,
    pixel_landmarks,
    run_brain,
)
from neuroslam.figures.comparison import plot_losses
from neuroslam.figures.style import render
from neuroslam.sensors import open_source


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("compare")
    methods = ["RatSLAM", "SLRB", "full"]
    with pytest.MonkeyPatch.context() as patch:  # six laps, here short, with a failing sensor
        quick = f"{SENSES}&frames_per_lap=50&width=64&height=40"
        patch.setattr("neuroslam.experiments.compare.SENSES", quick)
        written = compare(
            None, out, ["corridor"], [0], laps=1, methods=methods, losses=["nothing is lost"]
        )
    return written, out


def test_each_method_has_a_row_with_its_error_and_cost(results):
    written, out = results
    assert json.loads((out / "results.json").read_text())["rows"] == written["rows"]
    assert [row["method"] for row in written["rows"]] == [
        "odometry alone",
        "RatSLAM",
        "SLRB",
        "full",
    ]
    assert all(0.0 <= row["ate_m"] < 1.0 for row in written["rows"])
    assert all(row["cpu_ms"] > 0 and row["places"] > 0 for row in written["rows"][1:])
    for name in ("comparison.png", "losses.png"):
        assert (out / name).stat().st_size > 10_000


def test_errors_with_a_failing_sensor_are_of_the_whole_drive_and_of_the_last_lap(results):
    for row in results[0]["losses"]:
        assert row["ate_last_lap_m"] <= row["largest_error_m"]
        assert row["ate_m"] <= row["largest_error_m"]


def test_errors_over_time_are_written_as_decimals():
    curves = {"nothing is lost": {"full": np.array([0.02, 0.3, 9.0, 40.0])}}
    figure = plot_losses(curves, LOSSES)
    render(figure)
    ticks = [text.get_text() for text in figure.get_axes()[0].get_yticklabels()]
    assert {"0.1", "1", "10"} <= set(ticks) <= {"0.001", "0.01", "0.1", "1", "10", "100"}


def test_methods_are_what_their_names_say():
    cells = {name: config_of(name).cells for name in METHODS}
    assert cells["RatSLAM"] == ("pose",)
    assert cells["full"] == ("pose", "place", "semantic")
    assert config_of("SSP-SLAM, spikes").semantic.tier == "spiking"
    assert not config_of("competitive Hebb").wall_memory.corrects
    with pytest.raises(KeyError):
        config_of("EKF")


def test_a_drive_without_a_camera_for_a_while_still_closes_its_loop():
    spec = "world:corridor?width=64&height=40&frames_per_lap=120&noise=0.05&compass_deg=3&laps=2"
    more = "&ranges=36&markers=12&landmark_reach=6&dark=6-14"
    dark = run_brain(config_of("full"), list(open_source(spec + more)))
    assert dark.ate_m < 0.5
    blind = run_brain(config_of("RatSLAM"), list(open_source(spec + more)))
    assert dark.ate_m < blind.ate_m


@pytest.mark.parametrize("loss", LOSSES)
def test_a_failing_sensor_is_absent_from_the_frames(loss):
    spec = "world:corridor?laps=6&width=32&height=16&ranges=8&" + LOSSES[loss]
    source = open_source(spec)
    before, during = source.frame(650), source.frame(1010)
    after = source.frame(1310)
    if "dark" in loss:
        assert during.image.max() == 0
        assert after.image.max() > 0
    if "ranges" in loss:
        assert during.ranges is None
        assert after.ranges is not None
    if "kidnapped" in loss:
        jump = np.hypot(*(np.array(source.truth(1000)[:2]) - np.array(source.truth(999)[:2])))
        assert jump > 5.0
        assert source.odometry()[1000, 0] == pytest.approx(source.odometry()[998, 0], rel=1e-6)
    assert before.image.max() > 0


def test_markers_in_pictures_are_landmarks_like_those_of_a_sensor(tmp_path):
    rows = pixel_landmarks(None, tmp_path, seeds=[0], laps=0.15)["rows"]
    assert {row["landmarks"] for row in rows} == set(LANDMARKS)
    assert all(0.0 <= row["ate_m"] < 0.5 for row in rows)
