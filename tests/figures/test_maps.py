import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.font_manager import fontManager

from neuroslam.figures import maps, style
from neuroslam.geometry import integrate_velocities
from neuroslam.types import Pose, PoseEstimate

SQUARE = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 1.6], [2.0, 1.0, 3.1], [0.0, 1.0, 4.7]])
RING = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def frames(n=40):
    grown = np.arange(n) // 2 + 1
    return {
        "time_s": 0.1 * np.arange(n),
        "match_error": np.r_[-1.0, np.linspace(0.01, 0.09, n - 1)],
        "template": grown - 1,
        "n_templates": grown,
        "n_experiences": grown + 1,
        "n_links": grown + 2,
    }


def packet(n_theta=36, n_y=21, n_x=21):
    activity = np.zeros((n_theta, n_y, n_x))
    activity[9, 4:7, 11] = 0.25, 0.5, 0.25
    return activity


def pictures(n, shape=(12, 16)):
    rng = np.random.default_rng(0)
    return list(rng.integers(0, 255, (n, *shape), dtype=np.uint8))


def maze_run():
    rng = np.random.default_rng(1)
    odometry = integrate_velocities(np.ones(60), rng.normal(0, 1, 60), np.full(60, 0.1))
    return odometry[:, :2], odometry[::3]


def full_map():
    odometry, poses = maze_run()
    links = np.column_stack([np.arange(19), np.arange(1, 20)])
    walls = [[[-1.0, -1.0], [3.0, -1.0]], [[3.0, -1.0], [3.0, 4.0]]]
    return maps.plot_map(
        poses,
        np.vstack([links, [[0, 12], [3, 17]]]),
        odometry_xy=odometry,
        track_xy=odometry,
        truth_xy=1.1 * odometry + 0.2,
        walls=walls,
        current=Pose(*poses[-1]),
        title="A long enough title over both of the panels",
    )


def full_summary():
    odometry, poses = maze_run()
    image = pictures(1, (120, 160, 3))[0]
    return maps.plot_summary(
        poses,
        np.column_stack([np.arange(19), np.arange(1, 20)]),
        frames(),
        activity=packet(),
        estimate=PoseEstimate(11.0, 5.0, 9.0),
        image=image,
        template=image[:10, :60, 0],
        threshold=0.05,
        odometry_xy=odometry,
        truth_xy=poses[:, :2],
        current=Pose(*poses[-1]),
        title="demo",
    )


FIGURES = {
    "map": full_map,
    "map alone": lambda: maps.plot_map(SQUARE, RING),
    "pose cells": lambda: maps.plot_pose_cells(
        packet(), PoseEstimate(11.0, 5.0, 9.0), PoseEstimate(12.0, 5.0, 8.0)
    ),
    "view": lambda: maps.plot_frame_and_template(*pictures(2, (12, 60)), 0.031, 12),
    "signals": lambda: maps.plot_signals(frames(), threshold=0.05),
    "precision": lambda: maps.plot_precision_recall(
        {name: (np.linspace(1, 0.3, 9), np.linspace(0, 1, 9)) for name in ("ours", "theirs")}
    ),
    "sheet": lambda: maps.contact_sheet(pictures(7), [f"template {i}" for i in range(7)]),
    "summary": full_summary,
}


def all_axes(figure):
    return [axes for axes in figure.get_axes() if axes.get_visible()]


@pytest.mark.parametrize("name", FIGURES)
def test_nothing_is_clipped_and_titles_do_not_overlap(name):
    figure = FIGURES[name]()
    style.render(figure)
    page = figure.bbox
    for axes in all_axes(figure):
        words = [
            axes.title,
            axes._left_title,
            axes._right_title,
            axes.xaxis.label,
            axes.yaxis.label,
        ]
        boxes = [word.get_window_extent() for word in words if word.get_text()]
        legend = axes.get_legend()
        if legend:
            boxes.append(legend.get_window_extent())
        for box in boxes:
            assert page.x0 - 1 <= box.x0 <= box.x1 <= page.x1 + 1
            assert page.y0 - 1 <= box.y0 <= box.y1 <= page.y1 + 1
        for i, box in enumerate(boxes):
            for other in boxes[i + 1 :]:
                assert not box.padded(-1).overlaps(other)


