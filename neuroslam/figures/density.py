"""Figure of densities that semantic pointers hold, with samples and uncertainty ellipses."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from neuroslam.errors import SpaceError
from neuroslam.figures.style import INK, LOOP, STYLE, new_figure, write_title
from neuroslam.spiking.density import Density

SIGMAS = (1.0, 2.0)
"""Standard deviations at which ellipses are drawn."""


class Spread(NamedTuple):
    """A mean with its uncertainty.

    Attributes:
        mean_m: ``(2,)``.
        covariance_m2: ``(2, 2)``.
    """

    mean_m: np.ndarray
    covariance_m2: np.ndarray


def ellipse_axes(covariance_m2: np.ndarray) -> tuple[float, float, float]:
    """Return the standard deviations along the axes of an ellipse, and the angle of the first.

    Args:
        covariance_m2: ``(2, 2)``.

    Returns:
        The larger and the smaller one in metres, and the angle of the larger in radians.

    Example:
        >>> ellipse_axes(np.diag([1.0, 4.0]))
        (2.0, 1.0, 1.5707963267948966)
    """
    values, vectors = np.linalg.eigh(np.asarray(covariance_m2, dtype=np.float64))
    small, large = np.sqrt(values.clip(0.0)).tolist()
    return large, small, math.atan2(vectors[1, 1], vectors[0, 1])


def draw_ellipse(
    axes: Axes,
    spread: Spread,
    sigmas: Sequence[float] = SIGMAS,
    label: str | None = None,
    colour: str = LOOP,
) -> None:
    """Draw the ellipses of a normal distribution at some standard deviations.

    Args:
        axes: Axes in metres.
        spread: Mean and covariance.
        sigmas: Standard deviations.
        label: Of the first ellipse in the legend; ``None``: none.
        colour: Of the lines.
    """
    large, small, angle = ellipse_axes(spread.covariance_m2)
    style: dict[str, Any] = {"fc": "none", "ec": colour, "lw": 1.4, "zorder": 5}
    x, y = np.asarray(spread.mean_m, dtype=np.float64).tolist()
    for sigma in sigmas:
        size = 2.0 * sigma * large, 2.0 * sigma * small
        ellipse = Ellipse((x, y), *size, angle=math.degrees(angle), label=label, **style)
        axes.add_patch(ellipse)
        label = None


def plot_densities(
    panels: Mapping[str, Density],
    samples_m: np.ndarray,
    spreads: Sequence[Spread],
    title: str,
) -> Figure:
    """Draw densities of a plane side by side in one colour scale, over their samples.

    Args:
        panels: Title of a panel -> density.
        samples_m: Samples, ``(n, 2)``.
        spreads: Normal distributions, drawn as ellipses of one and two standard deviations.
        title: Title of the whole figure.

    Raises:
        SpaceError: If a density is not of a plane.
    """
    for name, density in panels.items():
        if len(density.shape) != 2:
            raise SpaceError(
                f"plot_densities: {name!r} is a density of {len(density.shape)} dimensions; "
                "expected one of a plane"
            )
    most = max(float(density.density.max()) for density in panels.values())
    with mpl.rc_context(STYLE):
        figure = new_figure(3.7 * len(panels) + 0.9, 4.7, title)
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True).ravel()
        for ax, (name, density) in zip(axes, panels.items(), strict=True):
            (x0, x1), (y0, y1) = _bounds(density)
            image = density.density.reshape(density.shape).T.numpy(force=True)
            ax.imshow(
                image, "Blues", origin="lower", extent=(x0, x1, y0, y1), vmin=0.0, vmax=most,
                interpolation="nearest",
            )  # fmt: skip
            ax.plot(
                *samples_m.T, ls="none", marker=".", ms=2.5, color=INK, alpha=0.35, mew=0,
                label="samples", zorder=3,
            )  # fmt: skip
            for number, spread in enumerate(spreads):
                label = "1 and 2 standard deviations" if number == 0 else None
                draw_ellipse(ax, spread, label=label)
            ax.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x (m)")
            ax.set_aspect("equal")
            ax.grid(visible=False)
            write_title(ax, name, f"entropy {density.entropy:.2f} nats")
        axes[0].set_ylabel("y (m)")
        bar = figure.colorbar(axes[0].images[0], ax=axes, shrink=0.8, pad=0.01)
        bar.set_label("probability density (1/m²)")
        bar.outline.set_visible(False)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, markerscale=4.0)
    return figure


def _bounds(density: Density) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the edges of the outer cells along x and y."""
    points = density.points_m.numpy(force=True).astype(np.float64)
    edges = []
    for axis, n in enumerate(density.shape):
        low, high = points[:, axis].min(), points[:, axis].max()
        half = (high - low) / (n - 1) / 2.0
        edges.append((float(low - half), float(high + half)))
    return edges[0], edges[1]
