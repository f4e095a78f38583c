"""Figures of animals in arenas: walls, boundary cells, and the firing maps of grid cells."""

from matplotlib.axes import Axes

from neuroslam.drawing import INK
from neuroslam.sensors.arena import Arena


def draw_arena(axes: Axes, arena: Arena) -> None:
    """Draw the outline of an arena, with equal axes in metres around it."""
    for line in arena.outlines:
        axes.plot(*line.T, color=INK, lw=1.4, zorder=4, solid_joinstyle="miter")
    x_min, x_max, y_min, y_max = arena.bounds
    pad = 0.03 * max(x_max - x_min, y_max - y_min)
    axes.set(
        xlim=(x_min - pad, x_max + pad),
        ylim=(y_min - pad, y_max + pad),
        xlabel="x (m)",
        ylabel="y (m)",
    )
    axes.set_aspect("equal", adjustable="box")
