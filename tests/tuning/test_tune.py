"""Tuning finds the parameters of a drive in the drive itself, and reports where it cannot."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from neuroslam.brain import NavigationBrain
from neuroslam.cli import main
from neuroslam.config import BrainConfig, build_config, read_config_file, read_preset
from neuroslam.errors import BadFrame, RunError, SourceError
from neuroslam.figures.style import render
from neuroslam.figures.tuning import plot_tuning
from neuroslam.sensors import open_source
from neuroslam.tuning import tune
from neuroslam.tuning.drive import key_frames, read_drive
from neuroslam.tuning.motion import FIELDS_OF_VIEW_DEG, Shifts, field_of_view, measure_shifts
from neuroslam.tuning.revisits import Revisits, find_revisits
from neuroslam.tuning.search import Trial, best_of, score_map
from neuroslam.view.preprocess import Encoded

SMALL = "world:ellipse?laps=1.4&width=64&height=32&rate=10"
PICTURES = SMALL + "&odometry=false&frames_per_lap=240"


@pytest.fixture(scope="module")
def drive():
    return read_drive(open_source(SMALL))


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    out = tmp_path_factory.mktemp("tuned")
    return tune(PICTURES, out / "tuning"), out / "tuning"


def test_revisits_are_frames_one_lap_apart(drive):
    keys = key_frames(drive)
    truth = np.array([frame.truth[:2] for frame in drive.frames])[keys]
    revisits = find_revisits(drive.pictures[keys])
    assert len(revisits.same) > 0.4 * len(keys)
    apart = np.linalg.norm(truth[revisits.same[:, 0]] - truth[revisits.same[:, 1]], axis=1)
    assert np.quantile(apart, 0.99) < 0.5  # of an ellipse of many metres
    others = np.linalg.norm(truth[revisits.other[:, 0]] - truth[revisits.other[:, 1]], axis=1)
    assert np.median(others) > 5.0


def test_a_picture_that_a_network_cannot_use_is_left_out(drive):
    seen = []

    def encoder(picture):
        seen.append(picture)
        if len(seen) == 50:
            raise BadFrame("features are not all finite numbers")
        return Encoded(np.zeros((4, 8)), 1.0)

    encoded = read_drive(open_source(SMALL), encoder=encoder)
    assert (len(encoded.frames), encoded.unusable) == (len(drive.frames) - 1, 1)
    with pytest.raises(ValueError, match="read without an encoder"):
        drive.templates(np.array([0]))


def test_a_robot_at_rest_gives_no_key_frames(drive):
    still = [drive.frames[50]._replace(index=1000 + k, time_s=1000.0 + k) for k in range(60)]
    paused = replace(drive, frames=drive.frames + still)
    assert len(drive.frames) - len(key_frames(drive)) < 10
    assert key_frames(paused).max() <= len(drive.frames)


@given(st.floats(60.0, 140.0), st.integers(0, 5))
def test_the_field_of_view_is_the_one_that_closes_loops(fov_deg, seed):
    turns = np.random.default_rng(seed).uniform(0.5, 1.5, 400)
    turned = np.cumsum(turns) * (5 * 2 * math.pi / turns.sum())  # five laps
    shift_px = np.diff(turned, prepend=0.0) / math.radians(fov_deg) * 160
    angle = turned % (2 * math.pi)
    first = np.searchsorted(turned, angle[200:]).clip(max=199)
    pairs = np.stack([first, np.arange(200, 400)], axis=1)
    found = field_of_view(Shifts((0, 160, 0, 60), shift_px, shift_px * 0), 160, pairs)
    assert found.fov_deg == pytest.approx(fov_deg, abs=2.0)
    assert found.error.shape == FIELDS_OF_VIEW_DEG.shape


def test_a_figure_of_eight_does_not_determine_the_field_of_view():
    shift_px = np.r_[np.full(100, 2.0), np.full(100, -2.0)]
    pairs = np.array([[0, 199], [1, 199]])
    assert field_of_view(Shifts((0, 9, 0, 9), shift_px, shift_px), 160, pairs) is None


@pytest.mark.parametrize(
    ("before", "found", "verdict"),
    [
        (0.4, 0.05, "more consistent than before, 3 experiences fewer: use the config found"),
        (0.019, 0.022, "about as consistent as before, 3 experiences fewer"),
        (0.02, 0.2, "less consistent than before, 3 experiences fewer: keep the config you had"),
        (0.02, math.nan, "not known to be better: the drive has no revisits to measure it"),
    ],
)
def test_the_verdict_compares_the_maps_before_and_after(before, found, verdict, tuned):
    maps = [Trial(BrainConfig(), j, n, n, n, None) for j, n in ((before, 10), (found, 7))]
    assert replace(tuned[0], before=maps[0], after=maps[1]).verdict == verdict


class Mapped:
    """The parts of a brain that :func:`score_map` reads."""

    def __init__(self, poses):
        self.map = type("Map", (), {"poses": poses, "n": len(poses), "n_links": len(poses)})
        self.view = type("View", (), {"n": len(poses)})


def ring(n, laps):
    angle = np.linspace(0.0, laps * 2 * math.pi, n, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), angle], axis=1)


def test_a_closed_map_is_consistent_and_a_collapsed_or_open_map_is_not():
    none, n = np.empty((0, 0)), 200
    same = np.stack([np.arange(100), np.arange(100, 200)], axis=1)
    other = np.stack([np.arange(100), (np.arange(100) + 150) % 200], axis=1)
    pairs = Revisits(none, 0.0, 0.0, 1, same, other)
    experiences, keys = {k: k for k in range(n)}, np.arange(n)

    def inconsistency(poses):
        return score_map(BrainConfig(), Mapped(poses), experiences, keys, pairs).inconsistency

    generator = np.random.default_rng(0)
    closed = ring(n, 2)
    straight = np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1).astype(float)
    noisy = 7.0 * closed + generator.normal(0, 0.1, closed.shape)
    assert inconsistency(closed) == pytest.approx(0.0, abs=1e-9)
    assert inconsistency(noisy) < 0.1  # at any scale
    assert inconsistency(generator.normal(0, 1, closed.shape)) == pytest.approx(1.0, abs=0.2)
    assert inconsistency(np.zeros_like(closed)) == 1.0
    assert inconsistency(straight) >= 1.0


def test_the_smallest_of_equally_consistent_maps_is_chosen():
    def trial(inconsistency, experiences):
        return Trial(BrainConfig(), inconsistency, 0, experiences, 0, np.zeros((1, 2)))

    assert best_of([trial(0.040, 900), trial(0.043, 500), trial(0.2, 100)]).n_experiences == 500
    assert best_of([trial(0.001, 900), trial(0.005, 500)]).n_experiences == 500


def test_the_map_improves_and_run_accepts_the_config(tuned, tmp_path):
    tuning, out = tuned
    assert tuning.after.inconsistency < 0.03
    assert tuning.after.inconsistency < tuning.before.inconsistency + 0.005
    assert build_config(read_config_file(out / "config.toml")) == tuning.config
    written = json.loads((out / "tune.json").read_text())
    assert written["after"]["inconsistency"] == tuning.after.inconsistency
    changed = {change["key"] for change in written["changes"]}
    assert changed >= {"view.threshold", "odometry.fov_deg"}
    assert (out / "tune.png").stat().st_size > 20_000
    arguments = ["run", PICTURES, "--config", str(out / "config.toml"), "--no-tensorboard"]
    assert main([*arguments, "--stop", "40", "-o", str(tmp_path / "run")]) == 0


def test_the_map_found_is_aligned_with_the_map_before_and_numbers_are_plain(tuned):
    tuning, _ = tuned
    onto = tuning.before.track_xy
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    found = replace(tuning, after=tuning.after._replace(track_xy=1.5 * onto @ turn))
    figure = plot_tuning(found, "drive.avi")
    _, templates, _, maps, before, after = figure.get_axes()
    tracks = [axes.get_lines()[0].get_xydata() for axes in (before, after)]
    np.testing.assert_allclose(tracks[1], 1.5 * tracks[0], atol=1e-9)
    assert after.get_xlabel() == "x (arbitrary unit), aligned to the map before"
    scores = {f"{score.average_precision:.3f}" for score in tuning.views}
    assert {text.get_text() for text in templates.texts} <= scores
    render(figure)
    ticks = [text.get_text() for text in maps.get_yticklabels()]
    assert len(ticks) > 1
    assert all(re.fullmatch(r"[\d.]+", tick) for tick in ticks)


def test_without_revisits_empty_panels_have_no_axes(tuned):
    tuning, _ = tuned
    none = tuning.revisits._replace(same=np.empty((0, 2), np.int64))
    figure = plot_tuning(replace(tuning, revisits=none, motion=None, trials=[]), "drive.avi")
    for panel in (1, 2, 3):
        axes = figure.get_axes()[panel]
        assert (len(axes.get_xticks()), len(axes.get_yticks())) == (0, 0)
        assert len(axes.texts) == 1


def test_the_field_of_view_of_a_rendered_camera_is_found():
    # Odometry assumes equal angles per pixel. A lens of 90° without distortion has 1.57 rad over
    # its width, but the pixels in its middle are those of 2 rad (115°): the estimate is between the
    # two, or a little off, as turns are measured in whole pixels.
    drive = read_drive(open_source("world:corridor?laps=2.2"))
    keys = key_frames(drive)
    shifts = measure_shifts(drive.pictures, drive.region(0, 1, 0, 0.5), 40)
    found = field_of_view(shifts, 160, keys[find_revisits(drive.pictures[keys]).same])
    assert 86.0 <= found.fov_deg <= 118.0
    assert found.error.min() < 0.05


def test_tuning_twice_gives_the_same_config(tuned, tmp_path):
    tune(PICTURES, tmp_path / "again")
    for name in ("config.toml", "tune.json"):
        assert (tmp_path / "again" / name).read_bytes() == (tuned[1] / name).read_bytes()


def test_views_by_a_network_are_tuned_too_and_the_run_gives_the_map_of_the_search(tmp_path):
    """Each frame is encoded once; the search uses the templates of a brain with the network."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Sequential(nn.Conv2d(3, 16, 5, 2, 2), nn.ReLU(), nn.Conv2d(16, 16, 3, 2, 1))
    calls = []
    network.register_forward_hook(lambda *_: calls.append(1))
    size = {"template_width": 16, "template_height": 32, "shift_match": 2}
    config = BrainConfig(view={"features": "module"} | size, max_gap_s=1e9)
    tuning = tune(PICTURES, tmp_path / "out", config, features=network)
    assert len(calls) == 337
    assert tuning.after.inconsistency < 0.03
    assert tuning.after.inconsistency < tuning.before.inconsistency + 0.005
    assert [score.config.features for score in tuning.views] == ["module", "grey"]
    assert tuning.config.view.features == "module"
    assert tuning.config.view.template_width == 16
    brain = NavigationBrain(tuning.config, features=network)
    for frame in open_source(PICTURES).frames():
        brain(frame)
    assert (brain.view.n, brain.map.n) == (tuning.after.n_templates, tuning.after.n_experiences)


