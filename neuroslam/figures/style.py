"""Common style of all figures: colours, fonts, empty figures, and saving.

Grey is odometry, blue the map, vermilion a loop closure, black dashes the truth; a circle is the
start, a square the end, an arrow the robot now; each session of a map has its colour. The colours
are those of the palette of M. Okabe and K. Ito, which colour-blind readers can distinguish.
"""

import math
import warnings
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import ScaledTranslation
from PIL import Image

from neuroslam.errors import printable
from neuroslam.state.files import write_atomically

ODOMETRY, MAP, LOOP, TRUTH = "#8c8c8c", "#0072B2", "#D55E00", "#000000"
LANDMARK = "#F0E442"
ROBOT, OTHER, INK, WALL = "#E69F00", "#009E73", "#222222", "#c9c9c9"
SESSIONS = (MAP, ROBOT, OTHER, "#CC79A7", "#56B4E9", "#882255")
"""A colour for each session of a map."""
CURVES = (MAP, LOOP, OTHER, "#CC79A7", "#E69F00", "#56B4E9")
ACTIVITY = "viridis"

# DejaVu lacks East Asian scripts: names in them use the first of these fonts that is installed.
_EAST_ASIAN = (
    "Noto Sans CJK JP", "Noto Sans CJK SC", "Noto Sans JP", "Noto Sans SC", "Source Han Sans",
    "Hiragino Sans", "PingFang SC", "Yu Gothic", "Microsoft YaHei", "Malgun Gothic",
    "WenQuanYi Zen Hei", "Droid Sans Fallback", "IPAGothic", "Arial Unicode MS",
)  # fmt: skip
_INSTALLED = set(fontManager.get_font_names())

STYLE: dict[Any, Any] = {  # names of matplotlib's settings -> values
    "font.family": ["DejaVu Sans", *(name for name in _EAST_ASIAN if name in _INSTALLED)],
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # a fixed height: to look for one takes a quarter of the time of a figure
    "axes.edgecolor": "#777777",
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "grid.color": "#ececec",
    "grid.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.solid_capstyle": "round",
    "image.interpolation": "nearest",
}


def new_figure(
    width_in: float, height_in: float, title: str | None, constrained: bool = True
) -> Figure:
    """Return an empty figure for drawing off screen; the layout of many panels takes seconds."""
    layout = "constrained" if constrained else None
    figure = Figure(figsize=(width_in, height_in), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    return figure


def write_title(axes: Axes, name: str, counts: str = "") -> None:
    """Write the title at the left of a panel, and counts or notes at the right.

    Where both do not fit into one line, the counts are in a line below.
    """
    too_long = _BOLD_IN * len(name) + _SMALL_IN * len(counts) > _width_in(axes)
    axes.set_title(f"{name}\n" if counts and too_long else name)
    axes.set_title(counts, loc="right", fontsize=8, fontweight="normal")


_BOLD_IN, _SMALL_IN = 0.1, 0.068
"""Mean widths of a letter of a title, and of the counts beside it, in inches."""


def _width_in(axes: Axes) -> float:
    """Return the width of a panel in inches, about: a figure is laid out when it is drawn."""
    figure, spec = axes.get_figure(root=True), axes.get_subplotspec()
    width = math.inf if figure is None else float(figure.get_figwidth())
    if spec is None:
        return width
    columns = spec.get_gridspec().ncols
    inside = axes.get_figure(root=False)
    share = 1.0 if figure is None or inside is None else inside.bbox.width / figure.bbox.width
    return max(1.0, share * width * len(spec.colspan) / columns - 0.8)


def legend_below(axes: Axes, columns: int) -> None:
    """Put the legend below the axes."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("legend_below: the axes belong to no figure; make them with subplots()")
    under = axes.transAxes + ScaledTranslation(0, -0.42, figure.dpi_scale_trans)  # inches
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=under, ncols=columns)


def as_rgb(image: np.ndarray) -> np.ndarray:
    """Return a picture with three channels; those of a grey one are equal."""
    image = np.asarray(image)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def write_decimals(axis: Axis) -> None:
    """Label a logarithmic axis with few, plain decimal numbers.

    Example:
        >>> axes = new_figure(3.0, 3.0, None).subplots()
        >>> _ = axes.set(yscale="log", ylim=(0.01, 10.0))
        >>> write_decimals(axes.yaxis)
        >>> [axes.yaxis.get_major_formatter()(tick) for tick in (0.01, 0.1, 1.0, 10.0)]
        ['0.01', '0.1', '1', '10']
    """
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    few = LogLocator(subs=(1.0,) if decades > 2.5 else (1.0, 2.0, 5.0))
    axis.set_major_locator(few if decades > 1.0 else MaxNLocator(5))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def plain_text(text: str) -> str:
    """Escape a name for matplotlib, where a $ begins a formula, and control characters are none."""
    return printable(text).replace("$", r"\$")


_SPOKEN = {"world": "rendered world", "arena": "arena", "camera": "camera", "track": "track"}
"""Prefix of the name of a source -> what it is, in a title."""


def readable_source(name: str) -> str:
    """Return the name of a source as a title has it; that of a file stays.

    Example:
        >>> readable_source("world:corridor?laps=2&seed=1"), readable_source("lab/drive.mp4")
        ('rendered world corridor (laps 2, seed 1)', 'lab/drive.mp4')
    """
    prefix, colon, rest = name.partition(":")
    if not colon or prefix not in _SPOKEN or "://" in name:
        return name
    what, _, query = rest.partition("?")
    options = ", ".join(part.replace("=", " ") for part in query.split("&") if part)
    named = f"{_SPOKEN[prefix]} {what.rpartition('/')[2]}"
    return f"{named} ({options.replace('_', ' ')})" if options else named


def shortened(name: str, most: int = 44) -> str:
    """Shorten a long name in the middle: names of sources differ at their beginning or end.

    Example:
        >>> shortened("world:ellipse?laps=2&seed=1", 20)
        'world:el … =2&seed=1'
    """
    half = (most - 3) // 2
    return name if len(name) <= most else f"{name[:half]} … {name[half - most + 3 :]}"


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure as PNG, atomically; equal figures give equal bytes."""
    picture = Image.fromarray(render(figure, dpi))  # savefig draws a figure twice
    write_atomically(
        Path(path), lambda file: picture.save(file, "png", dpi=(dpi, dpi), compress_level=3)
    )


def render(figure: Figure, dpi: int = 100) -> np.ndarray:
    """Render a figure to pixels: ``uint8``, ``(h, w, 3)``."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    with mpl.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
