"""Place recognition on a second walk: single frames and sequences, several kinds of templates.

``vpr-corridor``: 111 + 111 images 160 x 120 of an office corridor (M. Milford, "Vision-based place
recognition: how low can you go?", IJRR 32, 2013), in the form, with the truth and beside the
methods of VPR-Bench (M. Zaffar et al., IJCV 129, 2021). ``rtabmap-corridor``: 84 photographs of
another corridor; those of the second walk are matched with those of the first.

The settings of ``KINDS`` and of the sequences were fixed without ``vpr-corridor``: on
``rtabmap_corridor``, on six pairs of laps of the ``usi`` tracks (five of them of different days),
and on three rendered worlds (``corridor``, ``ellipse``, ``town``) whose second lap had 0.6 of the
light, which drifted, passers-by, another field of view, and random shifts, zoom, blur and noise.
Those of :mod:`neuroslam.view.regions` were fixed on ``rtabmap_corridor``, on five such pairs of
laps, and on five rendered worlds whose second lap was also driven up to a metre beside the first
and looked up to 20 degrees aside, two of them through a fisheye lens with a dark border, as
``vpr-corridor`` has it: twelve pairs of its images were looked at before, its truth was not used.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from torch import nn

from neuroslam.config import ViewConfig, build_config
from neuroslam.errors import SourceError
from neuroslam.evaluation.place import (
    PrecisionRecall,
    average_precision,
    precision_recall,
    recall_at_full_precision,
)
from neuroslam.experiments.view_matching import read_truth
from neuroslam.figures.style import CURVES, MAP, STYLE, legend_below, new_figure, save, write_title
from neuroslam.sensors import open_source
from neuroslam.state.files import write_atomically
from neuroslam.view import LocalViewCells
from neuroslam.view.regions import RegionMatcher
from neuroslam.view.sequence import SPEED_RATIOS, SequenceMatcher

LENGTH = 10
"""Frames in a sequence: the present one and those before it."""

KINDS: dict[str, dict[str, Any]] = {
    "grey, 60 x 10, the default": {},
    "grey, 32 x 24": {"template_width": 32, "template_height": 24, "shift_match": 4},
    "grey, 32 x 24, patches": {
        "template_width": 32,
        "template_height": 24,
        "shift_match": 4,
        "patch_radius": 8,
    },
    "gradients, 16 x 12 x 6": {
        "template_width": 16,
        "template_height": 72,
        "orientations": 6,
        "shift_match": 2,
    },
}
"""Name -> keys of ``view``."""

REGIONS = "regions of gradients"
"""Name of views that are compared by :mod:`neuroslam.view.regions`."""

NETWORK = {"template_width": 16, "template_height": 64, "shift_match": 2}
"""Keys of ``view`` for networks."""

PUBLISHED = {
    "HybridNet": (0.901, 0.835),
    "AMOSNet": (0.847, 0.799),
    "denseVLAD": (0.703, 0.618),
    "NetVLAD": (0.676, 0.546),
    "CoHOG": (0.622, 0.418),
    "HOG": (0.477, 0.324),
}
"""VPR-Bench's results for single frames of vpr-corridor: recall at 1, area under the curve."""


class Walks(NamedTuple):
    """Two walks along one path.

    Attributes:
        references: Images of the first, in its order.
        queries: Images of the second, in its order.
        same: Whether a query shows the place of a reference, ``(queries, references)``.
    """

    references: list[np.ndarray]
    queries: list[np.ndarray]
    same: np.ndarray


class Matches(NamedTuple):
    """What every query was matched with.

    Attributes:
        single: Best reference of each frame alone, ``(n,)``.
        error: Its match error.
        sequence: Best reference of the sequence that ends with each frame, ``(n,)``.
        score: Its score.
        single_ms: Median CPU time of a frame: encode and compare with all references.
        sequence_ms: The same with the sequence.
    """

    single: np.ndarray
    error: np.ndarray
    sequence: np.ndarray
    score: np.ndarray
    single_ms: float
    sequence_ms: float


