import io
import math

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.runs.recording import (
    NullRecorder,
    TensorBoardRecorder,
    coloured,
    frame_beside_template,
)
from neuroslam.sensors import open_source
from neuroslam.types import Frame, Velocity

N = 25


def drive(recorder, n=N):
    """A short drive that sees a new place every third frame."""
    brain = NavigationBrain(BrainConfig())
    results = []
    with recorder:
        for i in range(n):
            coarse = np.random.default_rng(i // 3).integers(0, 255, (6, 8, 3), np.uint8)
            image = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_NEAREST)
            frame = Frame(i, 0.1 * i, image, Velocity(1.0, 0.1))
            result = brain(frame)
            recorder.step(result, frame, brain)
            results.append((result, brain.pose_cells.peak, image))
    return results, brain


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("events")
    recorder = TensorBoardRecorder(folder, scalars_every=5, images_every=10, maps_every=20)
    results, brain = drive(recorder)
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    events.Reload()
    return folder, events, results, brain


def pixels(event):
    return np.asarray(Image.open(io.BytesIO(event.encoded_image_string)))


@pytest.mark.parametrize(
    ("tag", "value"),
    [
        ("view/templates", lambda result, peak: result.n_templates),
        ("map/experiences", lambda result, peak: result.n_experiences),
        ("map/links", lambda result, peak: result.n_links),
        ("cells/peak", lambda result, peak: peak),
    ],
)
def test_curves_hold_what_the_brain_said_every_fifth_frame(recorded, tag, value):
    _, events, results, _ = recorded
    points = events.Scalars(tag)
    assert [point.step for point in points] == [0, 5, 10, 15, 20]
    for point in points:
        result, peak, _ = results[point.step]
        assert point.value == pytest.approx(value(result, peak), rel=1e-6)


def test_a_frame_that_was_not_compared_leaves_a_gap_in_the_match_error(recorded):
    _, events, results, _ = recorded
    points = events.Scalars("view/match_error")
    assert [point.step for point in points] == [5, 10, 15, 20]
    for point in points:
        assert point.value == pytest.approx(results[point.step][0].view.error, rel=1e-6)


def test_the_residual_of_the_map_and_the_speed_are_curves_too(recorded):
    _, events, _, _ = recorded
    assert len(events.Scalars("map/largest_correction")) == 5
    assert all(point.value > 0 for point in events.Scalars("run/frames_per_s"))


def test_pictures_are_large_enough_to_see_and_show_the_frame(recorded):
    _, events, results, _ = recorded
    views = events.Images("view/frame_and_template")
    assert [view.step for view in views] == [0, 10, 20]
    shown = pixels(views[1])
    assert shown.shape == (240 + 8 + 53, 320, 3)
    np.testing.assert_array_equal(shown[:240:2, ::2], results[10][2])
    cells = events.Images("cells/activity")
    assert [(cell.step, cell.height, cell.width) for cell in cells] == [
        (0, 210, 428),
        (10, 210, 428),
        (20, 210, 428),
    ]


def test_the_map_is_drawn_now_and_then_and_once_more_at_the_end(recorded):
    _, events, _, _ = recorded
    maps = events.Images("map/experiences_and_links")
    assert [drawn.step for drawn in maps] == [20, 24]
    assert min(pixels(maps[-1]).shape[:2]) >= 500


def test_templates_are_in_the_projector_with_a_sprite(recorded):
    folder, _, _, brain = recorded
    config = (folder / "projector_config.pbtxt").read_text()
    assert "00024/templates/tensors.tsv" in config
    matrix = np.loadtxt(folder / "00024/templates/tensors.tsv", delimiter="\t")
    assert matrix.shape == (9, 600)
    np.testing.assert_array_equal(matrix[4], brain.view.template_image(4).ravel())
    names = (folder / "00024/templates/metadata.tsv").read_text().splitlines()
    assert names == [f"template {i}" for i in range(9)]
    with Image.open(folder / "00024/templates/sprite.png") as sprite:
        assert sprite.size == (3 * 48, 3 * 48)


def test_of_many_templates_the_projector_gets_an_even_choice(tmp_path):
    drive(TensorBoardRecorder(tmp_path, projected=3))
    names = (tmp_path / "00024/templates/metadata.tsv").read_text().split("\n")
    assert names[:3] == ["template 0", "template 4", "template 8"]


