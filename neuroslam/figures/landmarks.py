"""Figures of semantic maps: what is where, what is there, and how far it is."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from neuroslam.figures.style import (
    CURVES,
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    STYLE,
    WALL,
    new_figure,
    write_title,
)
from neuroslam.worlds.landmarks import Landmark, LandmarkWorld

_COLOURS = {
    "RED": "#D62728",
    "BLUE": "#0072B2",
    "GREEN": "#009E73",
    "ORANGE": "#E69F00",
    "PURPLE": "#9467BD",
    "BLACK": "#222222",
    "GREY": "#8c8c8c",
}
_MARKERS = {"SQUARE": "s", "TRIANGLE": "^", "CIRCLE": "o", "STAR": "*", "DIAMOND": "D"}
_SIMILARITY = "RdBu_r"


class Query(NamedTuple):
    """What a map answers to a question for places.

    Attributes:
        title: The question.
        similarity: With each place, ``(n_y, n_x)``.
        targets: Names of the landmarks that are meant.
    """

    title: str
    similarity: np.ndarray
    targets: Sequence[str]


def look_of(landmark: Landmark) -> dict[str, object]:
    """Return colour and marker of a landmark, as its words say them."""
    words = landmark.pointer.replace("*", " ").replace("+", " ").upper().split()
    colour = next((_COLOURS[w] for w in words if w in _COLOURS), INK)
    return {"marker": next((_MARKERS[w] for w in words if w in _MARKERS), "X"), "color": colour}


def draw_landmarks(
    axes: Axes, world: LandmarkWorld, only: Sequence[str] | None = None, size: float = 8.0
) -> None:
    """Draw points in their colours and shapes, and walls as areas.

    Args:
        axes: In metres.
        world: All of them.
        only: Names of those that are drawn; ``None``: all.
        size: Of the markers.
    """
    for landmark in world.landmarks:
        if only is not None and landmark.name not in only:
            continue
        if landmark.is_point:
            style = {"ls": "none", "ms": size, "mec": "white", "mew": 0.9, "zorder": 6}
            axes.plot(*landmark.position_m[:2], **style, **look_of(landmark))
        else:
            for low, high in landmark.boxes_m:
                box = Rectangle(low, *(high - low), fc=WALL, ec="#666666", lw=0.8, zorder=3)
                axes.add_patch(box)


def draw_world(axes: Axes, world: LandmarkWorld, path_m: np.ndarray | None = None) -> None:
    """Draw a world from above: landmarks, from where each is seen, and a path."""
    if path_m is not None:
        axes.plot(*path_m.T, color=INK, lw=0.7, zorder=2)
    for landmark in world.landmarks:
        if landmark.is_point:
            axes.add_patch(
                Circle(landmark.position_m, world.view_radius_m, fc="#ececec", ec="none", zorder=1)
            )
            axes.annotate(
                landmark.name.replace("_", " ").lower(),
                landmark.position_m,
                (0, -11),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=7,
                zorder=7,
            )
    draw_landmarks(axes, world)
    _metric(axes, world)


def draw_query(axes: Axes, world: LandmarkWorld, query: Query, most: float) -> None:
    """Draw similarities as a heat map, and rings around the places that are meant."""
    (x0, x1), (y0, y1) = world.bounds_m
    axes.imshow(
        query.similarity,
        _SIMILARITY,
        origin="lower",
        extent=(x0, x1, y0, y1),
        vmin=-most,
        vmax=most,
        interpolation="bilinear",
    )
    for name in query.targets:
        landmark = world.named(name)
        if landmark.is_point:
            ring = {"ls": "none", "marker": "o", "ms": 11, "mfc": "none", "mec": INK, "mew": 1.2}
            axes.plot(*landmark.position_m, zorder=6, **ring)
        else:
            for low, high in landmark.boxes_m:
                axes.add_patch(Rectangle(low, *(high - low), fill=False, ec=INK, lw=1.1, zorder=6))
    _metric(axes, world)
    axes.grid(visible=False)
    write_title(axes, query.title)


def plot_queries(
    world: LandmarkWorld, path_m: np.ndarray | None, queries: Sequence[Query], title: str
) -> Figure:
    """Draw a world and what its map answers (the paper's Figs. 1 and 4).

    Args:
        world: In the plane.
        path_m: Of the animal, ``(t, 2)``, or ``None``.
        queries: All with one scale.
        title: Heading of the whole figure.
    """
    n = len(queries) + 1
    columns = min(3, n)
    rows = -(-n // columns)
    most = max(float(np.abs(q.similarity).max()) for q in queries)
    with mpl.rc_context(STYLE):
        figure = new_figure(3.5 * columns + 0.7, 3.55 * rows + 0.5, title)
        axes = figure.subplots(rows, columns, squeeze=False)
        draw_world(axes[0, 0], world, path_m)
        seen_from = "grey: from where a landmark is seen" if world.view_radius_m > 0 else ""
        write_title(axes[0, 0], "World", seen_from)
        for query, ax in zip(queries, axes.ravel()[1:], strict=False):
            draw_query(ax, world, query, most)
        for ax in axes.ravel()[n:]:
            ax.set_visible(False)
        bar = figure.colorbar(axes.ravel()[1].images[0], ax=axes, shrink=0.6, pad=0.01)
        bar.set_label("similarity with each place; rings: what was asked for")
        bar.outline.set_visible(False)
    return figure


def plot_vectors(
    world: LandmarkWorld,
    position_m: np.ndarray,
    estimates_m: Mapping[str, np.ndarray],
    arrows_m: Mapping[str, np.ndarray],
    time_s: np.ndarray,
    similarity_error: Mapping[str, np.ndarray],
    distance_error: Mapping[str, np.ndarray],
    first_seen_s: Mapping[str, float],
    title: str,
) -> Figure:
    """Draw the vectors to all landmarks and their errors over time (the paper's Fig. 5).

    Args:
        world: In the plane.
        position_m: Of the animal at the end.
        estimates_m: Name -> where the map has it.
        arrows_m: Name -> vector to it.
        time_s: ``(t,)``.
        similarity_error: Name -> one minus the similarity, ``(t,)``.
        distance_error: Name -> in metres, ``(t,)``.
        first_seen_s: Name -> when it was first seen; before, curves are pale.
        title: Heading of the whole figure.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(12.5, 4.3, title)
        place, alike, far = figure.subplots(1, 3, width_ratios=(1.1, 1.2, 1.2))
        draw_landmarks(place, world)
        _metric(place, world)
        for k, (name, at) in enumerate(estimates_m.items()):
            colour = CURVES[k % len(CURVES)]
            place.plot(*at, ls="none", marker="x", ms=9, mew=1.8, color=colour, zorder=8)
            place.annotate(
                "",
                position_m + arrows_m[name],
                position_m,
                arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.3},
                zorder=7,
            )
            for ax, errors in ((alike, similarity_error), (far, distance_error)):
                known = time_s >= first_seen_s[name]
                ax.plot(time_s[~known], errors[name][~known], color="#dddddd", lw=0.7, zorder=1)
                label = name.replace("_", " ").lower()
                ax.plot(time_s[known], errors[name][known], color=colour, lw=1.1, label=label)
        dot = {"ls": "none", "marker": "o", "ms": 7, "mfc": "white", "mec": INK, "mew": 1.3}
        place.plot(*position_m, zorder=9, **dot)
        write_title(place, "At the end", "x: recalled · arrows: vectors")
        alike.set(xlabel="time (s)", ylabel="1 - similarity", xlim=(0, time_s[-1]))
        known = [distance_error[n][time_s >= first_seen_s[n] + 1.0] for n in estimates_m]
        most = max((float(e.max()) for e in known if len(e)), default=1.0)
        far.set(xlabel="time (s)", ylabel="distance (m)", xlim=(0, time_s[-1]))
        far.set_ylim(0, 1.5 * max(most, 1e-3))
        write_title(alike, "Error of the vector", "pale: not yet seen")
        write_title(far, "Error of where it points", "scaled to a second after the first sight")
        handles, labels = alike.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(labels)))
    return figure


