"""The figure of a tuning: its evidence, and the maps of the candidates."""

from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from neuroslam.config import BrainConfig
from neuroslam.errors import MapError, counted
from neuroslam.evaluation.trajectory import align
from neuroslam.figures.style import (
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    OTHER,
    STYLE,
    new_figure,
    plain_text,
    write_title,
)


class Tuning(Protocol):
    """A tuning, as far as it is drawn; see :class:`neuroslam.tuning.tune.Tuning`.

    Tuning imports figures, so the types of its parts cannot be named here.
    """

    config: BrainConfig
    chosen: str
    keys: np.ndarray
    revisits: Any
    motion: Any
    trials: list[Any]
    differences: Any


def plot_tuning(tuning: Tuning, name: str) -> Figure:
    """Draw the evidence of a tuning and the maps of its candidates, the chosen one first.

    Args:
        tuning: A finished tuning.
        name: Name of the source, for the title.

    Raises:
        ValueError: If there is no map.
    """
    if not tuning.trials or tuning.differences is None:
        raise ValueError("plot_tuning: the tuning has no map yet; finish it first")
    n, found = len(tuning.keys), len(tuning.revisits.same)
    title = f"{Path(name).name}: {100 * found / n:.0f} % of {n} key frames revisit a place"
    ordered = sorted(tuning.trials, key=lambda trial: trial.name != tuning.chosen)
    with mpl.rc_context(STYLE):
        figure = new_figure(13.0, 8.0, plain_text(title))
        axes = figure.subplots(2, 3)
        _draw_differences(axes[0, 0], tuning)
        _draw_field_of_view(axes[0, 1], tuning)
        maps = [axes[0, 2], *axes[1]]
        for trial, panel in zip(ordered, maps, strict=False):
            _draw_track(panel, trial, trial.name == tuning.chosen, ordered[0].track_xy)
        for panel in maps[len(ordered) :]:
            panel.set_axis_off()
    return figure


def _draw_differences(axes: Axes, tuning: Tuning) -> None:
    threshold = tuning.config.view.threshold
    names = ("neighbours in time", "revisits of a place", "different places")
    kinds = list(zip(names, tuning.differences, (ODOMETRY, MAP, LOOP), strict=True))
    top = max(float(values.max()) for _, values, _ in kinds if len(values))
    bins = np.linspace(0.0, top, 60)
    for label, values, colour in kinds:
        if len(values):
            weights = np.full(len(values), 100.0 / len(values))
            axes.hist(values, bins.tolist(), weights=weights, histtype="step", lw=1.6,
                      color=colour, label=label)  # fmt: skip
    axes.axvline(threshold, color=INK, ls="--", lw=1.0, label=f"threshold {threshold:g}")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set(title="Differences of two templates", xlabel="match error of two templates",
             ylabel="share of pairs (%)", xlim=(0.0, top))  # fmt: skip
    axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])  # room for the legend over the bars
    axes.legend(loc="upper left")


def _draw_field_of_view(axes: Axes, tuning: Tuning) -> None:
    axes.set_title("Closure of revisits in heading")
    motion = tuning.motion
    if motion is None:
        _write_none(axes, "revisits do not determine\nthe field of view")
        return
    axes.set(xlabel="horizontal field of view (°)", ylabel="mean of 1 - cos(turn of a loop)")
    axes.plot(motion.tried_deg, motion.error, color=MAP)
    used = tuning.config.odometry.fov_deg
    axes.axvline(motion.fov_deg, color=LOOP, ls=":", lw=1.4, label=f"valley: {motion.fov_deg:.0f}°")
    axes.axvline(used, color=INK, ls="--", lw=1.0, label=f"chosen: {used:.0f}°")
    axes.set_ylim(bottom=0.0)
    axes.legend()


def _write_none(axes: Axes, why: str) -> None:
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center")
    axes.set(xticks=[], yticks=[])


def _turned(track_xy: np.ndarray, onto_xy: np.ndarray) -> np.ndarray:
    """Turn a track to align it with another of the same frames, if they fix a rotation."""
    n = min(len(track_xy), len(onto_xy))
    both = np.isfinite(track_xy[:n, 0]) & np.isfinite(onto_xy[:n, 0])
    try:
        fit = align(track_xy[:n][both], onto_xy[:n][both], "rigid")
    except MapError:  # a robot that stood still
        return track_xy
    return np.asarray(track_xy @ fit.rotation.T)


def _figures(trial: Any) -> str:  # noqa: ANN401 - see Tuning
    if trial.refused:
        return f"refused: {trial.refused}"
    error = "" if np.isnan(trial.error) else f"error {100 * trial.error:.1f} %, "
    return f"{error}{counted(trial.experiences, 'experience')}"


def _draw_track(axes: Axes, trial: Any, chosen: bool, onto_xy: np.ndarray) -> None:  # noqa: ANN401
    write_title(axes, trial.name + (" (chosen)" if chosen else ""), _figures(trial))
    track_xy = _turned(trial.track_xy, onto_xy)
    axes.plot(*track_xy.T, color=MAP if chosen else ODOMETRY, lw=0.6)
    placed = track_xy[np.isfinite(track_xy[:, 0])]
    if len(placed):
        axes.plot(*placed[0], "o", color=OTHER, ms=5, label="start")
        axes.plot(*placed[-1], "s", color=INK, ms=4, label="end")
        axes.legend()
    axes.set(xlabel="x (arbitrary unit)", ylabel="y (arbitrary unit)")
    axes.set_aspect("equal", adjustable="datalim")
