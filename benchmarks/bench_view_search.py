"""One exact search among many templates, 60x10, shifts of +-5 columns.

``python -m benchmarks.bench_view_search`` draws docs/img/view_search_cost.png: the cost against the
size of the map, with comparisons of everything by OpenCV and by numpy in the same run.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

import neuroslam.compiled
from benchmarks.timing import Row, cpu_ms, written
from neuroslam.config import ViewConfig
from neuroslam.view import LocalViewCells
from neuroslam.view.search import PRUNE_FROM, _compare, block_means

CONFIG = ViewConfig(template_width=60, template_height=10, shift_match=5)
TARGET = {
    10_000: {"known": "0.15", "new": "0.33"},
    100_000: {"known": "1.5", "new": "3.3"},
    1_000_000: {"known": "15", "new": "33"},
}
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "img" / "view_search_cost.png"


def places(n: int, seed: int = 0) -> np.ndarray:
    """Templates as a long drive gives them: smooth in the picture, and from one to the next.

    Returns:
        ``uint8``, ``(n, 10, 60)``.
    """
    rng = np.random.default_rng(seed)
    found = np.empty((n, 10, 60), np.uint8)
    for first in range(0, n, 500):  # another street every 500 templates
        street = cv2.GaussianBlur(rng.random((20, 700)).astype(np.float32), (0, 0), 2.0)
        street = np.rint((street - street.min()) * (255.0 / np.ptp(street))).astype(np.uint8)
        for i in range(first, min(first + 500, n)):
            at = i - first
            found[i] = street[at % 10 : at % 10 + 10, at : at + 60]
    return found


def noise(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 10, 60), np.uint8)


def memory(templates: np.ndarray, config: ViewConfig = CONFIG) -> LocalViewCells:
    cells = LocalViewCells(config)
    first, last = cells.geometry.core
    pixels = np.ascontiguousarray(templates.transpose(0, 2, 1))
    blocks = [
        block_means(pixels[k : k + 10_000, first:last], cells.geometry)
        for k in range(0, len(pixels), 10_000)
    ]
    cells.templates.replace(
        pixels=torch.from_numpy(pixels.reshape(len(pixels), -1)),
        blocks=torch.from_numpy(np.concatenate(blocks)),
    )
    return cells


def queries(
    templates: np.ndarray, known: bool, make: Callable[..., np.ndarray] = places, n: int = 40
) -> list[np.ndarray]:
    """Views of known places, shifted and noisy, or of places never seen."""
    rng = np.random.default_rng(1)
    if not known:
        return [view / 255.0 for view in make(500 * n, seed=99)[::500]]
    picked = templates[rng.integers(0, len(templates), n)] / 255.0
    views = [np.roll(view, rng.integers(-5, 6), axis=1) for view in picked]
    return [np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1) for view in views]


def search_ms(cells: LocalViewCells, views: list[np.ndarray], limit: float) -> float:
    def all_of_them() -> None:
        for view in views:
            cells.search(view, limit)

    return cpu_ms(all_of_them, 1, 5) / len(views)


def by_opencv(cells: LocalViewCells, view: np.ndarray) -> int:
    """Compare with every template at every shift, in batches, and return the nearest."""
    query = np.ascontiguousarray(np.rint(view.T * 255.0).astype(np.uint8))
    return _compare(cells.templates["pixels"].numpy(), None, query, cells.geometry).id


def by_numpy(cells: LocalViewCells, view: np.ndarray, batch: int = 1000) -> int:
    """Compare with every template at every shift by the definition, and return the nearest."""
    g = cells.geometry
    query = np.rint(view.T * 255.0).astype(np.int16)[g.margin : g.margin + g.overlap]
    pixels = cells.templates["pixels"].numpy().reshape(-1, g.width, g.height)
    least = np.empty(len(pixels), np.int64)
    for k in range(0, len(pixels), batch):
        part = pixels[k : k + batch]
        sums = [np.abs(part[:, o : o + g.overlap] - query).sum((1, 2), np.int64) for o in g.offsets]
        least[k : k + batch] = np.min(sums, axis=0)
    return int(least.argmin())


def disagreements(cells: LocalViewCells, views: list[np.ndarray]) -> int:
    """Queries for which the search and a comparison with everything name other templates."""
    return sum(cells.search(view).template != by_opencv(cells, view) for view in views)


def rows() -> list[Row]:
    found = []
    for n in TARGET:
        for kind, make in (("places", places), ("pure noise", noise)):
            if n > 100_000 and make is noise:
                continue
            templates = make(n)
            cells = memory(templates)
            seen = {
                name: queries(templates, name == "known", make, 40 if n <= 100_000 else 8)
                for name in ("known", "new")
            }
            for name, views in seen.items():
                limited = search_ms(cells, views, CONFIG.threshold)
                exact = search_ms(cells, views, np.inf)
                brute = cpu_ms(partial(by_opencv, cells, views[0]), 1, 3)
                found.append(
                    Row(
                        "view search, +-5, 60x10",
                        f"{n} templates, {kind}, {name} view",
                        limited,
                        f"<= {TARGET[n][name]} ms",
                        f"OpenCV, every template {written(brute)}",
                        f"nearest of all: {written(exact)}",
                    )
                )
            wrong = disagreements(cells, seen["known"] + seen["new"])
            assert wrong == 0, f"{wrong} queries differ from brute force"
    return found


def costs(sizes: list[int]) -> dict[str, list[float]]:
    """Milliseconds of a search of each kind, for each size of the map."""
    found: dict[str, list[float]] = {}
    everything = places(max(sizes))
    for n in sizes:
        cells = memory(everything[:n])
        k = int(np.clip(2_000_000 // n, 8, 40))
        known, new = (queries(everything[:n], is_known, n=k) for is_known in (True, False))
        wrong = disagreements(cells, known[:8] + new[:8])
        assert wrong == 0, f"{wrong} queries among {n} templates differ from brute force"
        rounds = 5 if n <= 100_000 else 1
        measured = {
            "numpy, every template": cpu_ms(partial(by_numpy, cells, known[0]), 1, rounds),
            "OpenCV, every template": cpu_ms(partial(by_opencv, cells, known[0]), 1, 5),
        }
        for enabled, how in ((False, "bounds, OpenCV"), (True, "bounds, compiled")):
            neuroslam.compiled.ENABLED = enabled
            for name, views in (("new", new), ("known", known)):
                some = views if enabled else views[:8]
                measured[f"{how}, {name} view"] = search_ms(cells, some, CONFIG.threshold)
        for name, milliseconds in measured.items():
            found.setdefault(name, []).append(milliseconds)
        print(n, {name: round(value, 3) for name, value in measured.items()}, flush=True)
    return found


def draw(sizes: list[int], milliseconds: dict[str, list[float]], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7.0, 5.2), layout="constrained")
    styles = ["k:", "k--", "C0s-", "C0o-", "C1s-", "C1o-"]
    for (name, values), style in zip(milliseconds.items(), styles, strict=True):
        axes.loglog(sizes, values, style, markersize=5, label=name)
    axes.axvline(PRUNE_FROM, color="0.6", linewidth=0.8)
    axes.annotate(
        "left of this line a search returns the nearest\n"
        "of all templates, beyond the threshold too",
        (PRUNE_FROM, axes.get_ylim()[1]),
        xytext=(4, -4),
        textcoords="offset points",
        va="top",
        fontsize="small",
    )
    axes.set_xlabel("templates in the map")
    axes.set_ylabel("CPU time of one search, one thread (ms)")
    axes.set_title("Cost of an exact view search, 60 x 10 px, 11 shifts")
    axes.grid(which="major", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    figure.savefig(path, dpi=120)


@pytest.mark.parametrize("n", [10_000, 100_000])
def test_view_search(benchmark, n):
    cv2.setNumThreads(1)
    templates = places(n)
    cells = memory(templates)
    view = queries(templates, True, n=1)[0]
    benchmark(cells.search, view, CONFIG.threshold)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=1_000_000, help="templates")
    parser.add_argument("--out", type=Path, default=PICTURE)
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    steps = (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
    sizes = [n for n in steps if n <= given.largest]
    draw(sizes, costs(sizes), given.out)


if __name__ == "__main__":
    main()
