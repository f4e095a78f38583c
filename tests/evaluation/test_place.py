"""Precision, recall and the corridor walked twice."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuroslam.errors import MapError, SourceError
from neuroslam.evaluation.place import (
    average_precision,
    precision_recall,
    recall_at_full_precision,
)
from neuroslam.experiments import run_experiment, view_matching
from neuroslam.view import LocalViewCells


def test_a_hand_worked_curve():
    distances = np.array([0.1, 0.2, 0.2, 0.4, 0.5])
    right = np.array([True, True, False, False, True])
    curve = precision_recall(distances, right)
    assert curve.threshold.tolist() == [0.1, 0.2, 0.4, 0.5]  # equal distances are one step
    np.testing.assert_allclose(curve.precision, [1, 2 / 3, 1 / 2, 3 / 5])
    np.testing.assert_allclose(curve.recall, [1 / 3, 2 / 3, 2 / 3, 1])
    assert average_precision(curve) == pytest.approx((1 + 2 / 3 + 0 + 3 / 5) / 3)
    assert recall_at_full_precision(curve) == pytest.approx(1 / 3)


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=30))
def test_bounds_and_order_do_not_matter(answers):
    distances, right = (np.array(column) for column in zip(*answers, strict=True))
    if not right.any():
        with pytest.raises(MapError, match="0 correct matches exist, expected at least one"):
            precision_recall(distances, right)
        return
    value = average_precision(precision_recall(distances, right))
    assert 0 <= value <= 1
    backwards = precision_recall(distances[::-1], right[::-1])
    assert average_precision(backwards) == pytest.approx(value)


def test_a_perfect_ranking_is_one_and_missing_matches_count():
    distances, right = np.arange(4.0), np.array([True, True, False, False])
    assert average_precision(precision_recall(distances, right)) == 1.0
    assert precision_recall(distances, right, n_right=4).recall[-1] == 0.5
    with pytest.raises(MapError, match="4 distances and 3 labels"):
        precision_recall(distances, right[:3])


def test_a_corridor_walked_twice(shared, tmp_path):
    rows = run_experiment("view-matching", shared / "data", tmp_path)
    by = {(row["templates"], row["width_px"]): row for row in rows}
    # Chance is 0.11 for pairs: 228 true ones of 2080 that are asked about.
    assert all(row["pairs_average_precision"] > 0.25 for row in rows)
    assert by["plain", 32]["nearest_average_precision"] > 0.7
    # In this even light normalising takes away more than it gives; wide flat templates excepted.
    patch, plain = by["patch-normalised", 64], by["plain", 64]
    assert patch["pairs_average_precision"] > plain["pairs_average_precision"]
    assert json.loads((tmp_path / "results.json").read_text())["true_pairs"] == 228
    assert (tmp_path / "pr_curves.png").read_bytes()[:4] == b"\x89PNG"


def test_the_experiment_matches_as_the_view_cells_do():
    """Distances are symmetric at shift 0, zero to itself, and those of a search at any."""
    images = [np.random.default_rng(i).integers(0, 256, (48, 64), np.uint8) for i in range(4)]
    config = view_matching.ViewConfig(template_width=16, template_height=12, shift_match=0)
    found = view_matching.distance_matrix(images, config)
    np.testing.assert_array_equal(found, found.T)
    assert np.diag(found).max() == 0.0
    assert found[0, 1] > 0.05
    config = view_matching.ViewConfig(template_width=16, template_height=12, shift_match=3)
    shifted = view_matching.distance_matrix(images, config)
    cells = LocalViewCells(config)
    cells.learn(cells.encode(images[1]))
    assert shifted[0, 1] == cells.search(cells.encode(images[0])).error


def test_a_missing_truth_is_named(tmp_path):
    with pytest.raises(SourceError, match=r"truth\.bmp: missing or no picture; expected the 84x84"):
        view_matching.read_truth(tmp_path / "truth.bmp", 84)
