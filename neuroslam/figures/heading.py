"""Figures of head-direction and speed cells: tuning, the bump over time, drift, rates.

Plain arrays in, a matplotlib ``Figure`` out; :func:`neuroslam.figures.style.save` writes it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neuroslam.figures.style import ACTIVITY, CURVES, INK, LOOP, MAP, STYLE, new_figure, write_title


class Bump(NamedTuple):
    """Activity of a ring over time, and headings beside it.

    Attributes:
        title: What is seen.
        time_s: ``(t,)``.
        rates: ``(t, n)``, cells evenly over the full turn.
        decoded_deg: Heading that the ring tells, ``(t,)``.
        other_deg: The true heading, or that of a cue, ``(t,)``.
        other: Which of them it is.
    """

    title: str
    time_s: np.ndarray
    rates: np.ndarray
    decoded_deg: np.ndarray
    other_deg: np.ndarray
    other: str


class Drift(NamedTuple):
    """Errors of several animals over time, and what theory expects of their spread.

    Attributes:
        title: What holds the heading.
        time_s: ``(t,)``.
        error_deg: ``(t, animals)``.
        expected_deg: Standard deviation expected, ``(t,)``, or nothing.
        expected: What it is of.
    """

    title: str
    time_s: np.ndarray
    error_deg: np.ndarray
    expected_deg: np.ndarray | None = None
    expected: str = ""


def plot_tuning(
    heading_deg: np.ndarray, rates: Mapping[str, np.ndarray], widths_deg: Mapping[str, float]
) -> Figure:
    """Draw tuning curves of some cells, and one of them with its widths.

    Args:
        heading_deg: ``(t,)``, rising.
        rates: Name of a cell -> its rate at each heading.
        widths_deg: What a width is of -> width of the last cell, in the order of the levels
            50 % and 2 % of the peak.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 3.4, "Tuning of head-direction cells")
        all_cells, one = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
        for (name, curve), colour in zip(rates.items(), CURVES, strict=False):
            all_cells.plot(heading_deg, curve, color=colour, lw=1.8, label=name)
        all_cells.set(xlabel="heading (°)", ylabel="rate (1 at the peak)", xlim=(0, 360))
        all_cells.set_xticks(range(0, 361, 60))
        all_cells.set_ylim(0.0, 1.08)
        write_title(all_cells, "Cells that prefer")
        all_cells.legend(loc="upper right", fontsize=8, ncols=1)
        curve = list(rates.values())[-1]
        middle = heading_deg[int(curve.argmax())]
        away = (heading_deg - middle + 180.0) % 360.0 - 180.0
        order = np.argsort(away)
        one.plot(away[order], curve[order], color=MAP, lw=2.0)
        triangle = np.clip(1.0 - np.abs(away[order]) / 46.0, 0.0, None)
        one.plot(
            away[order], triangle, color=INK, lw=1.1, ls="--", label="triangle, 92° at its base"
        )
        for (name, width), level, colour in zip(
            widths_deg.items(), (0.5, 0.02), (LOOP, CURVES[2]), strict=True
        ):
            one.plot([-width / 2, width / 2], [level, level], color=colour, lw=2.2, label=name)
        one.set(xlabel="heading away from preferred (°)", ylabel="rate", xlim=(-110, 110))
        one.set_xticks(range(-90, 91, 45))
        one.set(ylim=(0.0, 1.42), yticks=(0.0, 0.5, 1.0))
        write_title(one, "Width")
        one.legend(loc="upper center", fontsize=8)
    return figure


def plot_bumps(bumps: Sequence[Bump], title: str) -> Figure:
    """Draw the activity of rings over time, one above the other, with headings over it."""
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 2.6 * len(bumps) + 0.5, title)
        rows = np.atleast_1d(figure.subplots(len(bumps), 1))
        for bump, axes in zip(bumps, rows, strict=True):
            picture = _draw_bump(axes, bump)
        rows[-1].set_xlabel("time (s)")
        bar = figure.colorbar(picture, ax=rows.tolist(), pad=0.01, ticks=(0, 0.5, 1))
        bar.set_label("rate (1 at the peak)")
        bar.outline.set_visible(False)
    return figure


