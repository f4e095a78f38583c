"""Figure of an answer of a semantic map: landmarks, walls, regions, and what was found."""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from neuroslam.errors import counted
from neuroslam.figures.density import SIGMAS, Spread, draw_ellipse
from neuroslam.figures.landmarks import style_of_words
from neuroslam.figures.style import (
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    STYLE,
    WALL,
    new_figure,
    write_title,
)
from neuroslam.spiking.ask import Answer, Found

_LABELLED = 40  # landmarks; more are labelled only if they are found
_MARGIN = 0.08  # around all that is drawn, as a share of its size


def plot_answer(
    answer: Answer, positions_m: np.ndarray, links: np.ndarray, unit: str = "m"
) -> Figure:
    """Draw all that a semantic map knows, and the answer to a question.

    Args:
        answer: From :func:`neuroslam.spiking.ask.ask`.
        positions_m: Positions of the experiences, ``(n, 2)``.
        links: Pairs of linked experiences, ``(l, 2)``.
        unit: Of lengths on the map.
    """
    with mpl.rc_context(STYLE):
        low, high = _extent(answer, positions_m)
        size = high - low
        scale = min(9.0 / float(size[0]), 7.0 / float(size[1]))  # inches a metre
        width, height = np.maximum(scale * size, (3.2, 1.6)).tolist()
        figure = new_figure(width + 0.8, height + 1.6, None)  # room for labels, title, legend
        axes = figure.subplots()
        if len(links):
            lines = LineCollection([*positions_m[links]], colors=ODOMETRY, lw=0.8, zorder=1)
            lines.set(alpha=0.6, label="experience map")
            axes.add_collection(lines)
        found = {one.name for one in answer.found}
        for one in answer.everything:
            _draw(axes, one, one.name in found)
        _label(axes, answer.everything, found, high - low)
        _draw_question(axes, answer.question.form, answer.question.numbers)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
        axes.set_aspect("equal")
        text = answer.question.text.strip()
        title = text[:1].upper() + text[1:]
        write_title(axes, f"{title[:60]}: {counted(len(found), 'answer')}")
        handles, _ = axes.get_legend_handles_labels()
        if handles:
            figure.legend(loc="outside lower center", ncols=4)
    return figure


def _extent(answer: Answer, positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the plane that is drawn."""
    points: list[Any] = [positions_m, *([one.position_m] for one in answer.everything)]
    points += [one.corners_m for one in answer.everything if one.corners_m]
    for one in answer.everything:
        if one.covariance_m2:
            half = SIGMAS[-1] * np.sqrt(np.diagonal(np.array(one.covariance_m2)))
            points.append(np.array(one.position_m) + np.stack([-half, half]))
    if answer.question.numbers:
        points.append(np.reshape(answer.question.numbers, (-1, 2)))
    every = np.concatenate([np.reshape(p, (-1, 2)) for p in points if len(p)] or [np.zeros((1, 2))])
    low, high = every.min(0), every.max(0)
    margin = np.maximum(_MARGIN * (high - low).max(), 0.5)
    return low - margin, high + margin


def _draw(axes: Axes, one: Found, is_found: bool) -> None:
    strong: dict[str, Any] = {"alpha": 1.0 if is_found else 0.35}
    corners = np.array(one.corners_m)
    colour = style_of_words(one.words)["color"]
    if one.kind == "wall":
        axes.plot(*corners.T, color=colour, lw=4.0, solid_capstyle="butt", zorder=3, **strong)
    elif one.kind == "region":
        fill = WALL if colour == INK else colour
        axes.add_patch(
            Polygon(corners, fc=fill, ec=INK, lw=0.8, alpha=0.5 if is_found else 0.18, zorder=2)
        )
    else:
        style: dict[str, Any] = {"ls": "none", "ms": 9, "mec": "white", "mew": 0.9, "zorder": 6}
        axes.plot(*one.position_m, **style, **style_of_words(one.words), **strong)
    if one.covariance_m2:
        spread = Spread(np.array(one.position_m), np.array(one.covariance_m2))
        label = _once(axes, "1 and 2 standard deviations")
        draw_ellipse(axes, spread, label=label, colour=MAP if is_found else ODOMETRY)
    if is_found and one.kind == "landmark":
        ring: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 16, "mfc": "none", "mew": 1.4}
        axes.plot(*one.position_m, mec=LOOP, zorder=7, label=_once(axes, "found"), **ring)


def _once(axes: Axes, label: str) -> str:
    """Return a label for the legend the first time only."""
    return "_" + label if label in axes.get_legend_handles_labels()[1] else label


def _label(axes: Axes, everything: Sequence[Found], found: set[str], size_m: np.ndarray) -> None:
    """Write names; of names that would overlap only the first, those found before others."""
    written: list[np.ndarray] = []
    ordered = sorted(everything, key=lambda one: one.name not in found)
    for one in ordered:
        if len(everything) > _LABELLED and one.name not in found:
            continue
        at = np.array(_middle(one)) / size_m
        width = 0.016 * len(one.name)
        if any(abs(at[0] - p[0]) < width and abs(at[1] - p[1]) < 0.045 for p in written):
            continue
        written.append(at)
        axes.annotate(
            one.name.replace("_", " ").lower(),
            _middle(one),
            (0, -9 if one.kind == "landmark" else 0),
            textcoords="offset points",
            ha="center",
            va="top" if one.kind == "landmark" else "center",
            fontsize=7,
            color=INK if one.name in found else "#777777",
            bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 0.8},
            zorder=8,
        )


def _middle(one: Found) -> tuple[float, float]:
    """Return where the name is written: of a wall, the middle of its longest part."""
    if one.kind != "wall":
        return one.position_m
    corners = np.array(one.corners_m)
    longest = int(np.hypot(*np.diff(corners, axis=0).T).argmax())
    x, y = corners[longest : longest + 2].mean(0).tolist()
    return x, y


def _draw_question(axes: Axes, form: str, numbers: Sequence[float]) -> None:
    if form == "at":
        style: dict[str, Any] = {"ls": "none", "marker": "+", "ms": 14, "mew": 2.0}
        axes.plot(*numbers, color=LOOP, zorder=9, label="position asked for", **style)
    elif form == "box":
        x0, y0, x1, y1 = numbers
        style = {"fc": "none", "ec": LOOP, "lw": 1.5, "ls": "--", "zorder": 5}
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, label="box asked for", **style))