def read_vpr_corridor(folder: Path) -> Walks:
    """Read ``images.tar`` (``query/`` before ``ref/``) and ``truth.json``.

    Raises:
        SourceError: If a file is missing or damaged, or their sizes do not fit.
    """
    path = Path(folder) / "truth.json"
    try:
        truth = {int(q): list(map(int, r)) for q, r in json.loads(path.read_bytes()).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        raise SourceError(f"{path}: cannot be read; expected query -> right references") from None
    images = _images(Path(folder) / "images.tar")
    n = len(truth)
    if not n or len(images) <= n or max(map(max, truth.values())) >= len(images) - n:
        raise SourceError(
            f"{path}: {n} queries, but images.tar has {len(images)} images; expected those of the "
            "queries and then those of the references"
        )
    same = np.zeros((n, len(images) - n), dtype=bool)
    for query, right in truth.items():
        same[query, right] = True
    return Walks(images[n:], images[:n], same)


def read_rtabmap_corridor(folder: Path) -> Walks:
    """Read ``frames/`` and ``loop_truth.bmp``; the second walk begins at the first true pair.

    Raises:
        SourceError: If a photograph or the truth cannot be read, or their numbers differ.
    """
    images = _images(Path(folder) / "frames")
    pairs = read_truth(Path(folder) / "loop_truth.bmp", len(images))
    begins = int(pairs.any(axis=1).argmax())
    return Walks(images[:begins], images[begins:], pairs[begins:, :begins])


def _images(path: Path) -> list[np.ndarray]:
    return [frame.image for frame in open_source(path).frames() if frame.image is not None]


def match_walks(walks: Walks, view: ViewConfig, network: nn.Module | None = None) -> Matches:
    """Match every query with all references, alone and as the end of a sequence.

    Args:
        walks: The images; the truth is not used.
        view: How templates are made; its threshold is not used.
        network: The network, if ``view.features`` is ``"module"``.
    """
    cells = LocalViewCells(view, network)
    for image in walks.references:
        cells.learn(cells.encode(image))
    everything = np.arange(cells.n)
    return _match(walks.queries, lambda image: cells.differences(cells.encode(image), everything))


def match_regions(walks: Walks) -> Matches:
    """Do as :func:`match_walks`, by the regions of the views.

    Args:
        walks: The images; the truth is not used.
    """
    matcher = RegionMatcher()
    for image in walks.references:
        matcher.learn(image)
    matcher(walks.references[0])  # whitens the regions of the references
    return _match(walks.queries, matcher)


def _match(queries: Sequence[np.ndarray], compare: Callable[[np.ndarray], np.ndarray]) -> Matches:
    """Match queries, given what returns the match errors of an image with all references."""
    sequences = SequenceMatcher(LENGTH, SPEED_RATIOS)
    rows = []
    for image in queries:
        began_s = time.thread_time()
        errors = compare(image)
        single = int(errors.argmin())
        matched_s = time.thread_time()
        sequence = sequences(errors)
        ended_s = time.thread_time()
        rows.append((single, errors[single], *sequence[:2], matched_s - began_s, ended_s - began_s))
    single, error, sequence, score, single_s, sequence_s = map(np.array, zip(*rows, strict=True))
    times_ms = [1e3 * float(np.median(times)) for times in (single_s, sequence_s)]
    return Matches(single, error, sequence, score, *times_ms)


def vpr_corridor(
    data_folder: Path,
    out_folder: Path,
    networks: Mapping[str, str | Path | nn.Module] | None = None,
) -> dict[str, Any]:
    """Recognise an office corridor on a second walk, beside published methods.

    Args:
        data_folder: Holds ``images.tar`` and ``truth.json``.
        out_folder: ``results.json`` and ``pr_curves.png`` are written there.
        networks: Networks to compare too: ``view.features`` -> file of the weights; or any name ->
            a module, as :class:`~neuroslam.view.features.FeatureEncoder` takes it.

    Returns:
        The content of ``results.json``: ``rows``, and ``published``.

    Raises:
        SourceError: If the data cannot be read.
        ConfigError: If a network cannot be loaded.
    """
    walks = read_vpr_corridor(data_folder)
    return _compare(walks, Path(out_folder), networks or {}, PUBLISHED)


def rtabmap_corridor(
    data_folder: Path,
    out_folder: Path,
    networks: Mapping[str, str | Path | nn.Module] | None = None,
) -> dict[str, Any]:
    """Do the same with the photographs of another corridor, for which nothing is published.

    Args:
        data_folder: Holds ``frames/`` and ``loop_truth.bmp``.
        out_folder: As for :func:`vpr_corridor`.
        networks: As for :func:`vpr_corridor`.

    Returns:
        As :func:`vpr_corridor`.

    Raises:
        SourceError: If the data cannot be read.
        ConfigError: If a network cannot be loaded.
    """
    walks = read_rtabmap_corridor(data_folder)
    return _compare(walks, Path(out_folder), networks or {}, {})


def _compare(
    walks: Walks,
    out: Path,
    networks: Mapping[str, str | Path | nn.Module],
    published: Mapping[str, tuple[float, float]],
) -> dict[str, Any]:
    modules = {name: one for name, one in networks.items() if isinstance(one, nn.Module)}
    kinds = KINDS | {
        name: NETWORK
        | ({"features": "module"} if name in modules else {"features": name, "weights": str(one)})
        for name, one in networks.items()
    }
    rows: list[dict[str, Any]] = []
    curves: list[PrecisionRecall] = []
    everything = {
        name: partial(match_walks, walks, build_config({"view": values}).view, modules.get(name))
        for name, values in kinds.items()
    }
    for name, match in (everything | {REGIONS: partial(match_regions, walks)}).items():
        found = match()
        for frames, at, distance, cost_ms in (
            (1, found.single, found.error, found.single_ms),
            (LENGTH, found.sequence, found.score, found.sequence_ms),
        ):
            right = walks.same[np.arange(len(at)), at]
            curve = precision_recall(distance, right, int(walks.same.any(axis=1).sum()))
            curves.append(curve)
            rows.append(
                {
                    "templates": name,
                    "frames": frames,
                    "recall_at_1": float(right.mean()),
                    "average_precision": average_precision(curve),
                    "recall_at_full_precision": recall_at_full_precision(curve),
                    "ms_per_frame": cost_ms,
                }
            )
    result = {
        "rows": rows,
        "queries": len(walks.queries),
        "references": len(walks.references),
        "published": {
            name: {"recall_at_1": recall, "area_under_curve": area}
            for name, (recall, area) in published.items()
        },
    }
    text = json.dumps(result, indent=2) + "\n"
    write_atomically(out / "results.json", lambda file: file.write_text(text, encoding="utf-8"))
    _draw(rows, curves, published, out / "pr_curves.png")
    return result


def _draw(
    rows: Sequence[dict[str, Any]],
    curves: Sequence[PrecisionRecall],
    published: Mapping[str, tuple[float, float]],
    path: Path,
) -> None:
    with mpl.rc_context(STYLE):
        figure = new_figure(10.4, 5.0, None)
        left, right = figure.subplots(1, 2)
        for number, (row, curve) in enumerate(zip(rows, curves, strict=True)):
            colour = CURVES[number // 2 % len(CURVES)]
            single = row["frames"] == 1
            left.plot(
                curve.recall,
                curve.precision,
                "--" if single else "-",
                color=colour,
                lw=1.8,
                label=None if single else row["templates"],
                clip_on=False,
            )
        left.set(xlim=(0, 1), ylim=(0, 1), xlabel="recall", ylabel="precision")
        write_title(left, "Matches by error", f"dashed: 1 frame; solid: {LENGTH} frames")
        legend_below(left, columns=2)
        _draw_bars(right, rows, published)
    save(figure, path)


def _draw_bars(
    axes: Axes, rows: Sequence[dict[str, Any]], published: Mapping[str, tuple[float, float]]
) -> None:
    bars = [(f"{name} (published)", recall, "#b8b8b8") for name, (recall, _) in published.items()]
    for row in rows:
        n = row["frames"]
        label = f"{row['templates']}, {n} frame{'s' * (n > 1)}"
        bars.append((label, row["recall_at_1"], MAP if n > 1 else "#8fbfe0"))
    labels, values, colours = zip(*sorted(bars, key=lambda bar: bar[1]), strict=True)
    drawn = axes.barh(labels, values, height=0.7, color=colours)
    axes.bar_label(drawn, fmt="%.2f", padding=2, fontsize=8)
    axes.set(xlim=(0, 1.08), xlabel="recall at 1")
    axes.tick_params(axis="y", labelsize=8)
    axes.grid(visible=False, axis="y")
    write_title(axes, "Frames whose best match is right", "")
