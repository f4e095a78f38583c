"""Figures of spiking neurons and of position estimates; arrays in, a ``Figure`` out."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neuroslam.figures.style import CURVES, INK, LOOP, MAP, ODOMETRY, STYLE, new_figure, write_title

_PATH = "#d0d0d0"
_BAND = 0.22  # opacity


class Spikes(NamedTuple):
    """Spikes of a neuron on a path.

    Attributes:
        title: The neuron.
        note: A note at the right of the title.
        path_m: Path of the animal, ``(t, 2)``.
        places_m: Position of the animal at each spike, ``(n, 2)``.
        landmarks_m: ``(k, 2)``, or ``None``.
    """

    title: str
    note: str
    path_m: np.ndarray
    places_m: np.ndarray
    landmarks_m: np.ndarray | None = None


class Headings(NamedTuple):
    """Firing rate of a neuron by the direction of motion.

    Attributes:
        title: The neuron.
        rate_hz: Rate in each bin, over the full turn from east, counter-clockwise, ``(n,)``.
    """

    title: str
    rate_hz: np.ndarray


class Run(NamedTuple):
    """A position estimate and its error.

    Attributes:
        label: The method.
        time_s: ``(t,)``.
        position_m: ``(t, dimension)``.
        error_m: Distance to the truth, ``(t,)``.
        probability: Density at the true position over the peak density, ``(t,)``.
        paired: Whether it is a variant of the run before it: drawn dashed, in the same colour.
    """

    label: str
    time_s: np.ndarray
    position_m: np.ndarray
    error_m: np.ndarray
    probability: np.ndarray | None = None
    paired: bool = False


def draw_spikes(axes: Axes, cell: Spikes) -> None:
    """Draw the spikes of a neuron as dots on the path."""
    axes.plot(*cell.path_m.T, color=_PATH, lw=0.6, zorder=1)
    axes.plot(*cell.places_m.T, ls="none", marker=".", ms=2.5, mew=0, color=LOOP, zorder=2)
    if cell.landmarks_m is not None:
        axes.plot(*cell.landmarks_m.T, ls="none", marker="x", ms=6, mew=1.6, color=INK, zorder=3)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(visible=False)
    write_title(axes, cell.title, cell.note)


def draw_headings(axes: Axes, cell: Headings) -> None:
    """Draw firing rates by direction of motion, on polar axes."""
    n = len(cell.rate_hz)
    angle = (np.arange(n) + 0.5) * 2.0 * np.pi / n
    axes.bar(angle, cell.rate_hz, width=2.0 * np.pi / n, color=MAP, ec="white", lw=0.5)
    axes.set_xticks(np.arange(4) * np.pi / 2, ["east", "north", "west", "south"])
    axes.tick_params(axis="y", labelsize=7)
    axes.set_title(cell.title)


def plot_spikes(rows: Sequence[Sequence[Spikes | Headings]], title: str) -> Figure:
    """Draw neurons side by side: spikes on the path, or rates by heading (the paper's Fig. 7).

    Args:
        rows: Rows of panels.
        title: Title of the whole figure.
    """
    width = max(map(len, rows))
    with mpl.rc_context(STYLE):
        figure = new_figure(3.2 * width + 0.3, 3.35 * len(rows) + 0.5, title)
        for i, row in enumerate(rows):
            for j, cell in enumerate(row):
                at = (len(rows), width, i * width + j + 1)
                if isinstance(cell, Headings):
                    draw_headings(figure.add_subplot(*at, projection="polar"), cell)
                else:
                    draw_spikes(figure.add_subplot(*at), cell)
    return figure


def draw_raster(axes: Axes, spikes: np.ndarray, time_step_s: float, start_s: float = 0.0) -> None:
    """Draw a raster of spikes, ``(steps, neurons)``."""
    step, neuron = np.nonzero(spikes)
    axes.plot(start_s + step * time_step_s, neuron, ls="none", marker="|", ms=2, mew=0.5, color=INK)
    axes.set(
        xlabel="time (s)",
        ylabel="neuron",
        xlim=(start_s, start_s + len(spikes) * time_step_s),
        ylim=(-0.5, max(spikes.shape[1], 1) - 0.5),
    )
    axes.grid(visible=False)


def plot_rasters(
    populations: Mapping[str, np.ndarray], time_step_s: float, start_s: float, title: str
) -> Figure:
    """Draw rasters of populations, one below the other; neurons that never fire have no row.

    Args:
        populations: Name -> spikes, ``(steps, neurons)``.
        time_step_s: Length of a step.
        start_s: Time of the first step.
        title: Title of the whole figure.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(8.5, 1.7 * len(populations) + 0.7, title)
        axes = figure.subplots(len(populations), 1, sharex=True, squeeze=False).ravel()
        for ax, (name, spikes) in zip(axes, populations.items(), strict=True):
            active = (spikes != 0).any(axis=0)
            draw_raster(ax, spikes[:, active], time_step_s, start_s)
            rate, n = spikes.mean() / time_step_s, spikes.shape[1]
            some = f"{int(active.sum())} of {n} neurons fire, mean rate of all {rate:.0f} Hz"
            write_title(ax, name, some)
            ax.label_outer()
    return figure


def plot_errors(
    time_s: np.ndarray,
    panels: Mapping[str, Mapping[str, np.ndarray]],
    title: str,
    log: bool = True,
) -> Figure:
    """Draw errors over time: mean and 10th to 90th percentile over trials (the paper's Fig. 8).

    Errors are averaged over a second, as estimates fluctuate with every spike.

    Args:
        time_s: ``(t,)``.
        panels: Name of an error, with its unit -> method -> errors, ``(t, trials)``.
        title: Title of the whole figure.
        log: Use a logarithmic axis.
    """
    from scipy.ndimage import uniform_filter1d  # slow to import, not always needed

    with mpl.rc_context(STYLE):
        figure = new_figure(5.4 * len(panels), 3.9, title)
        axes = figure.subplots(1, len(panels), squeeze=False).ravel()
        colours: dict[str, str] = {}
        for ax, (what, methods) in zip(axes, panels.items(), strict=True):
            for name, errors in methods.items():
                colour = colours.setdefault(name, CURVES[len(colours) % len(CURVES)])
                width = max(1, round(1.0 / (time_s[1] - time_s[0])))
                smooth = uniform_filter1d(errors, width, axis=0)
                low, high = np.percentile(smooth, (10, 90), axis=1)
                ax.fill_between(time_s, low, high, color=colour, alpha=_BAND, lw=0)
                ax.plot(time_s, smooth.mean(1), color=colour, lw=1.4, label=name)
            ax.set(xlabel="time (s)", ylabel=what, xlim=(0, time_s[-1]))
            if log:
                ax.set_yscale("log", nonpositive="clip")
                top = max(float(errors.max()) for errors in methods.values())
                ax.set_ylim(1e-3 * top, 1.2 * top)
            write_title(ax, what.split(" (")[0].capitalize())
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    return figure


def plot_trials(
    trials: Mapping[str, tuple[np.ndarray, np.ndarray, Mapping[str, np.ndarray]]], title: str
) -> Figure:
    """Draw paths of trials beside each other (the paper's Fig. 9).

    Args:
        trials: Title of a panel -> the true path, landmarks, and method -> estimated path.
        title: Title of the whole figure.
    """
    columns = min(5, len(trials))
    rows = -(-len(trials) // columns)
    colours = (MAP, LOOP)
    with mpl.rc_context(STYLE):
        figure = new_figure(2.7 * columns, 2.85 * rows + 0.8, title)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for ax, (name, (truth, landmarks, methods)) in zip(
            axes.ravel(), trials.items(), strict=False
        ):
            ax.plot(*truth.T, color="#bcbcbc", lw=3.0, label="truth")
            for (method, path), colour, dash in zip(
                methods.items(), colours, ("-", "--"), strict=False
            ):
                ax.plot(*path.T, dash, color=colour, lw=0.9, label=method)
            ax.plot(*landmarks.T, ls="none", marker="x", ms=5, mew=1.4, color=INK, label="landmark")
            ax.set_aspect("equal")
            write_title(ax, *name.split("|"))
        for ax in axes.ravel()[len(trials) :]:
            ax.set_visible(False)
        for ax in axes[-1]:
            ax.set_xlabel("x (m)")
        for ax in axes[:, 0]:
            ax.set_ylabel("y (m)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def plot_3d(
    truth: np.ndarray, estimates: Mapping[str, np.ndarray], landmarks: np.ndarray | None, title: str
) -> Figure:
    """Draw paths in three dimensions (the paper's Fig. 10), the true one also on the floor.

    Args:
        truth: True path, ``(t, 3)``.
        estimates: Method -> estimated path, ``(t, 3)``.
        landmarks: ``(k, 3)``, or ``None``.
        title: Title of the whole figure.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(6.6, 6.0, title)
        axes = figure.add_subplot(projection="3d")
        floor = float(truth[:, 2].min()) - 0.1 * float(np.ptp(truth[:, 2]) or 1.0)
        axes.plot(*truth[:, :2].T, np.full(len(truth), floor), color="#e4e4e4", lw=1.2)
        axes.plot(*truth.T, color="#a9a9a9", lw=2.6, label="truth")
        for (name, path), colour in zip(estimates.items(), CURVES, strict=False):
            axes.plot(*path.T, color=colour, lw=1.0, label=name)
        if landmarks is not None:
            axes.plot(*landmarks.T, ls="none", marker="o", ms=4, color=INK, label="landmark")
        axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        axes.set_aspect("equal")
        figure.legend(loc="outside lower center", ncols=4)
    return figure


def plot_dead_reckoning(truth: Run, runs: Sequence[Run], title: str) -> Figure:
    """Draw components, probability of the truth and error over time (the paper's Fig. 11).

    Args:
        truth: The true path; its error is not used.
        runs: Estimates at the same times.
        title: Title of the whole figure.
    """
    dimension = truth.position_m.shape[1]
    order = np.cumsum([not run.paired for run in runs]) - 1
    looks = [
        {"color": CURVES[k % len(CURVES)], "ls": "--" if run.paired else "-"}
        for k, run in zip(order, runs, strict=True)
    ]
    with mpl.rc_context(STYLE):
        figure = new_figure(10.5, 1.75 * dimension + 1.4, title)
        left, right = figure.subfigures(1, 2, wspace=0.03, squeeze=False)[0]
        axes = left.subplots(dimension, 1, sharex=True, squeeze=False).ravel()
        for k, ax in enumerate(axes):
            ax.plot(truth.time_s, truth.position_m[:, k], color="#bcbcbc", lw=3.0, label="truth")
            for run, look in zip(runs, looks, strict=True):
                ax.plot(run.time_s, run.position_m[:, k], lw=0.9, label=run.label, **look)
            ax.set_ylabel(f"{'xyzuvw'[k]} (m)")
        axes[-1].set_xlabel("time (s)")
        write_title(axes[0], "Position, true and estimated")
        probability, error = right.subplots(2, 1, sharex=True)
        for run, look in zip(runs, looks, strict=True):
            if run.probability is not None:
                probability.plot(run.time_s, run.probability, lw=0.9, **look)
            rmse = np.sqrt(np.cumsum(run.error_m**2) / np.arange(1, len(run.error_m) + 1))
            error.plot(run.time_s, run.error_m, lw=0.6, alpha=0.5, **look)
            error.plot(run.time_s, rmse, lw=1.6, **look)
        probability.set(ylabel="density / peak density", ylim=(0, 1.05))
        error.set(xlabel="time (s)", ylabel="error (m)", ylim=(0, None))
        write_title(probability, "Probability density at the true position")
        write_title(error, "Distance to the true position", "thick: RMSE since the start")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    return figure


def plot_signals(time_s: np.ndarray, signals: Mapping[str, np.ndarray], title: str) -> Figure:
    """Draw signals of a loop closure over time, one below the other: gate, similarity, recall.

    Args:
        time_s: ``(t,)``.
        signals: Name with its unit -> ``(t,)``.
        title: Title of the whole figure.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(8.5, 1.35 * len(signals) + 0.7, title)
        axes = figure.subplots(len(signals), 1, sharex=True, squeeze=False).ravel()
        for ax, (name, values) in zip(axes, signals.items(), strict=True):
            ax.plot(time_s, values, color=MAP, lw=0.9)
            ax.set_ylabel(name)
            ax.axhline(0.0, color=ODOMETRY, lw=0.6)
            if not np.any(values):
                ax.set_ylim(-0.05, 1.05)
                ax.text(0.01, 0.5, "0 throughout", transform=ax.transAxes, fontsize=8)
        axes[-1].set(xlabel="time (s)", xlim=(time_s[0], time_s[-1]))
    return figure
