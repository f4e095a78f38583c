"""What the full brain loses without a part of it."""

import json

import pytest

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config
from neuroslam.experiments.populations import EVERYTHING, WITHOUT, populations, silencer
from neuroslam.types import Frame, Velocity


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    out = tmp_path_factory.mktemp("without")
    names = [EVERYTHING, "no place cells", "walls correct no one", "no compass"]
    return populations(None, out, ["corridor"], [0], laps=0.15, names=names)["rows"], out


def test_each_part_is_told_with_the_error_without_it(told):
    rows, out = told
    assert json.loads((out / "results.json").read_text())["rows"] == rows
    assert rows[0]["without"] == EVERYTHING
    assert all(0.0 < row["ate_m"] < 1.0 for row in rows)
    assert rows[0]["worse_on"] == 0
    assert (out / "without.png").stat().st_size > 10_000


def test_beside_pose_cells_place_cells_that_are_not_corrected_are_as_good_as_none(told):
    error = {row["without"]: row["ate_m"] for row in told[0]}
    assert error["walls correct no one"] == pytest.approx(error["no place cells"], rel=1e-9)
    assert error["no compass"] != error[EVERYTHING]


def test_who_is_silenced_goes_on_and_tells_nobody():
    brain = NavigationBrain(build_config({"cells": "pose+head_direction"}))
    silencer({"head_direction": ["step"], "pose": ["follow"]})(brain)
    before = brain.map.pose.theta_rad
    for i, heading in enumerate([1.0, 1.5, 1.5]):
        brain(Frame(i, 0.1 * i, velocity=Velocity(0.0, 0.0), heading_rad=heading))
    assert brain.map.pose.theta_rad == before
    assert brain.head_direction.heading_rad > 1.01


def test_each_variant_differs_from_the_brain_that_has_everything():
    assert WITHOUT[EVERYTHING] not in [
        without for name, without in WITHOUT.items() if name != EVERYTHING
    ]