def test_a_drive_without_revisits_is_reported(tmp_path):
    tuning = tune("world:corridor?laps=0.4&width=96&height=48", tmp_path / "out")
    assert "drive the same route twice" in " ".join(tuning.notes)
    assert [key for key in tuning.changes if key.startswith("view")] == ["view.threshold"]
    assert tuning.config.view.crop is None
    assert math.isnan(tuning.after.inconsistency)
    assert (
        json.loads((tmp_path / "out" / "tune.json").read_text())["after"]["inconsistency"] is None
    )


def test_a_picture_that_never_changes_is_one_line(drive):
    same = [frame._replace(image=drive.frames[0].image) for frame in drive.frames]
    with pytest.raises(SourceError, match="only 0 of 561 pictures differ"):
        key_frames(replace(drive, frames=same))


def test_a_camera_at_rest_has_hardly_any_revisits(drive):
    noise = np.random.default_rng(0).integers(0, 3, (120, *drive.shape))
    pictures = drive.frames[0].image + noise.astype(np.uint8)
    revisits = find_revisits(pictures)
    assert len(revisits.same) < 30
    assert len(revisits.other) > 0


def test_regions_are_in_pixels_of_the_source():
    drive = read_drive(open_source("world:ellipse?laps=0.3&width=480&height=240"))
    assert (drive.factor, drive.size, drive.frames[0].image.shape) == (3, (480, 240), (80, 160))
    region = drive.region(0, 1, 0, 0.5)
    assert drive.shape == (80, 160)
    assert drive.to_source(region) == (0, 480, 0, 120)
    assert drive.to_reduced(drive.to_source(region)) == region