@pytest.mark.parametrize("name", ["map", "pose cells", "summary"])
def test_the_same_figure_gives_the_same_bytes_whatever_the_users_style(name, tmp_path):
    style.save(FIGURES[name](), tmp_path / "a.png")
    with mpl.rc_context({"font.size": 20, "axes.grid": False, "axes.facecolor": "white"}):
        style.save(FIGURES[name](), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_drawing_leaves_pyplot_and_the_users_settings_alone():
    code = """
import sys, numpy as np, matplotlib
names = ("font.size", "axes.grid", "font.family", "image.interpolation")
before = [matplotlib.rcParams[name] for name in names]
from neuroslam.figures import maps, style
style.render(maps.plot_map(np.zeros((2, 3)), np.array([[0, 1]])))
print("matplotlib.pyplot" in sys.modules, before == [matplotlib.rcParams[name] for name in names])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


def segments(axes, colour):
    found = [c for c in axes.collections if isinstance(c, LineCollection)]
    return [
        s for c in found if to_hex(c.get_colors()[0]) == colour.lower() for s in c.get_segments()
    ]


def test_a_link_between_neighbours_in_time_is_blue_and_any_other_is_a_loop_closure():
    axes = maps.plot_map(SQUARE, RING).get_axes()[0]
    assert len(segments(axes, style.MAP)) == 3
    (loop,) = segments(axes, style.LOOP)
    np.testing.assert_array_equal(loop, SQUARE[[3, 0], :2])
    assert axes.get_title("right") == "4 experiences · 4 links · 1 loop closure"


def test_the_counts_of_a_real_map_are_in_its_title(shared):
    folder = shared / "refs/ratslam"
    read = {"delimiter": ",", "skiprows": 1}
    poses = np.loadtxt(folder / "usi_track1_sync_experiences.csv", **read)[:, 1:4]
    links = np.loadtxt(folder / "usi_track1_sync_links.csv", **read)[:, :2]
    v, w = np.loadtxt(shared / "data/usi_track1/odometry_vo.csv", **read).T
    track = integrate_velocities(v, w, np.full(len(v), 0.05))
    left, right = maps.plot_map(poses, links, odometry_xy=track[:, :2]).get_axes()
    assert left.get_title("right").startswith("2,873 frames · ")
    assert right.get_title("right") == "1,140 experiences · 1,418 links · 279 loop closures"
    assert len(segments(right, style.LOOP)) == 279
    assert len(segments(right, style.MAP)) == 1139


def test_axes_have_equal_scale():
    figure = full_map()
    style.render(figure)
    for axes in figure.get_axes():
        (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
        assert x1 - x0 == pytest.approx(y1 - y0)


def test_the_legend_lies_below_the_data():
    figure = full_map()
    style.render(figure)
    for axes in figure.get_axes():
        assert axes.get_legend().get_window_extent().y1 < axes.bbox.y0


def test_the_truth_and_its_walls_are_aligned_to_the_map_and_its_error_is_named():
    c, s = np.cos(0.5), np.sin(0.5)
    truth = 2.0 * SQUARE[:, :2] @ np.array([[c, -s], [s, c]]).T + [10.0, -5.0]
    here = Pose(0.0, 1.0, 0.25)
    figure = maps.plot_map(SQUARE, RING, truth_xy=truth, walls=[truth[:2]], current=here)
    axes = figure.get_axes()[0]
    np.testing.assert_array_equal(segments(axes, style.LOOP)[0], SQUARE[[3, 0], :2])
    np.testing.assert_allclose(segments(axes, style.WALL)[0], SQUARE[:2, :2], atol=1e-9)
    labels = {line.get_label(): line for line in axes.get_lines()}
    aligned = labels["truth: ATE 0.0 cm (similarity)"]
    np.testing.assert_allclose(aligned.get_xydata(), SQUARE[:, :2], atol=1e-9)
    robot = labels["robot now"]
    np.testing.assert_array_equal(robot.get_xydata()[0], here[:2])
    tip = robot._marker.get_transform().transform((1.0, 0.0))
    assert np.arctan2(tip[1], tip[0]) == pytest.approx(0.25)


def test_experiences_and_links_have_the_colour_of_their_session():
    names = ["monday.mp4", "tuesday.mp4", "wednesday.mp4"]
    session = np.array([0, 0, 1, 1])
    figure = maps.plot_map(
        SQUARE, RING, odometry_xy=SQUARE[2:, :2], session=session, session_names=names,
        odometry_of="tuesday.mp4",
    )  # fmt: skip
    left, right = figure.get_axes()
    dots = {
        to_hex(line.get_color()): line.get_xydata()
        for line in right.get_lines()
        if line.get_ls() == "None" and line.get_label().startswith("_") and len(line.get_xydata())
    }
    assert list(dots) == [colour.lower() for colour in style.SESSIONS[:2]]
    np.testing.assert_array_equal(dots[style.MAP.lower()], SQUARE[:2, :2])
    assert [len(segments(right, colour)) for colour in style.SESSIONS[:2]] == [1, 2]
    assert [text.get_text() for text in right.get_legend().get_texts()] == [
        "monday.mp4", "tuesday.mp4", "wednesday.mp4: no experience of its own", "loop closure",
        "start", "end",
    ]  # fmt: skip
    assert left.get_legend().get_texts()[0].get_text() == "odometry of tuesday.mp4"


def test_a_planned_path_is_marked_at_its_own_start_and_at_its_goal():
    figure = maps.plot_map(SQUARE, RING, current=Pose(1.0, 2.0, 0.0), planned=SQUARE[[2, 1], :2])
    (axes,) = figure.get_axes()
    marks = {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
    assert marks["start"] == [SQUARE[2, :2].tolist()]
    assert marks["goal"] == [SQUARE[1, :2].tolist()]
    assert "end" not in marks


def test_a_truth_that_does_not_fit_the_track_is_refused():
    with pytest.raises(ValueError, match="truth_xy has 7 points and the track 4; give track_xy"):
        maps.plot_map(SQUARE, RING, truth_xy=np.zeros((7, 2)))


def test_a_robot_at_rest_is_drawn_at_its_position():
    figure = maps.plot_map(SQUARE[:1], np.empty((0, 2)), truth_xy=[[0.0, 3.0]])
    labels = [line.get_label() for line in figure.get_axes()[0].get_lines()]
    assert "truth: ATE 3.00 m (not aligned)" in labels


def test_a_map_without_experiences_is_labelled_and_shows_no_robot():
    none, here = np.empty((0, 2)), Pose(0.0, 0.0, 0.0)
    figure = maps.plot_map(np.empty((0, 3)), none, odometry_xy=none, current=here)
    assert style.render(figure).std() > 0
    axes = figure.get_axes()[1]
    assert axes.get_title("right") == "0 experiences · 0 links · 0 loop closures"
    assert [text.get_text() for text in axes.texts] == ["no experiences"]
    assert (len(axes.get_lines()), len(axes.get_xticks())) == (0, 0)


def test_pose_cells_are_shown_from_above_and_from_the_side_with_all_their_activity():
    activity = packet()
    figure = maps.plot_pose_cells(activity, PoseEstimate(11.0, 5.0, 9.0))
    place, heading = figure.get_axes()[:2]
    np.testing.assert_array_equal(place.get_images()[0].get_array(), activity.sum(axis=0))
    np.testing.assert_array_equal(heading.get_images()[0].get_array(), activity.sum(axis=1))
    assert place.get_lines()[0].get_xydata().tolist() == [[11.0, 5.0]]
    assert heading.get_lines()[0].get_xydata().tolist() == [[11.0, 90.0]]
    x0, x1, y0, y1 = heading.get_images()[0].get_extent()
    assert (x0, x1, y0, y1) == (-0.5, 20.5, -5.0, 355.0)


def test_views_above_the_threshold_are_new_and_the_first_has_no_error():
    figure = maps.plot_signals(frames(), threshold=0.05)
    known, new, _ = figure.get_axes()[0].get_lines()
    assert np.nanmax(known.get_ydata()) <= 0.05 < np.min(new.get_ydata())
    assert np.isfinite(known.get_ydata()).sum() + len(new.get_ydata()) == 39
    labels = [text.get_text() for text in figure.get_axes()[1].get_legend().get_texts()]
    assert labels == ["22 links", "21 experiences", "20 templates"]


def test_without_views_there_are_no_matches_and_no_count_of_templates():
    blind = frames() | {"match_error": np.full(40, -1.0), "n_templates": np.zeros(40)}
    (memory,) = maps.plot_signals(blind, threshold=0.05).get_axes()
    assert memory.get_title("left") == "Size of the map"
    labels = [text.get_text() for text in memory.get_legend().get_texts()]
    assert labels == ["22 links", "21 experiences"]


def test_names_in_any_script_are_drawn_without_a_warning(tmp_path):
    figure = maps.plot_map(SQUARE, RING, title="東京 서울 🐀")
    style.render(figure)
    style.save(figure, tmp_path / "map.png")
    there = set(fontManager.get_font_names())
    assert set(style.STYLE["font.family"]) <= there


def test_the_first_view_has_no_match_error():
    image = pictures(1)[0]
    axes = maps.plot_frame_and_template(image, image / 255.0, -1.0, 0).get_axes()[1]
    assert axes.get_title("left") == "Template 0"
    assert axes.get_title("right") == "the first view"
    assert axes.get_images()[0].get_clim() == (0, 1)


def test_a_contact_sheet_holds_every_picture_unchanged():
    images = pictures(7, (12, 16, 3))
    axes = maps.contact_sheet(images, [f"frame {i}" for i in range(7)]).get_axes()[0]
    sheet = np.asarray(axes.get_images()[0].get_array())
    windows = np.lib.stride_tricks.sliding_window_view(sheet, (12, 16, 3))[:, :, 0]
    for image in images:
        assert (windows == image).all(axis=(2, 3, 4)).sum() == 1
    assert [text.get_text() for text in axes.texts] == [f"frame {i}" for i in range(7)]


@pytest.mark.parametrize(
    ("images", "titles", "said"),
    [
        ([], [], "got 0 images"),
        (pictures(2), ["one"], "2 images of shapes .* and 1 titles"),
        ([*pictures(1), *pictures(1, (5, 5))], ["a", "b"], r"\[\(5, 5\), \(12, 16\)\]"),
    ],
)
def test_a_sheet_of_unequal_pictures_is_refused(images, titles, said):
    with pytest.raises(ValueError, match=said):
        maps.contact_sheet(images, titles)


def test_a_summary_leaves_out_what_the_brain_does_not_have():
    figure = maps.plot_summary(SQUARE, RING, frames())
    names = [axes.get_title("left") for axes in figure.get_axes()]
    assert names == ["Experience map", "View matches", "Size of the map"]
    assert style.render(figure).shape == (1000, 1400, 3)


def test_a_length_is_stated_in_metres_only():
    odometry, poses = maze_run()
    for unit, states in (("m", True), ("arbitrary unit", False)):
        figure = maps.plot_map(poses, RING[:0], odometry_xy=odometry, unit=unit)
        written = [text.get_text() for text in figure.axes[0].findobj(mpl.text.Text)]
        assert (
            any(text.startswith("60 frames") and text.endswith(" m") for text in written) == states
        )
