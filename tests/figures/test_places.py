"""What figures of place cells show."""

import numpy as np
import pytest

from neuroslam.figures import place_errors as pe
from neuroslam.figures import places as pd
from neuroslam.figures.style import render, save
from neuroslam.types import Pose
from neuroslam.worlds.arena import named_arena

ARENA = named_arena("circle2m")
RNG = np.random.default_rng(0)
CENTRES = RNG.uniform(-0.6, 0.6, (40, 2))
LINKS = np.column_stack([np.arange(39), np.arange(1, 40)])
PATH = np.cumsum(RNG.normal(0, 0.02, (200, 2)), axis=0)


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def place(name="SLRB, 5 min"):
    return pd.PlaceMap(name, CENTRES, LINKS)


def spread(values):
    return pe.Spread(np.array([0.0, 1.0, 2.0]), np.asarray(values, dtype=float))


def test_maps_of_places_share_their_axes_and_are_true_to_scale():
    far = pd.PlaceMap("drifted", CENTRES + 0.9, LINKS)
    figure = pd.plot_place_maps([[place(), far], [far, place()]], ARENA, PATH, "Places")
    assert len(figure.axes) == 4
    assert len({axes.get_xlim() for axes in figure.axes}) == 1
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
    x_min, x_max = figure.axes[0].get_xlim()
    assert x_min < -1.0
    assert x_max > far.centres_m[:, 0].max()
    assert figure.axes[1].get_title("left") == "drifted"
    assert figure.axes[1].get_title("right") == "40 cells"


def test_a_map_of_one_cell_can_be_drawn():
    one = pd.PlaceMap("first", np.zeros((1, 2)), np.empty((0, 2), int))
    figure = pd.plot_place_maps([[one]], ARENA, PATH)
    assert figure.axes[0].get_title("right") == "1 cell"
    assert render(figure).std() > 0


def test_place_cells_are_drawn_with_remembered_walls():
    here, feet = Pose(0.1, 0.2, 0.0), np.array([[1.0, 0.0], [0.0, 1.0]])
    (axes,) = pd.plot_place_cells(CENTRES, LINKS, feet, here, PATH).axes
    labels = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    np.testing.assert_array_equal(labels["remembered wall, in 2 parts"], feet)
    np.testing.assert_array_equal(labels["the animal now"], [here[:2]])
    assert "40 place cells" in labels
    (bare,) = pd.plot_place_cells(CENTRES, LINKS, np.empty((0, 2)), here, PATH).axes
    assert bare.get_title("left") == "Place cells"
    assert not any("wall" in line.get_label() for line in bare.get_lines())


def test_paths_have_their_mean_error_and_remembered_walls():
    feet = np.array([[1.0, 0.0], [0.0, 1.0]])
    off = PATH + np.array([0.03, 0.04])
    estimates = [pd.EstimatedPath("SLRB", off, feet), pd.EstimatedPath("path integration", PATH)]
    figure = pd.plot_paths(estimates, ARENA, PATH)
    assert figure.axes[0].get_title("right") == "mean error 5.0 cm · 2 wall memories"
    assert figure.axes[1].get_title("right") == "mean error 0.0 cm"
    assert labels(figure)[:2] == ["SLRB", "path integration"]
    assert labels(figure)[-1] == "remembered wall"


def test_a_path_of_another_length_than_the_truth_is_refused():
    with pytest.raises(ValueError, match="'SLRB' has 199 points, the truth 200"):
        pd.plot_paths([pd.EstimatedPath("SLRB", PATH[1:])], ARENA, PATH)


def test_cells_above_half_of_the_strongest_are_ringed_and_counted():
    rates = np.zeros(40)
    rates[:4] = 3.0, 1.6, 1.5, 0.1
    figure = pd.plot_responses([pd.Response("before", CENTRES, rates, PATH[-1])], ARENA)
    axes = figure.axes[0]
    assert axes.get_title("right") == "2 cells above half"
    rings = axes.collections[-1].get_offsets()
    np.testing.assert_allclose(rings, CENTRES[:2])
    assert figure.axes[-1].get_ylabel() == "rate / highest rate"


def test_silent_cells_can_be_drawn():
    silent = pd.Response("silent", CENTRES, np.zeros(40), PATH[-1])
    figure = pd.plot_responses([silent], ARENA)
    assert figure.axes[0].get_title("right") == "0 cells above half"


def test_a_band_is_the_mean_and_one_standard_deviation():
    cells = {"SLRB": spread([[0, 10, 20], [0, 14, 20]])}
    errors = {"SLRB": spread([[0.0, 0.01, 0.02], [0.0, 0.03, 0.02]])}
    figure = pe.plot_growth(cells, errors, {"the paper": 0.031})
    left, right = figure.axes
    np.testing.assert_allclose(left.lines[0].get_ydata(), [0, 12, 20])
    np.testing.assert_allclose(right.lines[0].get_ydata(), [0.0, 2.0, 2.0])
    band = right.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(3.0)
    assert right.get_ylabel() == "position error (cm)"
    assert left.get_xlabel() == right.get_xlabel() == "time (min)"
    assert labels(figure) == ["SLRB", "the paper: 3.1 cm"]


def test_bars_are_means_in_centimetres_grouped_by_track():
    errors = {
        "SLRB": {"triangle": np.array([0.02, 0.04]), "hafting": np.array([0.05])},
        "RatSLAM": {"triangle": np.array([0.10]), "hafting": np.array([0.20])},
    }
    figure = pe.plot_errors(errors)
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == pytest.approx([3.0, 5.0, 10.0, 20.0])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["triangle", "hafting"]
    assert labels(figure) == ["SLRB", "RatSLAM"]


def test_the_sweep_has_two_boxes_and_a_bar_for_each_threshold(tmp_path):
    errors = [RNG.uniform(0, r, 100) for r in (0.04, 0.08)]
    figure = pe.plot_sweep((0.04, 0.08), errors, errors, [np.array([500, 520]), np.array([200])])
    left, right = figure.axes
    assert [bar.get_height() for bar in right.patches] == [510, 200]
    assert [tick.get_text() for tick in left.get_xticklabels()] == ["4", "8"]
    assert labels(figure) == ["winning place cell", "integrator"]
    save(figure, tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    "call",
    [
        lambda: pd.plot_place_maps([], ARENA, PATH),
        lambda: pd.plot_place_maps([[place()], [place(), place()]], ARENA, PATH),
        lambda: pd.plot_paths([], ARENA, PATH),
        lambda: pd.plot_responses([], ARENA),
        lambda: pe.plot_growth({}, {}),
        lambda: pe.plot_errors({}),
        lambda: pe.plot_sweep([], [], [], []),
    ],
)
def test_nothing_to_draw_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()


def test_methods_keep_their_colour_in_all_figures():
    assert pe.colour_of("SLRB, 5 min") == pe.METHODS["SLRB"]
    assert len(set(pe.METHODS.values())) == 4
    assert pe.colour_of("something else") not in pe.METHODS.values()
