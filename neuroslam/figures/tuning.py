"""The figure of a tuning: candidates, the choice, and the map before and after."""

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
    write_decimals,
    write_title,
)


class Tuning(Protocol):
    """A tuning, as far as it is drawn; see :class:`neuroslam.tuning.tune.Tuning`.

    Tuning imports figures, so the types of its parts cannot be named here.
    """

    config: BrainConfig
    keys: np.ndarray
    changes: dict[str, tuple[Any, Any, str]]
    revisits: Any
    views: list[Any]
    motion: Any
    trials: list[Any]
    before: Any
    after: Any


def plot_tuning(tuning: Tuning, name: str) -> Figure:
    """Draw the candidates and choices of a tuning, and the map before and after.

    Args:
        tuning: A finished tuning.
        name: Name of the source, for the title.

    Raises:
        ValueError: If a map, before or after, is missing.
    """
    before, after = tuning.before, tuning.after
    if before is None or after is None:
        raise ValueError("plot_tuning: the tuning has no map before or after; finish it first")
    n, found = len(tuning.keys), len(tuning.revisits.same)
    title = f"{Path(name).name}: {100 * found / n:.0f} % of {n} key frames revisit a place"
    with mpl.rc_context(STYLE):
        figure = new_figure(13.0, 8.0, plain_text(title))
        axes = figure.subplots(2, 3)
        _draw_differences(axes[0, 0], tuning)
        _draw_templates(axes[0, 1], tuning)
        _draw_field_of_view(axes[0, 2], tuning)
        _draw_maps(axes[1, 0], tuning)
        unit = "arbitrary unit" if "odometry.speed_scaling_m_s" in tuning.changes else "m"
        turned = _turned(after.track_xy, before.track_xy)
        _draw_track(axes[1, 1], _counts(before), before.track_xy, "Map before", unit)
        _draw_track(axes[1, 2], _counts(after), turned, "Map found", unit)
        if turned is not after.track_xy:
            axes[1, 2].set_xlabel(f"x ({unit}), aligned to the map before")
    return figure


def _draw_differences(axes: Axes, tuning: Tuning) -> None:
    score, threshold = tuning.views[0], tuning.config.view.threshold
    kinds = (("neighbours in time", score.neighbours, ODOMETRY), ("revisits of a place",
             score.revisits, MAP), ("different places", score.others, LOOP))  # fmt: skip
    top = max(float(values.max()) for _, values, _ in kinds if len(values))
    bins = np.linspace(0.0, top, 60)
    for label, values, colour in kinds:
        if len(values):
            weights = np.full(len(values), 100.0 / len(values))
            axes.hist(values, bins.tolist(), weights=weights, histtype="step", lw=1.6,
                      color=colour, label=label)  # fmt: skip
    axes.axvline(threshold, color=INK, ls="--", lw=1.0, label=f"threshold {threshold:g}")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set(title="Differences of two templates", xlabel="mean difference (grey levels, 0 to 1)",
             ylabel="share of pairs (%)", xlim=(0.0, top))  # fmt: skip
    axes.legend()


def _draw_templates(axes: Axes, tuning: Tuning) -> None:
    axes.set_title("Place recognition by single templates")
    if not len(tuning.revisits.same):
        _write_none(axes, "no revisits in this drive")
        return
    axes.set(xlabel="average precision", xlim=(0.0, 1.15))
    axes.set_xticks(np.linspace(0.0, 1.0, 6))
    seen: dict[str, float] = {}
    for score in tuning.views:
        config = score.config
        top, end = (0, -1) if config.crop is None else config.crop[2:]
        rows = f"rows {top} to {end}" if end >= 0 else f"rows from {top}" if top else "all rows"
        patch = f", patch {config.patch_radius}" if config.patch_radius else ""
        of = "" if config.features == "grey" else f"{config.features}\n"
        of = f"{config.orientations} orientations\n" if config.orientations else of
        label = f"{of}{config.template_width} x {config.template_height}, {rows}{patch}"
        seen.setdefault(label, score.average_precision)
    chosen = next(iter(seen))
    ordered = sorted(seen.items(), key=lambda item: item[1])
    colours = [MAP if label == chosen else "#b9cfe0" for label, _ in ordered]
    labels, scores = zip(*ordered, strict=True)
    bars = axes.barh(labels, scores, height=0.7, color=colours)
    axes.bar_label(bars, fmt="%.3f", padding=2, fontsize=7)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", labelsize=7)


def _draw_field_of_view(axes: Axes, tuning: Tuning) -> None:
    axes.set_title("Closure of loops in heading")
    motion = tuning.motion
    if motion is None:
        _write_none(axes, "not determined by this drive")
        return
    axes.set(xlabel="horizontal field of view (°)", ylabel="mean of 1 - cos(turn of a loop)")
    axes.plot(motion.tried_deg, motion.error, color=MAP)
    axes.axvline(motion.fov_deg, color=INK, ls="--", lw=1.0, label=f"{motion.fov_deg:.0f}°")
    axes.set_ylim(bottom=0.0)
    axes.legend()


def _draw_maps(axes: Axes, tuning: Tuning) -> None:
    axes.set_title("Inconsistency of maps")
    if not tuning.trials:
        _write_none(axes, "no revisits in this drive")
        return
    axes.set(xlabel="match threshold of views", ylabel="distance of revisits / of other pairs")
    energies = sorted({trial.config.pose_cells.inject_energy for trial in tuning.trials})
    for energy, colour in zip(energies, (OTHER, MAP, LOOP, ODOMETRY), strict=False):
        some = [t for t in tuning.trials if t.config.pose_cells.inject_energy == energy]
        axes.plot([t.config.view.threshold for t in some], [t.inconsistency for t in some],
                  ".-", color=colour, label=f"injection {energy:g}")  # fmt: skip
    axes.axvline(tuning.config.view.threshold, color=INK, ls="--", lw=1.0, label="chosen")
    axes.set_yscale("log")
    write_decimals(axes.yaxis)
    axes.legend()


def _write_none(axes: Axes, why: str) -> None:
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center")
    axes.set(xticks=[], yticks=[])


def _turned(track_xy: np.ndarray, onto_xy: np.ndarray) -> np.ndarray:
    """Turn a track to align it with another of the same frames, if they fix a rotation."""
    try:
        return np.asarray(track_xy @ align(track_xy, onto_xy, "rigid").rotation.T)
    except MapError:  # other frames, or a robot that stood still
        return track_xy


def _counts(trial: Any) -> str:  # noqa: ANN401 - see Tuning
    off = trial.inconsistency
    score = "" if np.isnan(off) else f", inconsistency {off:.3f}"
    return f"{counted(trial.n_experiences, 'experience')}{score}"


def _draw_track(axes: Axes, counts: str, track_xy: np.ndarray, title: str, unit: str) -> None:
    write_title(axes, title, counts)
    axes.plot(*track_xy.T, color=MAP, lw=0.6)
    axes.plot(*track_xy[0], "o", color=OTHER, ms=5, label="start")
    axes.plot(*track_xy[-1], "s", color=INK, ms=4, label="end")
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend()
