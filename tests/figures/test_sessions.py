from functools import cache

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from mpl_toolkits.mplot3d.art3d import Line3D, Line3DCollection

from neuroslam.figures import sessions as md
from neuroslam.figures import style
from neuroslam.figures.session_panels import ORDINALS

TORUS = (21, 21, 36)


def chain(n, first=0):
    return np.column_stack([np.arange(n - 1), np.arange(1, n)]) + first


def arc(n, start, stop):
    angle = np.linspace(start, stop, n)
    return np.column_stack([12 * np.cos(angle), 7 * np.sin(angle), angle + np.pi / 2])


FIRST = md.Stage(
    "First session", arc(40, 0, 3.6), chain(40), np.zeros(40, int), starts=[0], ends=[39]
)
PARTIAL = md.Stage(
    "second session",
    arc(15, 2.8, 3.6) - arc(15, 2.8, 3.6)[0],
    chain(15),
    np.ones(15, int),
    merge_points=(arc(15, 2.8, 3.6) - arc(15, 2.8, 3.6)[0])[14:, :2],
    starts=[0],
)
MATCH = FIRST._replace(title="At the match", merge_points=FIRST.poses[30:31, :2], others=(PARTIAL,))
FINAL = md.Stage(
    "Final map",
    np.vstack([FIRST.poses, arc(30, 3.3, 2 * np.pi)]),
    np.vstack([chain(40), chain(30, 40), [[36, 40], [69, 0]]]),
    np.repeat([0, 1], [40, 30]),
    merge_points=FIRST.poses[36:37, :2],
    starts=[0, 40],
    ends=[39, 69],
)


@cache
def stages():
    return md.plot_stages([FIRST, MATCH, FINAL], "An ellipse in two sessions")


def helix(n, shift=(0, 0, 0)):
    angle = np.linspace(0, 2 * np.pi, n)
    cells = [10 + 14 * np.cos(angle), 10 + 9 * np.sin(angle), angle / (2 * np.pi) * 36]
    return (np.column_stack(cells) + shift) % TORUS


def groups():
    loaded, partial = helix(90), helix(60, (3, -4, 9))
    both = np.vstack([loaded, partial])
    return [
        md.Bindings("Loaded", loaded, np.zeros(90, int), loaded[5:6]),
        md.Bindings("Partial, before the shift", partial, np.ones(60, int), partial[:1]),
        md.Bindings("Merged", both, np.repeat([0, 1], [90, 60]), loaded[5:6]),
    ]


@cache
def bindings():
    return md.plot_bindings(groups(), TORUS, "Pose-cell bindings")


@cache
def overlay():
    reference = FINAL.poses[:, :2]
    links = {"reference_links": FINAL.links, "aligned_links": FINAL.links}
    return md.plot_overlay(reference, reference + 0.05, 0.0707, 0.00254, "Ellipse", **links)


def rows():
    truth = arc(100, 0, 2 * np.pi)[:, :2]
    away = np.vstack([truth[:50], truth[50:] + 20.0])
    sessions = [(0, 50), (50, 100)]
    return [
        ("Single session", truth + 0.1, truth, 0.141, [(0, 100)]),
        ("Two sessions", away - 0.2, away, 0.283, sessions),
    ]


@cache
def accuracy():
    return md.plot_accuracy(rows(), "Tracks against the truth")


FIGURES = {"stages": stages, "bindings": bindings, "overlay": overlay, "accuracy": accuracy}
ALL = pytest.mark.parametrize("draw", FIGURES.values(), ids=FIGURES)
FLAT = pytest.mark.parametrize("draw", [stages, overlay, accuracy])


def nodes(axes, colour):
    """All node dots of a colour, in metres; marks and rings are larger."""
    lines = [line for line in axes.lines if line.get_marker() == "o" and line.get_ls() == "None"]
    mine = [line.get_xydata() for line in lines if to_hex(line.get_color()) == colour.lower()]
    return np.vstack([np.zeros((0, 2)), *mine])


def markers(axes, kind):
    return [line for line in axes.lines if line.get_marker() == kind]


def rings(axes):
    return [line for line in markers(axes, "o") if line.get_markeredgecolor() == md.MATCH]


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def notes_of(axes):
    return " ".join(text.get_text() for text in axes.texts)


