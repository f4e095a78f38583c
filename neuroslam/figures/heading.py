"""Figures of head-direction and speed cells: tuning, the bump over time, drift, rates.

Plain arrays in, a matplotlib ``Figure`` out; :func:`neuroslam.figures.style.save` writes it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from neuroslam.figures.style import ACTIVITY, CURVES, INK, LOOP, MAP, STYLE, new_figure, write_title


class Bump(NamedTuple):
    """Activity of a ring over time, and headings to compare with.

    Attributes:
        title: Title of the panel.
        time_s: ``(t,)``.
        rates: Rates of the cells, spaced evenly over the full turn, ``(t, n)``.
        decoded_deg: Heading decoded from the ring, ``(t,)``.
        other_deg: The true heading, or that of a cue, ``(t,)``.
        other: Label of ``other_deg``.
    """

    title: str
    time_s: np.ndarray
    rates: np.ndarray
    decoded_deg: np.ndarray
    other_deg: np.ndarray
    other: str


class Drift(NamedTuple):
    """Heading errors of several animals over time, and the expected standard deviation.

    Attributes:
        title: The cue that corrects the heading.
        time_s: ``(t,)``.
        error_deg: ``(t, animals)``.
        expected_deg: Expected standard deviation, ``(t,)``, or ``None``.
        expected: Label of ``expected_deg``.
    """

    title: str
    time_s: np.ndarray
    error_deg: np.ndarray
    expected_deg: np.ndarray | None = None
    expected: str = ""


def plot_tuning(
    heading_deg: np.ndarray, rates: Mapping[str, np.ndarray], widths_deg: Mapping[str, float]
) -> Figure:
    """Draw tuning curves of some cells, and the widths of one of them.

    Args:
        heading_deg: ``(t,)``, rising.
        rates: Preferred direction of a cell -> its rate at each heading.
        widths_deg: Label of a width -> width of the last cell, at 50 % and at 2 % of the peak.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 3.4, "Tuning curves of head-direction cells")
        all_cells, one = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
        for (name, curve), colour in zip(rates.items(), CURVES, strict=False):
            all_cells.plot(heading_deg, curve, color=colour, lw=1.8, label=name)
        all_cells.set(xlabel="heading (°)", ylabel="firing rate / peak rate", xlim=(0, 360))
        all_cells.set_xticks(range(0, 361, 60))
        all_cells.set_ylim(0.0, 1.42)
        all_cells.set_yticks(np.linspace(0.0, 1.0, 6))
        write_title(all_cells, "Five cells")
        all_cells.legend(loc="upper center", fontsize=8, ncols=5, title="preferred direction")
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
        one.set(xlabel="heading minus preferred direction (°)", xlim=(-110, 110))
        one.set_ylabel("firing rate / peak rate")
        one.set_xticks(range(-90, 91, 45))
        one.set(ylim=(0.0, 1.42), yticks=(0.0, 0.5, 1.0))
        write_title(one, "Tuning width")
        one.legend(loc="upper center", fontsize=8)
    return figure


def plot_bumps(bumps: Sequence[Bump], title: str) -> Figure:
    """Draw the activity of rings over time, one above the other, and headings over it."""
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 2.6 * len(bumps) + 0.5, title)
        rows = np.atleast_1d(figure.subplots(len(bumps), 1))
        pictures = [_draw_bump(axes, bump) for bump, axes in zip(bumps, rows, strict=True)]
        rows[-1].set_xlabel("time (s)")
        bar = figure.colorbar(pictures[-1], ax=rows.tolist(), pad=0.01, ticks=(0, 0.5, 1))
        bar.set_label("firing rate / peak rate")
        bar.outline.set_visible(False)
    return figure


def _draw_bump(axes: Axes, bump: Bump) -> AxesImage:
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
    """Draw heading errors of animals over time, a panel for each kind of cue."""
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
            axes.set(xlabel="time (min)", ylabel="heading error (°)", ylim=(-top, top))
            write_title(axes, drift.title)
            axes.legend(loc="upper left", fontsize=7.5)
    return figure


def plot_persistence(time_s: np.ndarray, moved_deg: np.ndarray, width_deg: np.ndarray) -> Figure:
    """Draw the drift of bumps without input, ``(t, bumps)``, and the width of one, ``(t,)``."""
    with mpl.rc_context(STYLE):
        figure = new_figure(8.0, 3.0, "Persistence of a bump without input")
        left, right = figure.subplots(1, 2)
        for k, moved in enumerate(moved_deg.T):
            left.plot(time_s / 60.0, 1e9 * moved, color=CURVES[k % len(CURVES)], lw=1.5)
        left.set(xlabel="time (min)", ylabel="displacement ($10^{-9}$ °)")
        write_title(left, "Drift", f"{moved_deg.shape[1]} bumps, on and between cells")
        right.plot(time_s / 60.0, width_deg, color=MAP, lw=1.8)
        middle = float(width_deg[-1])
        right.set(xlabel="time (min)", ylabel="width at half height (°)")
        right.set_ylim(middle - 1.0, middle + 1.0)
        write_title(right, "Width")
    return figure


def plot_speed_cells(
    speed_m_s: np.ndarray,
    rates_hz: np.ndarray,
    run_m_s: np.ndarray,
    noisy_hz: np.ndarray,
    decoded_m_s: np.ndarray,
    scores: np.ndarray,
) -> Figure:
    """Draw tuning of speed cells, noisy rates of one of them, and the speed decoded from all.

    Args:
        speed_m_s: Constant speeds, ``(k,)``.
        rates_hz: Rates at them, ``(k, n)``.
        run_m_s: Changing speeds of a run, ``(t,)``.
        noisy_hz: Rates of one cell in that run, ``(t,)``.
        decoded_m_s: Speed decoded from all cells, ``(t,)``.
        scores: Speed score of every cell in the run, ``(n,)``.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(10.5, 3.3, "Tuning of speed cells, and the speed decoded from them")
        steady, one, decoded = figure.subplots(1, 3)
        for k, rates in enumerate(rates_hz.T):
            steady.plot(speed_m_s, rates, color=CURVES[k % len(CURVES)], lw=1.0)
        steady.set(xlabel="running speed (m/s)", ylabel="firing rate (Hz)", xlim=(0, speed_m_s[-1]))
        steady.set_ylim(bottom=0.0)
        write_title(steady, "Tuning", f"{rates_hz.shape[1]} cells")
        one.plot(run_m_s, noisy_hz, ".", color=MAP, ms=2.0, alpha=0.5)
        one.set(xlabel="running speed (m/s)", ylabel="firing rate (Hz)")
        span = f"speed scores {scores.min():.2f} to {scores.max():.2f}"
        write_title(one, "A noisy cell", span)
        ends = (0.0, 1.05 * float(max(run_m_s.max(), decoded_m_s.max())))
        decoded.plot(run_m_s, decoded_m_s, ".", color=MAP, ms=2.0, alpha=0.5, label="all cells")
        decoded.plot(ends, ends, color=INK, lw=1.2, ls="--", label="equal")
        decoded.set(xlabel="running speed (m/s)", ylabel="decoded speed (m/s)")
        decoded.set(xlim=ends, ylim=ends)
        write_title(decoded, "Decoding")
        decoded.legend(loc="upper left", fontsize=8)
    return figure