def test_panels_can_be_seen_while_a_run_goes_on(tmp_path):
    over = {"wall_memory": {"senses": "boundary_cells"}, "place_cells": {"excitation": 0.5}}
    brain = NavigationBrain(build_config(merge_values(read_preset("slrb"), over)))
    with TensorBoardRecorder(tmp_path, panels_share=math.inf) as recorder:
        for frame in open_source("arena:square?minutes=0.2&noise=1&ranges=60").frames(0, 120):
            recorder.step(brain(frame), frame, brain)
        events = EventAccumulator(str(tmp_path), size_guidance={"images": 0})
        events.Reload()
        images = {tag: events.Images(tag) for tag in events.Tags()["images"]}
    assert set(images) == {
        "map/experiences_and_links", "cells/place_map", "cells/place_bump", "cells/boundary_cells",
    }  # fmt: skip
    assert all([drawn.step for drawn in each] == [50, 100] for each in images.values())
    for tag in ("cells/place_bump", "cells/boundary_cells"):
        assert pixels(images[tag][-1]).std() > 10.0


def test_panels_wait_until_a_run_is_long_enough_for_them(tmp_path):
    brain = NavigationBrain(build_config(read_preset("slrb")))
    with TensorBoardRecorder(tmp_path) as recorder:
        for frame in open_source("arena:square?minutes=0.1&noise=1").frames(0, 110):
            recorder.step(brain(frame), frame, brain)
    events = EventAccumulator(str(tmp_path), size_guidance={"images": 0})
    events.Reload()
    assert [drawn.step for drawn in events.Images("cells/place_map")] == [109]  # at the end
    assert [drawn.step for drawn in events.Images("map/experiences_and_links")] == [50, 100, 109]


def test_a_brain_of_boundary_grid_and_place_cells_is_recorded_too(tmp_path):
    brain = NavigationBrain(build_config(read_preset("slrb")))
    with TensorBoardRecorder(tmp_path) as recorder:
        for frame in open_source("arena:square?minutes=1&noise=1"):
            recorder.step(brain(frame), frame, brain)
    events = EventAccumulator(str(tmp_path), size_guidance={"images": 0})
    events.Reload()
    tags = events.Tags()
    assert set(tags["images"]) == {
        "map/experiences_and_links",
        "cells/place_map",
        "cells/place_bump",
        "cells/boundary_cells",
        "cells/boundary_response",
        "cells/grid_rate_maps",
    }
    assert "cells/peak" not in tags["scalars"]
    assert {"cells/place_cells", "cells/walls", "cells/doubt_s", "gridness/spacing_0.35_m"} <= set(
        tags["scalars"]
    )
    last = events.Scalars("cells/place_cells")[-1]
    assert last.value == brain.navigation.place.n_cells.item()
    for tag in tags["images"]:
        picture = cv2.imdecode(
            np.frombuffer(events.Images(tag)[-1].encoded_image_string, np.uint8), cv2.IMREAD_COLOR
        )
        assert picture.std() > 10.0  # something is drawn


LANDMARKS = (
    "world:corridor?width=64&height=40&noise=0.02&compass_deg=2&markers=12&landmark_reach=6"
    "&frames_per_lap=170&laps=1"
)


def semantic_drive(folder, n, before_each=lambda i, brain: None, **over):
    """A drive past landmarks that is recorded; the brain, its results, and the events."""
    config = merge_values(read_preset("full"), {"cells": "pose+semantic", **over})
    brain, results = NavigationBrain(build_config(config)), []
    with TensorBoardRecorder(folder, 5, maps_every=20, panels_share=math.inf) as recorder:
        for i, frame in enumerate(open_source(LANDMARKS).frames(0, n)):
            before_each(i, brain)
            results.append(brain(frame))
            recorder.step(results[-1], frame, brain)
        assert brain.semantic.watch is not None
    events = EventAccumulator(str(folder), {"images": 0, "scalars": 0, "histograms": 0})
    events.Reload()
    return brain, results, events