def plot_area(
    world: LandmarkWorld,
    low_m: np.ndarray,
    high_m: np.ndarray,
    amounts: Mapping[str, float],
    title: str,
    threshold: float = 0.5,
) -> Figure:
    """Draw an area that was asked about and what is said to be there (the paper's Fig. 6).

    Args:
        world: In the plane.
        low_m: Lower corner of the area.
        high_m: Upper corner.
        amounts: Name -> how much of it is there.
        title: Heading of the whole figure.
        threshold: From which on it counts as there.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 4.1, title)
        place, bars = figure.subplots(1, 2, width_ratios=(1.0, 1.1))
        draw_world(place, world)
        place.add_patch(
            Rectangle(low_m, *(np.asarray(high_m) - low_m), fc="#9a9a9a", alpha=0.45, zorder=2)
        )
        write_title(place, "World and area")
        names = list(amounts)
        values = np.array([amounts[name] for name in names])
        colours = [MAP if v > threshold else "#c4c4c4" for v in values]
        bars.barh(np.arange(len(names)), values, color=colours, height=0.7)
        bars.set_yticks(np.arange(len(names)), [n.replace("_", " ").lower() for n in names])
        bars.invert_yaxis()
        bars.axvline(threshold, color=LOOP, lw=1.2, ls="--")
        bars.axvline(0.0, color=INK, lw=0.8)
        bars.set_xlabel("how much of it is in the area")
        write_title(bars, "What is there?", "blue: above the dashed threshold")
    return figure


def plot_posterior(
    world: LandmarkWorld,
    path_m: np.ndarray,
    snapshots: Mapping[str, tuple[np.ndarray, np.ndarray]],
    title: str,
) -> Figure:
    """Draw where an animal believes to be, at some times (the paper's Fig. 3).

    Args:
        world: In the plane.
        path_m: All of it, ``(t, 2)``.
        snapshots: What a panel is headed with -> density ``(n_y, n_x)`` and true position.
        title: Heading of the whole figure.
    """
    (x0, x1), (y0, y1) = world.bounds_m
    with mpl.rc_context(STYLE):
        figure = new_figure(2.9 * len(snapshots) + 0.6, 3.3, title)
        axes = figure.subplots(1, len(snapshots), squeeze=False, sharey=True).ravel()
        for ax, (name, (density, truth)) in zip(axes, snapshots.items(), strict=True):
            ax.imshow(
                density / density.max(),
                "Blues",
                origin="lower",
                extent=(x0, x1, y0, y1),
                interpolation="bilinear",
            )
            ax.plot(*path_m.T, color=ODOMETRY, lw=0.6)
            ax.plot(*truth, ls="none", marker="x", ms=9, mew=2, color=LOOP)
            _metric(ax, world)
            ax.grid(visible=False)
            write_title(ax, name)
        for ax in axes[1:]:
            ax.set_ylabel("")
        bar = figure.colorbar(axes[0].images[0], ax=axes, shrink=0.75, pad=0.01)
        bar.set_label("density over its peak; x: truth")
        bar.outline.set_visible(False)
    return figure


def _metric(axes: Axes, world: LandmarkWorld) -> None:
    (x0, x1), (y0, y1) = world.bounds_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal")
