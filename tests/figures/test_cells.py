"""Figures of arenas and cells: metres, equal axes, one scale, nothing unlabelled."""

import numpy as np
import pytest

from neuroslam.evaluation.ratemap import Bins
from neuroslam.figures import cells as cd
from neuroslam.figures.style import new_figure, render
from neuroslam.worlds.arena import Arena, named_arena

ARENA = named_arena("square")
BINS = Bins.around([[-1, -1], [1, 1]], 0.05)


def firing(title="cell", scale=1.0):
    y, x = np.mgrid[: BINS.n_y, : BINS.n_x]
    rates = scale * (1.0 + np.cos(0.6 * x) * np.cos(0.6 * y))
    rates[0, 0] = np.nan
    track = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    return cd.Firing(title, "score 1.00", rates, BINS, ARENA, track, track[:5])


def approach(n=60):
    time = np.arange(n) / 10.0
    distance = np.linspace(0.0, 0.45, n)
    zone = (distance <= 0.3).astype(int) + (distance <= 0.15)
    rates = np.zeros((n, 24))
    rates[:, 6] = 0.5
    path = np.column_stack([np.zeros(n), 1.0 - distance])
    return cd.Approach("C: away", ARENA, path, time, distance, zone, time / 6, time / 9, rates)


def panels(figure):
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def test_an_arena_is_drawn_whole_in_metres_with_equal_axes():
    ring = named_arena("pillar")
    figure = new_figure(3, 3, None)
    axes = figure.subplots()
    cd.draw_arena(axes, ring)
    assert len(axes.lines) == 2
    assert axes.get_aspect() == 1.0
    assert axes.get_xlabel() == "x (m)"
    assert axes.get_ylabel() == "y (m)"
    x = axes.get_xlim()
    assert x[0] < ring.bounds[0]
    assert x[1] > ring.bounds[1]


def test_a_rate_map_covers_its_bins_and_its_scale_ends_at_the_peak():
    axes = new_figure(3, 3, None).subplots()
    cell = firing(scale=3.0)
    cd.draw_rate_map(axes, cell.rate_map, BINS, ARENA)
    (image,) = axes.images
    assert tuple(image.get_extent()) == BINS.extent_m
    assert image.get_clim() == (0.0, np.nanmax(cell.rate_map))


def test_a_silent_cell_and_an_unvisited_map_can_be_drawn():
    axes = new_figure(3, 3, None).subplots()
    for rates in (np.zeros(BINS.shape), np.full(BINS.shape, np.nan)):
        cd.draw_rate_map(axes, rates, BINS, ARENA)
        cd.draw_autocorrelogram(axes, rates, BINS.bin_m)


def test_an_autocorrelogram_has_its_centre_at_no_shift():
    axes = new_figure(3, 3, None).subplots()
    cd.draw_autocorrelogram(axes, firing().rate_map, BINS.bin_m)
    (image,) = axes.images
    left, right, low, high = image.get_extent()
    assert (left, low) == (-right, -high)
    shown = np.asarray(image.get_array())
    assert shown[shown.shape[0] // 2, shown.shape[1] // 2] == pytest.approx(1.0)
    assert image.get_clim() == (-1.0, 1.0)


def test_the_zones_of_an_approach_are_shaded_from_border_to_border():
    way = approach()
    figure = cd.plot_approaches([way, way], "ways")
    distance = next(ax for ax in figure.axes if ax.get_ylabel() == "distance (m)")
    spans = [(p.get_x(), p.get_x() + p.get_width()) for p in distance.patches]
    assert len(spans) == 3
    assert [s[1] for s in spans[:-1]] == [s[0] for s in spans[1:]]
    assert spans[0][0] == way.time_s[0]
    assert spans[-1][1] == pytest.approx(way.time_s[-1])
    assert distance.get_title(loc="left") == "C: away"


def test_bearings_of_an_approach_are_drawn_where_they_point():
    figure = cd.plot_approaches([approach()], "way")
    rates = next(ax for ax in figure.axes if "bearing" in ax.get_ylabel())
    (image,) = rates.images
    shown = np.asarray(image.get_array())
    low, high = image.get_extent()[2:]
    row = shown[:, 5].argmax()
    assert low + (row + 0.5) * (high - low) / len(shown) == pytest.approx(90.0)


def test_firing_maps_of_one_figure_share_their_scale():
    figure = cd.plot_firing_maps([[firing(), firing(scale=2.0)]] * 2, "maps", "rate")
    limits = {ax.images[0].get_clim() for ax in panels(figure)}
    assert len(limits) == 1


def test_grids_are_drawn_in_pairs_with_method_and_time():
    rows = {"ours": [firing("5 min"), firing("9 min")], "theirs": [firing("5 min")] * 2}
    figure = cd.plot_grids(rows, "grids")
    axes = [ax for ax in panels(figure) if ax.images and ax.get_xlim()[1] > 0]
    assert len(axes) == 8
    assert [ax.get_ylabel().split("\n")[0] for ax in axes[::4]] == ["ours", "theirs"]
    assert axes[0].get_title(loc="left") == "5 min"
    assert axes[1].get_title(loc="left") == "score 1.00"


def test_firing_is_drawn_on_the_track_above_the_rate_map():
    figure = cd.plot_firing([firing(), firing("recorded")], "cells")
    assert panels(figure)[1].get_title(loc="left") == "recorded"
    assert render(figure, dpi=40).std() > 5


def test_encounters_show_the_path_up_to_each_time():
    where = np.random.default_rng(1).uniform(-1, 1, (40, 2))
    activity = np.linspace(0.0, 1.0, 40)
    stops = {"10 s|3 activated": 10, "40 s|9 activated": 40}
    figure = cd.plot_encounters(where, activity, stops, Arena.circle(1.5), "encounters")
    drawn = [len(ax.collections[0].get_offsets()) for ax in panels(figure)]
    assert drawn == [9, 39]


def test_score_curves_have_one_legend_with_every_name_once():
    x = np.arange(3.0)
    ours = cd.Curve(x, x / 3, "#0072B2", "-", np.full(3, 0.1))
    curves = {"ours": ours, "paper": cd.Curve(x, x / 4, "#000000", "--")}
    figure = cd.plot_scores({"Triangle": curves, "Nonagon": curves}, "time (s)", "scores")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["ours", "paper"]
    assert len(panels(figure)[0].collections) == 1


@pytest.mark.parametrize(
    "draw",
    [
        lambda: cd.plot_approaches([], "t"),
        lambda: cd.plot_firing([], "t"),
        lambda: cd.plot_grids({}, "t"),
        lambda: cd.plot_scores({}, "x", "t"),
    ],
)
def test_nothing_to_draw_is_refused(draw):
    with pytest.raises(ValueError, match="nothing to draw"):
        draw()
