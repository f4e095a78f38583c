"""The cells of a rat's run are drawn as they were recorded, or as computed along its path."""

import numpy as np
import pytest

from neuroslam import BrainConfig, NavigationBrain, open_source
from neuroslam.report.collect import activity
from neuroslam.report.reading import read_run
from neuroslam.runs.cells import activity_of
from neuroslam.runs.plot import plot
from neuroslam.runs.run import run
from neuroslam.state.activity import ACTIVITY
from neuroslam.state.activity_writer import ActivityWriter

WALK = "arena:square?minutes=0.5&speed=0.2"


@pytest.fixture(scope="module")
def brain_and_log():
    config = BrainConfig(cells=("place", "head_direction", "speed"), odometry={"use": "given"})
    brain, writer = NavigationBrain(config), ActivityWriter(None)
    for frame in open_source(WALK):
        writer.note(brain(frame), frame, brain.populations)
    return brain, writer.log()


@pytest.mark.parametrize(
    ("name", "alike"),
    [("grid", 0.99), ("head_direction", 0.99), ("place", 0.9), ("speed", 0.9), ("boundary", 0.6)],
)
def test_computed_activity_is_that_recorded(brain_and_log, name, alike):
    # Boundary cells were gated by their history, and speed cells anticipate: not computed.
    brain, log = brain_and_log
    before = {key: value.clone() for key, value in brain.state_dict().items()}
    found = {}
    for population in brain.populations.values():
        found |= population.rates_at(log.estimate_m, log.estimate_heading_rad, log.speed_m_s)
    assert found[name].shape == log[name].shape
    assert np.corrcoef(found[name].ravel(), log[name].ravel())[0, 1] > alike
    assert all((value == brain.state_dict()[key]).all() for key, value in before.items())


def test_a_run_is_drawn_with_and_without_recorded_activity(tmp_path):
    config = BrainConfig(cells=("place",), odometry={"use": "given"})
    run(WALK, tmp_path / "run", config, record=["grid"], tensorboard=False)
    drawn = {path.name for path in plot(tmp_path / "run", tmp_path / "figures")}
    assert {"cells_grid.png", "raster.png", "map.png"} <= drawn
    assert "cells_place.png" not in drawn
    part = read_run(tmp_path / "run")
    shown = activity(part)
    assert [one["title"] for one in shown["figures"]] == ["Grid cells", "All cells over time"]
    assert "along the true path" in shown["note"]
    (tmp_path / "run" / ACTIVITY).rename(tmp_path / "elsewhere")
    log, note = activity_of(part.out, part.brain, part.trace)
    assert log.names == ("boundary", "grid", "place")
    assert log.n_samples == 601
    assert "computed" in note
    (tmp_path / "run" / ACTIVITY).mkdir()
    assert activity_of(part.out, part.brain, part.trace)[0] is None  # damaged: said, not drawn
