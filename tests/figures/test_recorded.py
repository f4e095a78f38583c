"""Figures of recorded activity: own scales, no axis flattened by an outlier, gaps filled."""

import numpy as np
import pytest

from neuroslam.evaluation.ratemap import Bins, RateMaps
from neuroslam.figures.recorded import chosen_cells, measure_cells, plot_population, plot_raster
from neuroslam.state.activity import ActivityLog


@pytest.fixture(scope="module")
def log():
    draw = np.random.default_rng(0)
    n = 6000
    at, heading = draw.uniform(0.0, 1.0, (n, 2)), draw.uniform(-np.pi, np.pi, n)
    waves = 2 * np.pi / (0.35 * np.sqrt(3) / 2) * np.array([[1, 0], [0.5, 3**0.5 / 2],
                                                            [-0.5, 3**0.5 / 2]])  # fmt: skip
    grid = np.cos(at @ waves.T).sum(axis=1).clip(0.0)
    field = np.exp(-((at - 0.5) ** 2).sum(axis=1) / (2 * 0.1**2))
    tuned = np.exp(4.0 * (np.cos(heading - 1.0) - 1.0))
    rates = {
        "mixed": np.column_stack([grid, 20.0 * field, tuned, np.zeros(n)]),
        "still": np.zeros((n, 2)),
    }
    rates["mixed"][17, 1] = 1e4  # an outlier
    return ActivityLog.from_arrays(0.05 * np.arange(n), at, rates, heading, {"mixed": "Hz"})


def test_measures_tell_a_grid_cell_from_a_head_direction_cell(log):
    measured = measure_cells(log, "mixed", np.array([0, 2]))
    assert measured.scores[0] > 1.0 > measured.scores[1]
    assert measured.lengths[0] < 0.1 < 0.6 < measured.lengths[1]
    assert np.nanmax(measured.maps[0]) > 2.0
    assert measured.headings_rad[measured.by_heading[1].argmax()] == pytest.approx(1.0, abs=0.2)


def test_each_cell_has_its_own_scale_unit_and_score(log):
    figure = plot_population(log, "mixed")
    maps = [ax for ax in figure.axes if ax.get_xlabel().startswith("x (m)")]
    assert len(maps) == 3  # the fourth never fires
    tops = [ax.images[0].get_clim()[1] for ax in maps]
    assert tops == [np.nanmax(ax.images[0].get_array()) for ax in maps]
    assert len({round(top, 6) for top in tops}) == 3
    assert [ax.get_xlabel().split()[-1] for ax in maps] == [f"{top:.2g}" for top in tops]
    said = [ax.get_title(loc="right") for ax in figure.axes]
    assert sum(text.startswith("grid score") for text in said) >= 1
    assert any("rate (Hz)" in ax.get_ylabel() for ax in figure.axes)
    assert any(ax.name == "polar" for ax in figure.axes)
    assert "3 of 4 cells" in figure.get_suptitle().replace("\n", " ")
    with pytest.raises(ValueError, match="no cell of 'still' was ever active"):
        plot_population(log, "still")


def test_no_outlier_flattens_the_raster(log):
    figure = plot_raster(log, "note")
    first = next(ax for ax in figure.axes if ax.images)
    top = first.images[0].get_clim()[1]
    assert 1.0 < top < 50.0  # the outlier is 10 000
    assert first.images[0].get_array().max() == 1e4  # and is not lost when samples are pooled
    assert "sorted by number" in first.get_title(loc="left")
    with pytest.raises(ValueError, match="no activity"):
        plot_raster(ActivityLog.from_arrays([0.0], np.zeros((1, 2)), {}))


def test_cells_are_chosen_among_the_active_and_sorted_by_what_they_are_tuned_to(log):
    assert chosen_cells(log["still"], 6).tolist() == []
    assert chosen_cells(log["mixed"], 2).tolist() == [0, 2]
    log.cells["mixed"] = {"preferred_rad": np.array([3.0, 2.0, 1.0, 0.0])}
    figure = plot_raster(log)
    assert "sorted by preferred" in figure.axes[0].get_title(loc="left")
    assert "172°" in plot_population(log, "mixed").axes[0].get_title(loc="right")
    log.cells.clear()


def test_gaps_between_visited_bins_are_filled_and_the_outline_stays():
    maps = RateMaps(Bins(0.0, 0.0, 7, 7, 1.0), 1)
    at = np.array([[x + 0.5, y + 0.5] for x in range(1, 6) for y in range(1, 6)])
    at = at[~(at == 3.5).all(axis=1)]  # a hole in the middle
    maps.add(at, np.full(len(at), 2.0))
    (plain,), (closed,) = maps.maps(), maps.maps(closing_bins=1)
    assert np.isnan(plain[3, 3])
    assert closed[3, 3] == pytest.approx(2.0)
    assert np.isnan(closed).sum() == 49 - 25  # the border that was never visited