def as_rows(points):
    return sorted(map(tuple, np.round(points, 9)))


@ALL
def test_equal_figures_give_equal_bytes(draw, tmp_path):
    style.save(draw.__wrapped__(), tmp_path / "one.png", dpi=60)
    style.save(draw.__wrapped__(), tmp_path / "two.png", dpi=60)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


@ALL
def test_no_text_is_clipped_or_overlaps(draw):
    figure = draw()
    with mpl.rc_context(style.STYLE):
        figure.canvas.draw()
    boxes = [figure.legends[0].get_window_extent()]
    boxes += [figure._suptitle.get_window_extent()] if figure._suptitle else []
    for axes in figure.axes:
        title, below = axes._left_title.get_window_extent(), axes.texts[0].get_window_extent()
        assert title.y0 >= below.y1 - 3  # a line of text keeps room for the tails of a g
        boxes += [title]
        if axes.name != "3d":
            boxes += [axes.xaxis.label.get_window_extent(), axes.get_window_extent()]
    for index, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[index + 1 :])


@FLAT
def test_axes_have_equal_scale_and_show_everything(draw):
    figure = draw()
    with mpl.rc_context(style.STYLE):
        figure.canvas.draw()
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        assert axes.get_xlabel() == "x (m)"
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        box = axes.get_window_extent()
        assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=1e-6)
        for line in axes.lines:
            x, y = line.get_xydata().T
            assert x0 < x.min() <= x.max() < x1
            assert y0 < y.min() <= y.max() < y1


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_the_axes_of_bindings_keep_their_names(n):
    figure = md.plot_bindings((groups() * 2)[:n], TORUS, "Bindings")
    with mpl.rc_context(style.STYLE):
        figure.canvas.draw()
    boxes = [axes.zaxis.label.get_window_extent() for axes in figure.axes]
    assert all(box.x1 < figure.bbox.x1 for box in boxes)
    for axes in figure.axes:
        ground = [a.label.get_window_extent() for a in (axes.xaxis, axes.yaxis)]
        assert all(box.y0 > figure.legends[0].get_window_extent().y1 for box in ground)
        texts = [*ground, axes.zaxis.label.get_window_extent()]
        assert not any(axes._left_title.get_window_extent().overlaps(text) for text in texts)


@FLAT
def test_panels_fill_the_width_they_have(draw):
    figure = draw()
    with mpl.rc_context(style.STYLE):
        figure.canvas.draw()
    columns = figure.axes[0].get_gridspec().ncols
    for axes in figure.axes:
        assert axes.get_position().width > 0.75 / columns


def test_every_session_has_its_own_colour_and_red_and_purple_are_none_of_them():
    assert len({colour.lower() for colour in md.SESSIONS}) == len(ORDINALS) == 6
    assert md.MATCH not in md.SESSIONS
    assert md.REFERENCE not in md.SESSIONS


def test_stages_have_a_panel_each_three_in_a_row():
    figure = md.plot_stages([FIRST, MATCH, FINAL, FINAL], None)
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "First session", "At the match", "Final map", "Final map"
    ]  # fmt: skip
    grid = figure.axes[0].get_gridspec()
    assert (grid.nrows, grid.ncols) == (2, 3)


def test_every_experience_and_link_is_drawn_in_the_colour_of_its_session():
    axes = stages().axes[2]
    for number in (0, 1):
        mine = FINAL.poses[FINAL.session == number, :2]
        assert as_rows(nodes(axes, md.SESSIONS[number])) == as_rows(mine)
    lines = [c for c in axes.collections if isinstance(c, LineCollection)]
    by_colour = {to_hex(c.get_color()[0]): len(c.get_segments()) for c in lines}
    assert by_colour == {
        style.MAP.lower(): 39,
        style.ROBOT.lower(): 31,
    }  # a bridge is of the later one
    assert [len(markers(axes, kind)) for kind in "XD"] == [2, 2]
    assert np.array_equal(rings(axes)[0].get_xydata(), FINAL.merge_points)