def test_a_brain_with_a_semantic_map_is_recorded_too(tmp_path):
    brain, _, events = semantic_drive(tmp_path, 47)
    tags = events.Tags()
    assert brain.semantic.n >= 3
    assert "ssp/map" in tags["images"]
    assert "ssp/spikes" not in tags["images"]  # vectors do not spike
    # After the first frame the recorder is told of every step, and writes every fifth frame.
    for tag in ("ssp/recall", "ssp/agreement", "ssp/gate", "ssp/lost"):
        assert [point.step for point in events.Scalars(tag)] == list(range(5, 47, 5))
    assert 0.5 < max(point.value for point in events.Scalars("ssp/recall")) < 1.5
    # As rarely as the panels of other cells, and at the end.
    assert [drawn.step for drawn in events.Images("ssp/map")] == [20, 40, 46]
    assert min(pixels(events.Images("ssp/map")[-1]).shape[:2]) >= 500
    assert brain.semantic.watch is None  # nothing is told of a run that is closed


def test_the_spikes_of_a_semantic_map_are_recorded(tmp_path):
    spiking = {
        "tier": "spiking", "time_step_s": 0.001, "binding": "exact", "vector_neurons": 0,
        "space": {"n_rotations": 1, "n_scales": 1}, "integrator": {"neurons": 50},
        "map": {"neurons": 60}, "key_features": 16,
    }  # fmt: skip
    _, _, events = semantic_drive(tmp_path, 8, semantic=spiking)
    tags = events.Tags()
    assert {"ssp/spikes", "ssp/map"} <= set(tags["images"])
    assert {"ssp_rate_hz/integrator", "ssp_rate_hz/map.memory"} <= set(tags["scalars"])
    assert "ssp_rates_hz/integrator" in tags["histograms"]
    assert 10 < events.Scalars("ssp_rate_hz/integrator")[-1].value < 400


def test_the_panels_follow_a_brain_that_starts_a_new_map(tmp_path):
    before = []

    def carried(i, brain):
        if i == 12:
            before.append(brain.semantic)
            brain.start_new_map()
            assert brain.semantic is not before[0]

    brain, _, events = semantic_drive(tmp_path, 20, carried)
    assert [point.step for point in events.Scalars("ssp/recall")] == [5, 10, 15]
    assert (before[0].watch, brain.semantic.watch) == (None, None)


def test_recording_a_semantic_map_does_not_change_it(tmp_path):
    watched, results, _ = semantic_drive(tmp_path, 25)
    alone = NavigationBrain(watched.config)
    assert [alone(frame) for frame in open_source(LANDMARKS).frames(0, 25)] == results
    a, b = watched.state_dict(), alone.state_dict()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_recording_does_not_change_what_the_brain_does(tmp_path):
    watched, _ = drive(TensorBoardRecorder(tmp_path, 1, 2, 10))
    alone, _ = drive(NullRecorder())
    assert [result for result, *_ in watched] == [result for result, *_ in alone]


def test_closing_twice_or_before_the_first_frame_does_no_harm(tmp_path):
    recorder = TensorBoardRecorder(tmp_path)
    recorder.close()
    recorder.close()


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot be written") as caught:
        TensorBoardRecorder(tmp_path / "file" / "events")
    assert "\n" not in str(caught.value)


def test_in_the_picture_of_the_cells_up_is_y_and_heading():
    activity = np.zeros((36, 21, 21), np.float32)
    activity[27, 20, 0] = 1.0  # at the top left from above; at three quarters of the height aside
    picture = coloured((activity.sum(0), activity.sum(1)))
    yellow = picture[..., 0] > 200
    rows, columns = np.nonzero(yellow[:, :210])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (0, 9, 0, 9)
    rows, columns = np.nonzero(yellow[:, 218:])
    assert 210 * 8 / 36 - 1 <= rows.min() <= rows.max() <= 210 * 9 / 36 + 1
    assert columns.max() == 9


def test_a_large_torus_and_silent_cells_are_drawn_too():
    silent = np.zeros((80, 80)), np.zeros((36, 80))
    assert coloured(silent).shape == (240, 488, 3)


@pytest.mark.parametrize("shape", [(48, 64), (720, 1280, 3), (30, 360)])
def test_any_frame_becomes_320_pixels_wide(shape):
    picture = frame_beside_template(np.zeros(shape, np.uint8), None)
    assert picture.shape == (round(shape[0] * 320 / shape[1]), 320, 3)