def _draw_bump(axes: Axes, bump: Bump) -> mpl.image.AxesImage:
    n = bump.rates.shape[1]
    half = 180.0 / n
    picture = axes.imshow(
        np.roll(bump.rates, n // 2, axis=1).T,
        ACTIVITY,
        origin="lower",
        aspect="auto",
        extent=(0.0, bump.time_s[-1], -180.0 - half, 180.0 - half),
        vmin=0.0,
        vmax=1.0,
    )
    for heading, colour, dash, width, name in (
        (bump.other_deg, "white", "-", 3.2, bump.other),
        (bump.decoded_deg, LOOP, "--", 1.6, "decoded heading"),
    ):
        axes.plot(bump.time_s, _cut_at_jumps(heading), color=colour, ls=dash, lw=width, label=name)
    axes.set(ylabel="preferred\ndirection (°)", yticks=(-180, -90, 0, 90, 180))
    axes.set_ylim(-180.0 - half, 180.0 - half)
    axes.grid(visible=False)
    write_title(axes, bump.title)
    box = axes.legend(loc="lower right", fontsize=8, frameon=True, facecolor="#44346a", ncols=2)
    for text in box.get_texts():
        text.set_color("white")
    return picture


def _cut_at_jumps(heading_deg: np.ndarray) -> np.ndarray:
    wrapped = (np.asarray(heading_deg) + 180.0) % 360.0 - 180.0
    cut = wrapped.copy()
    cut[1:][np.abs(np.diff(wrapped)) > 100.0] = np.nan
    return cut


def plot_drifts(drifts: Sequence[Drift], title: str) -> Figure:
    """Draw errors of animals over time, a panel for each way the heading is held."""
    with mpl.rc_context(STYLE):
        figure = new_figure(3.5 * len(drifts), 3.3, title)
        for drift, axes in zip(
            drifts, figure.subplots(1, len(drifts), squeeze=False)[0], strict=True
        ):
            minutes = drift.time_s / 60.0
            for k, error in enumerate(drift.error_deg.T):
                axes.plot(
                    minutes,
                    error,
                    color=MAP,
                    lw=0.7,
                    alpha=0.45,
                    label="one animal" if not k else None,
                )
            if drift.expected_deg is not None:
                for sign in (-1.0, 1.0):
                    axes.plot(
                        minutes,
                        sign * drift.expected_deg,
                        color=INK,
                        lw=1.6,
                        ls="--",
                        label=drift.expected if sign > 0 else None,
                    )
            spread = drift.error_deg.std(axis=1)
            for sign in (-1.0, 1.0):
                axes.plot(
                    minutes,
                    sign * spread,
                    color=LOOP,
                    lw=1.3,
                    label="± sd of the animals" if sign > 0 else None,
                )
            top = 1.6 * np.abs(drift.error_deg).max()
            axes.set(xlabel="time (min)", ylabel="error of the heading (°)", ylim=(-top, top))
            write_title(axes, drift.title)
            axes.legend(loc="upper left", fontsize=7.5)
    return figure


def plot_persistence(time_s: np.ndarray, moved_deg: np.ndarray, width_deg: np.ndarray) -> Figure:
    """Draw how far bumps moved without input, ``(t, bumps)``, and how wide one was, ``(t,)``."""
    with mpl.rc_context(STYLE):
        figure = new_figure(8.0, 3.0, "A bump without input")
        left, right = figure.subplots(1, 2)
        for k, moved in enumerate(moved_deg.T):
            left.plot(time_s / 60.0, 1e9 * moved, color=CURVES[k % len(CURVES)], lw=1.5)
        left.set(xlabel="time (min)", ylabel="moved ($10^{-9}$ °)")
        write_title(left, "Where it is", f"{moved_deg.shape[1]} bumps, on and between cells")
        right.plot(time_s / 60.0, width_deg, color=MAP, lw=1.8)
        middle = float(width_deg[-1])
        right.set(xlabel="time (min)", ylabel="width at half height (°)")
        right.set_ylim(middle - 1.0, middle + 1.0)
        write_title(right, "How wide it is")
    return figure


def plot_speed_cells(
    speed_m_s: np.ndarray,
    rates_hz: np.ndarray,
    run_m_s: np.ndarray,
    noisy_hz: np.ndarray,
    told_m_s: np.ndarray,
    scores: np.ndarray,
) -> Figure:
    """Draw rates of speed cells against speed, rates of one while running, and the speed told.

    Args:
        speed_m_s: Steady speeds, ``(k,)``.
        rates_hz: Rates at them, ``(k, n)``.
        run_m_s: Speeds of a run, ``(t,)``.
        noisy_hz: Rates of one cell then, ``(t,)``.
        told_m_s: Speed read from all, ``(t,)``.
        scores: Speed score of every cell in the run, ``(n,)``.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(10.5, 3.3, "Speed cells")
        steady, one, told = figure.subplots(1, 3)
        for k, rates in enumerate(rates_hz.T):
            steady.plot(speed_m_s, rates, color=CURVES[k % len(CURVES)], lw=1.0)
        steady.set(xlabel="running speed (m/s)", ylabel="rate (Hz)", xlim=(0, speed_m_s[-1]))
        steady.set_ylim(bottom=0.0)
        write_title(steady, "Tuning", f"{rates_hz.shape[1]} cells")
        one.plot(run_m_s, noisy_hz, ".", color=MAP, ms=2.0, alpha=0.5)
        one.set(xlabel="running speed (m/s)", ylabel="rate (Hz)")
        write_title(one, "One cell, noisy", f"scores {scores.min():.2f} to {scores.max():.2f}")
        told.plot(run_m_s, told_m_s, ".", color=MAP, ms=2.0, alpha=0.5, label="read from all cells")
        ends = [0.0, 1.05 * float(max(run_m_s.max(), told_m_s.max()))]
        told.plot(ends, ends, color=INK, lw=1.2, ls="--", label="equal")
        told.set(xlabel="running speed (m/s)", ylabel="speed told (m/s)", xlim=ends, ylim=ends)
        write_title(told, "Read-out")
        told.legend(loc="upper left", fontsize=8)
    return figure