def test_an_unlinked_map_is_drawn_beside_and_labelled():
    axes = stages().axes[1]
    blue, orange = nodes(axes, md.SESSIONS[0]), nodes(axes, md.SESSIONS[1])
    apart = (blue.min(axis=0) > orange.max(axis=0)) | (orange.min(axis=0) > blue.max(axis=0))
    assert apart.any()
    moves = orange - PARTIAL.poses[:, :2]
    assert np.allclose(moves, moves[0])
    assert "40 + 15 experiences · 39 + 14 links" in notes_of(axes)
    assert f"second session: own coordinates, moved {-moves[0, 1]:.3g} m down" in notes_of(axes)
    both = np.vstack([ring.get_xydata() for ring in rings(axes)])
    assert as_rows(both) == as_rows(
        np.vstack([MATCH.merge_points, PARTIAL.merge_points + moves[0]])
    )


def test_an_unlinked_map_without_overlap_is_not_moved():
    far = PARTIAL._replace(
        poses=PARTIAL.poses + np.array([40.0, 0, 0]), merge_points=np.zeros((0, 2))
    )
    axes = md.plot_stages([FIRST._replace(others=(far,))], None).axes[0]
    assert as_rows(nodes(axes, md.SESSIONS[1])) == as_rows(far.poses[:, :2])
    assert notes_of(axes).endswith("second session: own coordinates")


def test_unlinked_maps_do_not_overlap():
    third = PARTIAL._replace(title="third session", session=np.full(15, 2))
    axes = md.plot_stages([MATCH._replace(others=(PARTIAL, third, FIRST))], None).axes[0]
    low, high = zip(
        *[(p.min(0), p.max(0)) for p in (nodes(axes, c) for c in md.SESSIONS[1:3])], strict=True
    )
    assert (low[0] > high[1]).any() or (low[1] > high[0]).any()


def test_legends_name_exactly_what_is_drawn():
    everything = ["start of a session", "end of a session", "merge point"]
    assert legend_of(stages()) == ["first session", "second session", *everything]
    assert legend_of(md.plot_stages([FIRST._replace(starts=(), ends=())])) == ["first session"]
    assert legend_of(overlay()) == ["single session", "merged map, aligned"]
    assert legend_of(accuracy()) == ["first session", "second session", *everything[:2], "truth"]
    names = ["first session", "second session", *everything[:2], "match", "x and y, drawn at θ = 0"]
    assert legend_of(bindings()) == names


def test_all_named_sessions_are_in_the_legend():
    names = ["1: monday.mp4", "2: tuesday.mp4", "3: a/very/long/name/of/a/video.mp4, no place"]
    figure = md.plot_stages([FINAL._replace(starts=(), ends=(), merge_points=())], None, names)
    assert legend_of(figure) == names
    colours = [to_hex(line.get_color()) for line in figure.legends[0].get_lines()]
    assert colours == [colour.lower() for colour in md.SESSIONS[:3]]
    style.render(figure)
    assert figure.legends[0].get_window_extent().x1 < figure.bbox.x1


def test_six_sessions_are_named_in_order():
    six = FIRST._replace(session=np.arange(40) % 6)
    labels = legend_of(md.plot_stages([six]))
    assert labels[:6] == [f"{ordinal} session" for ordinal in ORDINALS]


def test_a_map_of_one_experience_or_none_can_be_drawn():
    one = md.Stage("One", np.zeros((1, 3)), np.zeros((0, 2), int), np.zeros(1, int), starts=[0])
    none = md.Stage("None", np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros(0, int))
    first, second = md.plot_stages([one, none]).axes
    assert notes_of(first) == "1 experience · 0 links"
    assert notes_of(second) == "0 experiences · 0 links"
    style.render(md.plot_stages([none]))


def test_bindings_show_every_cell_on_the_whole_torus():
    for axes, group in zip(bindings().axes, groups(), strict=True):
        assert axes.name == "3d"
        limits = (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())
        assert [tuple(map(float, limit)) for limit in limits] == [(0.0, n) for n in TORUS]
        assert (axes.get_xlabel(), axes.get_zlabel()) == ("x (cells)", "θ (cells)")
        lines = [line for line in axes.lines if isinstance(line, Line3D)]
        for number in np.unique(group.session):
            mine = [line for line in lines if line.get_color() == md.SESSIONS[number]]
            dots = [line.get_data_3d() for line in mine if line.get_marker() == "o"]
            assert np.array_equal(np.hstack(dots).T, group.cells[group.session == number])
        matched = np.array([x.get_data_3d() for x in rings(axes)])[0].T
        assert np.array_equal(matched, group.matched)
        marks = [len(markers(axes, kind)) for kind in "XD"]
        assert marks == [len(np.unique(group.session))] * 2


