"""Place recognition by several kinds of templates in a corridor that was walked twice.

The recording is 84 photographs and a matrix that marks, below its diagonal, the pairs of the same
place: those 38 to 42 photographs apart, and at the end 79 to 81. Successive photographs are not
marked although they are similar, so pairs fewer than 20 apart are ignored.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np

from neuroslam.config import ViewConfig, build_config
from neuroslam.errors import SourceError
from neuroslam.evaluation.place import (
    PrecisionRecall,
    average_precision,
    precision_recall,
    recall_at_full_precision,
)
from neuroslam.figures.maps import plot_precision_recall
from neuroslam.figures.style import STYLE, save, write_title
from neuroslam.sensors import open_source
from neuroslam.state.files import write_atomically
from neuroslam.view import LocalViewCells
from neuroslam.view.search import distances as sums_of_differences
from neuroslam.view.templates import to_bytes

APART = 20
"""Least number of photographs between two that are compared."""

NORMALISATIONS: dict[str, dict[str, float]] = {
    "plain": {"normalisation": 0.0},
    "mean-normalised": {"normalisation": 0.5},
    "patch-normalised": {"normalisation": 0.0, "patch_radius": 8},
}

SIZES = ((32, 24, 8), (16, 12, 4), (64, 12, 16))
"""Width and height of the templates, largest shift in columns; the first is drawn."""

NETWORK_SIZES = ((16, 64, 4), (32, 24, 8))
"""The same for networks: they have few columns, and rows do not correspond to the picture's."""


def view_matching(
    data_folder: Path, out_folder: Path, networks: Mapping[str, str | Path] | None = None
) -> dict[str, Any]:
    """Match every photograph with the earlier ones, for each kind of template.

    ``pairs`` classifies all pairs as the same place or not. ``nearest`` classifies the nearest
    earlier view, as a robot does; its recall counts photographs that have a correct match.

    Args:
        data_folder: Holds ``frames/`` and ``loop_truth.bmp``.
        out_folder: ``results.json`` and ``pr_curves.png`` are written there.
        networks: Networks to compare too: ``view.features`` -> file of the weights.

    Returns:
        The content of ``results.json``: ``rows``.

    Raises:
        SourceError: If a photograph or the truth cannot be read, or their numbers differ.
        ConfigError: If a network cannot be loaded.
    """
    frames = open_source(Path(data_folder) / "frames").frames()
    images = [frame.image for frame in frames if frame.image is not None]
    truth = read_truth(Path(data_folder) / "loop_truth.bmp", len(images))
    rows, curves = [], {}
    for name, drawn, config in _kinds(networks or {}):
        distances = distance_matrix(images, config)
        pairs, nearest = pair_curve(distances, truth), nearest_curve(distances, truth)
        rows.append(
            {
                "templates": name,
                "width_px": config.template_width,
                "height_px": config.template_height,
                "shift_columns": config.shift_match,
                "pairs_average_precision": average_precision(pairs),
                "nearest_average_precision": average_precision(nearest),
                "nearest_recall_at_full_precision": recall_at_full_precision(nearest),
            }
        )
        if drawn:
            size = f"{config.template_width}x{config.template_height}"
            label = f"{name}, {size}, average precision {average_precision(nearest):.2f}"
            curves[label] = (nearest.precision, nearest.recall)
    result = {"rows": rows, "photographs": len(images), "true_pairs": int(truth.sum())}
    out = Path(out_folder)
    text = json.dumps(result, indent=2) + "\n"
    write_atomically(out / "results.json", lambda file: file.write_text(text, encoding="utf-8"))
    figure = plot_precision_recall(curves)
    with mpl.rc_context(STYLE):
        write_title(figure.axes[0], "Place recognition by the nearest view", "")
    save(figure, out / "pr_curves.png")
    return result


def _kinds(networks: Mapping[str, str | Path]) -> Iterator[tuple[str, bool, ViewConfig]]:
    """Yield the name of each kind of template, whether it is drawn, and its config."""
    kinds: list[tuple[str, tuple[tuple[int, int, int], ...], dict[str, Any]]] = [
        (name, SIZES, normalisation) for name, normalisation in NORMALISATIONS.items()
    ]
    for name, weights in networks.items():
        kinds.append((name, NETWORK_SIZES, {"features": name, "weights": str(weights)}))
    for name, sizes, values in kinds:
        for width, height, shift in sizes:
            size = {"template_width": width, "template_height": height, "shift_match": shift}
            yield (
                name,
                (width, height, shift) == sizes[0],
                build_config({"view": size | values}).view,
            )


def read_truth(path: Path, n: int) -> np.ndarray:
    """Read the pairs that show the same place: boolean, ``(n, n)``, below the diagonal.

    Raises:
        SourceError: If the file cannot be read or is not ``n`` by ``n``.
    """
    marks = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if marks is None or marks.shape != (n, n):
        got = "missing or no picture" if marks is None else f"{marks.shape} px"
        raise SourceError(f"{path}: {got}; expected the {n}x{n} matrix of places")
    return np.tril(marks > 0)


def distance_matrix(images: list[np.ndarray], config: ViewConfig) -> np.ndarray:
    """Compare every picture with every other as the view cells do: ``(n, n)``, in [0, 1]."""
    cells = LocalViewCells(config)
    views = [cells.encode(image) for image in images]
    for view in views:
        cells.learn(view)
    pixels, geometry = cells.templates["pixels"].numpy(), cells.geometry
    nearest = [
        sums_of_differences(pixels, to_bytes(view.T), geometry).min(axis=0) for view in views
    ]
    return np.array(nearest) / (255.0 * geometry.n_pixels)


def _compared(n: int) -> np.ndarray:
    i, j = np.indices((n, n))
    return np.greater_equal(i - j, APART)


def pair_curve(distances: np.ndarray, truth: np.ndarray) -> PrecisionRecall:
    """Return precision and recall of all compared pairs by their distance."""
    compared = _compared(len(truth))
    return precision_recall(distances[compared], truth[compared])


def nearest_curve(distances: np.ndarray, truth: np.ndarray) -> PrecisionRecall:
    """Return precision and recall of each picture's nearest earlier one."""
    compared = _compared(len(truth))
    some = np.flatnonzero(compared.any(axis=1))
    at = np.where(compared, distances, np.inf)[some].argmin(axis=1)
    n_correct = int((truth & compared).any(axis=1).sum())
    return precision_recall(distances[some, at], truth[some, at], n_correct)