def test_input_that_cannot_be_tuned_is_refused_in_one_line(tmp_path, capsys):
    with pytest.raises(SourceError, match="20 frames with a picture; tuning needs 100"):
        tune("world:ellipse?width=64&height=32", tmp_path / "a", stop=20)
    with pytest.raises(RunError, match="expected pose"):
        tune("world:ellipse", tmp_path / "a", build_config(read_preset("slrb")))
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="is a file"):
        tune("world:ellipse", tmp_path / "file")
    (tmp_path / "config.toml").write_text("")
    assert main(["tune", "world:ellipse", "-o", str(tmp_path)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(("name", "frames_a_lap"), [("circuit_launch", 490)])
def test_a_real_track_closes_from_the_defaults(shared, tmp_path, name, frames_a_lap):
    source = shared / "data" / name / "frames.tar"
    if not source.exists():
        pytest.skip(f"no {name} beside the checkout")
    tuning = tune(source, tmp_path / "out", stop=1250)  # two laps and a half
    apart = np.abs(np.diff(tuning.keys[tuning.revisits.same], axis=1)) / frames_a_lap
    assert np.quantile(np.abs(apart - np.rint(apart)), 0.95) < 0.1  # whole laps
    assert tuning.after.inconsistency < 0.03
    x, y = tuning.after.track_xy.T
    lap = np.abs(x[:-frames_a_lap] - x[frames_a_lap:]) + np.abs(
        y[:-frames_a_lap] - y[frames_a_lap:]
    )
    assert np.median(lap) < 0.1 * (np.ptp(x) + np.ptp(y))
    assert tuning.config.odometry.fov_deg == pytest.approx(115.0, abs=12.0)