def test_no_line_goes_across_the_edge_where_the_torus_closes():
    jumps = (np.abs(np.diff(helix(90), axis=0)) > np.array(TORUS) / 2).any(axis=1).sum()
    assert jumps >= 4
    axes = bindings().axes[0]
    segments = [
        np.array(c._segments3d) for c in axes.collections if isinstance(c, Line3DCollection)
    ]
    steps = np.abs(np.diff(np.vstack(segments), axis=1))
    assert len(steps) == 89 - jumps
    assert (steps.max(axis=(0, 1)) <= np.array(TORUS) / 8).all()


def test_bindings_of_two_sessions_are_not_joined_to_each_other():
    cells = np.full((4, 3), 5.0) + np.arange(4)[:, None] * 0.1
    group = md.Bindings("Close", cells, np.array([0, 0, 1, 1]))
    axes = md.plot_bindings([group], TORUS).axes[0]
    lines = [c for c in axes.collections if isinstance(c, Line3DCollection)]
    assert [len(c._segments3d) for c in lines] == [1, 1]


def test_the_overlay_draws_both_maps_and_their_rmse():
    (axes,) = overlay().axes
    assert axes.get_title(loc="left") == "Ellipse"
    assert notes_of(axes) == "RMSE 0.0707 m (0.254 % of the diagonal)"
    reference = FINAL.poses[:, :2]
    assert as_rows(nodes(axes, md.REFERENCE)) == as_rows(reference)
    assert as_rows(nodes(axes, md.ROBOT)) == as_rows(reference + 0.05)
    assert [len(c.get_segments()) for c in axes.collections] == [len(FINAL.links)] * 2


def test_an_overlay_without_links_draws_points_only():
    figure = md.plot_overlay(FIRST.poses[:, :2], FIRST.poses[:, :2], 0.0, 0.0)
    assert not figure.axes[0].collections
    assert all(handle.get_ls() == "None" for handle in figure.legends[0].legend_handles)


def test_accuracy_has_the_error_in_the_title_and_the_same_axes_in_all_panels():
    one, two = accuracy().axes
    assert one.get_title(loc="left") == "Single session: ATE 0.141 m"
    assert two.get_title(loc="left") == "Two sessions: ATE 0.283 m"
    assert (one.get_xlim(), one.get_ylim()) == (two.get_xlim(), two.get_ylim())


def test_tracks_and_truth_are_not_joined_from_one_session_to_the_next():
    _, axes = accuracy().axes
    _, track, truth, _, ranges = rows()[1]
    drawn = [line.get_xydata() for line in axes.lines if line.get_marker() == "None"]
    expected = [part for a, b in ranges for part in (track[a:b], truth[a:b])]
    assert all(np.array_equal(x, y) for x, y in zip(drawn, expected, strict=True))
    colours = [line.get_color() for line in axes.lines if line.get_marker() == "None"]
    assert colours == [md.SESSIONS[0], md.TRUTH, md.SESSIONS[1], md.TRUTH]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: md.plot_stages([]), "plot_stages: got no stage"),
        (lambda: md.plot_bindings([], TORUS), "plot_bindings: got no group"),
        (lambda: md.plot_accuracy([]), "plot_accuracy: got no row"),
        (
            lambda: md.plot_stages([FIRST._replace(session=np.zeros(3, int))]),
            "'First session' has 40 points and 3 session numbers",
        ),
        (
            lambda: md.plot_stages([FIRST._replace(session=np.full(40, 6))]),
            "from 6 to 6; give each point a session from 0 to 5",
        ),
        (
            lambda: md.plot_accuracy([("x", np.zeros((3, 2)), np.zeros((2, 2)), 0.0, [(0, 3)])]),
            "'x' has 3 points and 2 of truth",
        ),
    ],
)
def test_invalid_input_is_refused_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
