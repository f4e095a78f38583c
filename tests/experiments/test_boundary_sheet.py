"""The experiment with boundary cells in the loop, on a short walk."""

import json

import numpy as np
import pytest

from neuroslam.cells import BoundarySheet
from neuroslam.experiments.boundary_sheet import (
    BEAM_REACH_M,
    CONDITIONS,
    boundary_cells_in_loop,
    noisy_scans,
)
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam


@pytest.fixture(scope="module")
def short(shared, tmp_path_factory):
    out = tmp_path_factory.mktemp("boundary_sheet")
    data = shared / "data" / "rodent"
    return boundary_cells_in_loop(data, out, 0.25, [0], [0], ["triangle"]), out


def test_results_and_figures_are_written(short):
    written, out = short
    assert json.loads((out / "results.json").read_text())["rows"] == written["rows"]
    conditions = [(row["input"], row["condition"]) for row in written["rows"]]
    feet = [("feet", name) for name in CONDITIONS]
    assert conditions == [*feet, *[("noisy beams", name) for name in tuple(CONDITIONS)[:2]]]
    for name in ("feet.png", "noisy_beams.png"):
        assert (out / name).stat().st_size > 10_000


def test_each_condition_changes_the_positions(short):
    for kind in ("feet", "noisy beams"):
        errors = [row["error_m"] for row in short[0]["rows"] if row["input"] == kind]
        assert len(set(errors)) == len(errors)
        assert all(0.0 < error < 0.1 for error in errors)


def test_a_tenth_of_noisy_beams_are_outliers():
    walk = roam(named_arena("square"), 0.5, np.random.default_rng(4), rate_hz=20.0)
    scans = noisy_scans(walk, [0, 1])
    assert scans.shape[:2] == (2, 120)
    assert 0.0 <= scans.min() <= scans.max() <= BEAM_REACH_M
    far = scans > np.sqrt(8.0) + 0.1  # than any wall of the square: outliers alone
    share = 0.1 * (1.0 - (np.sqrt(8.0) + 0.1) / BEAM_REACH_M)
    assert far.mean() == pytest.approx(share, rel=0.05)


def test_the_sheet_is_exported():
    assert BoundarySheet.__module__ == "neuroslam.cells.boundary_sheet"
