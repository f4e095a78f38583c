"""Figures of semantic maps: queries for landmarks and areas, vectors to landmarks, beliefs."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
    """The answer of a map to a query for landmarks.

    Attributes:
        title: The query.
        similarity: Similarity of the answer with each position, ``(n_y, n_x)``.
        targets: Names of the landmarks that the query describes.
    """

    title: str
    similarity: np.ndarray
    targets: Sequence[str]


def style_of(landmark: Landmark) -> dict[str, Any]:
    """Return colour and marker of a landmark, from the words of its pointer."""
    return style_of_words(landmark.pointer)


def style_of_words(expression: str) -> dict[str, Any]:
    """Return colour and marker for an expression of attributes.

    Example:
        >>> style_of_words("BLUE * SQUARE + SMALL")
        {'marker': 's', 'color': '#0072B2'}
    """
    words = re.findall(r"\w+", expression.upper())
    colour = next((_COLOURS[w] for w in words if w in _COLOURS), INK)
    return {"marker": next((_MARKERS[w] for w in words if w in _MARKERS), "X"), "color": colour}


def draw_landmarks(
    axes: Axes, world: LandmarkWorld, only: Sequence[str] | None = None, size: float = 8.0
) -> None:
    """Draw point landmarks in their colours and shapes, and walls as areas.

    Args:
        axes: Axes in metres.
        world: World of the landmarks.
        only: Names of the landmarks to draw; ``None``: all.
        size: Size of the markers.
    """
    for landmark in world.landmarks:
        if only is not None and landmark.name not in only:
            continue
        if landmark.is_point:
            style: dict[str, Any] = {"ls": "none", "ms": size, "mec": "white", "mew": 0.9}
            axes.plot(*landmark.position_m[:2], zorder=6, **style, **style_of(landmark))
        else:
            for low, high in landmark.boxes_m:
                axes.add_patch(_box(low, high, fc=WALL, ec="#666666", lw=0.8, zorder=3))


def _box(low: np.ndarray, high: np.ndarray, **style: Any) -> Rectangle:  # noqa: ANN401 - matplotlib's
    width, height = np.asarray(high) - low
    return Rectangle((low[0], low[1]), width, height, **style)


def draw_world(axes: Axes, world: LandmarkWorld, path_m: np.ndarray | None = None) -> None:
    """Draw a world from above: landmarks, the areas from which they are visible, and a path."""
    if path_m is not None:
        axes.plot(*path_m.T, color=INK, lw=0.7, zorder=2)
    for landmark in world.landmarks:
        if landmark.is_point:
            x, y = landmark.position_m
            axes.add_patch(Circle((x, y), world.view_radius_m, fc="#ececec", ec="none", zorder=1))
            axes.annotate(
                landmark.name.replace("_", " ").lower(),
                (x, y),
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
    """Draw similarities as a heat map, and rings around the landmarks of the query."""
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
            ring: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 11, "mfc": "none"}
            axes.plot(*landmark.position_m, zorder=6, mec=INK, mew=1.2, **ring)
        else:
            for low, high in landmark.boxes_m:
                axes.add_patch(_box(low, high, fill=False, ec=INK, lw=1.1, zorder=6))
    _metric(axes, world)
    axes.grid(visible=False)
    write_title(axes, query.title)


def plot_queries(
    world: LandmarkWorld, path_m: np.ndarray | None, queries: Sequence[Query], title: str
) -> Figure:
    """Draw a world and the answers of its map to queries (the paper's Figs. 1 and 4).

    Args:
        world: A world in the plane.
        path_m: Path of the animal, ``(t, 2)``, or ``None``.
        queries: Queries and answers, drawn with one colour scale.
        title: Title of the whole figure.
    """
    n = len(queries) + 1
    columns = min((4, 3), key=lambda columns: -n % columns) if n > 3 else n  # few panels are empty
    rows = -(-n // columns)
    most = max(float(np.abs(q.similarity).max()) for q in queries)
    with mpl.rc_context(STYLE):
        figure = new_figure(3.5 * columns + 0.7, 3.55 * rows + 0.5, title)
        axes = figure.subplots(rows, columns, squeeze=False)
        draw_world(axes[0, 0], world, path_m)
        seen_from = "grey: in view there" if world.view_radius_m > 0 else ""
        write_title(axes[0, 0], "World", seen_from)
        for query, ax in zip(queries, axes.ravel()[1:], strict=False):
            draw_query(ax, world, query, most)
        for ax in axes.ravel()[n:]:
            ax.set_visible(False)
        bar = figure.colorbar(axes.ravel()[1].images[0], ax=axes, shrink=0.6, pad=0.01)
        bar.set_label("similarity with each position; rings: landmarks of the query")
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
        world: A world in the plane.
        position_m: Position of the animal at the end.
        estimates_m: Name of a landmark -> its position on the map.
        arrows_m: Name -> vector to it.
        time_s: ``(t,)``.
        similarity_error: Name -> one minus the similarity, ``(t,)``.
        distance_error: Name -> error of the vector in metres, ``(t,)``.
        first_seen_s: Name -> time of the first sight; earlier values are pale.
        title: Title of the whole figure.
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
        dot: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 7, "mfc": "white"}
        place.plot(*position_m, zorder=9, mec=INK, mew=1.3, **dot)
        write_title(place, "Map at the end", "x: recalled · arrows: vectors")
        alike.set(xlabel="time (s)", ylabel="1 - similarity", xlim=(0, time_s[-1]))
        later = [distance_error[n][time_s >= first_seen_s[n] + 1.0] for n in estimates_m]
        most = max((float(e.max()) for e in later if len(e)), default=1.0)
        far.set(xlabel="time (s)", ylabel="error (m)", xlim=(0, time_s[-1]))
        far.set_ylim(0, 1.5 * max(most, 1e-3))
        write_title(alike, "Dissimilarity of the vector", "pale: not yet seen")
        write_title(far, "Error of the vector", "axis: from 1 s after first sight")
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
    """Draw the area of a query and its answer (the paper's Fig. 6).

    Args:
        world: A world in the plane.
        low_m: Lower corner of the area.
        high_m: Upper corner.
        amounts: Name of a landmark -> similarity of its memory with the area.
        title: Title of the whole figure.
        threshold: Similarity above which the landmark is in the area.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 4.1, title)
        place, bars = figure.subplots(1, 2, width_ratios=(1.0, 1.1))
        draw_world(place, world)
        place.add_patch(_box(low_m, high_m, fc="#9a9a9a", alpha=0.45, zorder=2))
        write_title(place, "World and area")
        names = list(amounts)
        values = np.array([amounts[name] for name in names])
        colours = [MAP if v > threshold else "#c4c4c4" for v in values]
        bars.barh(np.arange(len(names)), values, color=colours, height=0.7)
        bars.set_yticks(np.arange(len(names)), [n.replace("_", " ").lower() for n in names])
        bars.axvline(threshold, color=LOOP, lw=1.2, ls="--", label=f"threshold {threshold:g}")
        bars.axvline(0.0, color=INK, lw=0.8)
        bars.set_ylim(len(names) - 0.5, -0.95)  # room for the legend
        bars.legend(loc="upper right", borderaxespad=0.1)
        bars.set_xlabel("amount in the area (1 inside, 0 outside)")
        write_title(bars, "Landmarks in the area", "blue: in the area")
    return figure


def plot_posterior(
    world: LandmarkWorld,
    path_m: np.ndarray,
    snapshots: Mapping[str, tuple[np.ndarray, np.ndarray]],
    title: str,
) -> Figure:
    """Draw the belief of an animal about its position, at some times (the paper's Fig. 3).

    Args:
        world: A world in the plane.
        path_m: The whole path, ``(t, 2)``.
        snapshots: Title of a panel -> probability density ``(n_y, n_x)`` and true position.
        title: Title of the whole figure.
    """
    (x0, x1), (y0, y1) = world.bounds_m
    with mpl.rc_context(STYLE):
        figure = new_figure(2.9 * len(snapshots) + 0.6, 3.9, title)
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
        bar.set_label("probability density / peak density; x: truth")
        bar.outline.set_visible(False)
    return figure


def _metric(axes: Axes, world: LandmarkWorld) -> None:
    (x0, x1), (y0, y1) = world.bounds_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal")
