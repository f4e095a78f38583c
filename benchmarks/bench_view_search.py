"""One exact search among many templates, 60x10, shifts of +-5 columns."""

import cv2
import numpy as np
import pytest
import torch

from benchmarks.timing import Row, cpu_ms
from neuroslam.config import ViewConfig
from neuroslam.view import LocalViewCells
from neuroslam.view.search import distances, template_blocks
from neuroslam.view.templates import to_bytes

CONFIG = ViewConfig(template_width=60, template_height=10, shift_match=5)
REFERENCE = {10_000: "64", 100_000: "~640"}
TARGET = {10_000: "4", 100_000: "10"}


def places(n: int, seed: int = 0) -> np.ndarray:
    """Templates as a long drive gives them: smooth in the picture, and from one to the next."""
    rng = np.random.default_rng(seed)
    found = np.empty((n, 10, 60))
    for first in range(0, n, 500):  # another street every 500 templates
        street = cv2.GaussianBlur(rng.random((20, 700)).astype(np.float32), (0, 0), 2.0)
        street = (street - street.min()) / np.ptp(street)
        for i in range(first, min(first + 500, n)):
            at = i - first
            found[i] = street[at % 10 : at % 10 + 10, at : at + 60]
    return found


def noise(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((n, 10, 60))


def memory(templates: np.ndarray, config: ViewConfig = CONFIG) -> LocalViewCells:
    cells = LocalViewCells(config)
    pixels = to_bytes(templates.transpose(0, 2, 1))
    blocks = np.concatenate([template_blocks(t, cells.geometry)[None] for t in pixels])
    cells.templates.replace(
        pixels=torch.from_numpy(pixels.reshape(len(pixels), -1)), blocks=torch.from_numpy(blocks)
    )
    return cells


def queries(templates: np.ndarray, known: bool, n: int = 40) -> list[np.ndarray]:
    """Views of known places, shifted and noisy, or of places never seen."""
    rng = np.random.default_rng(1)
    if not known:
        make = noise if templates[0].std() > 0.25 else places
        fresh = make(500 * n, seed=99)[::500]
        return list(fresh)
    picked = rng.integers(0, len(templates), n)
    views = [np.roll(templates[i], rng.integers(-5, 6), axis=1) for i in picked]
    return [np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1) for view in views]


def search_ms(cells: LocalViewCells, views: list[np.ndarray], limit: float) -> float:
    def all_of_them() -> None:
        for view in views:
            cells.search(view, limit)

    return cpu_ms(all_of_them, 1, 5) / len(views)


def disagreements(cells: LocalViewCells, views: list[np.ndarray]) -> int:
    """Queries for which the search and a comparison with everything name other templates."""
    pixels = cells.templates["pixels"].numpy()
    wrong = 0
    for view in views:
        every = distances(pixels, to_bytes(view.T), cells.geometry).min(axis=0)
        wrong += cells.search(view).template != int(every.argmin())
    return wrong


def rows() -> list[Row]:
    found = []
    for n in (10_000, 100_000):
        for kind, make in (("places", places), ("pure noise", noise)):
            templates = make(n)
            cells = memory(templates)
            for known in (True, False):
                views = queries(templates, known)
                exact = search_ms(cells, views, np.inf)
                limited = search_ms(cells, views, CONFIG.threshold)
                name = "known" if known else "new"
                found.append(
                    Row(
                        "view search, +-5, 60x10",
                        f"{n} templates, {kind}, {name} view",
                        f"{REFERENCE[n]} ms",
                        f"<= {TARGET[n]} ms",
                        f"{limited:.2f} ms (nearest of all: {exact:.2f} ms)",
                    )
                )
            wrong = disagreements(cells, queries(templates, True) + queries(templates, False))
            assert wrong == 0, f"{wrong} queries differ from brute force"
    return found


@pytest.mark.parametrize("n", [10_000, 100_000])
def test_view_search(benchmark, n):
    cv2.setNumThreads(1)
    templates = places(n)
    cells = memory(templates)
    view = queries(templates, True, 1)[0]
    benchmark(cells.search, view, CONFIG.threshold)
