"""Boundary cells on paths to walls, corners and curved walls, and their rate maps.

The six scenarios of Figs. 3 and 4 of the SLRB paper: activity grows near a wall, decreases farther
away, and is 0 beyond reach. (The captions and the text of the paper use different letters; these
are the letters of its Section 2.1.)
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.cells.boundary import ATTENUATION, GROWTH, INHIBITION, BoundaryCells, boundary_zone
from neuroslam.config import BoundaryCellConfig
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.figures.boundary_cells import ActiveCells, plot_active_cells
from neuroslam.figures.cells import Approach, Firing, plot_approaches, plot_firing_maps
from neuroslam.figures.style import save
from neuroslam.state.files import write_atomically
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam

SPEED_M_S = 0.15
RATE_HZ = 100.0
FIRES = 0.1
"""Rate above which a cell counts as firing; the largest rate is 1."""

_BIN_M = 0.04
_SHOWN_M = (0.2, 0.1, 0.03)  # distances to the wall at which the active cells are drawn

_CORNER = 0.975
_CURVE = 0.5, math.sqrt(0.975**2 - 0.5**2)  # y of the path; x at 2.5 cm from the wall


class Scenario(NamedTuple):
    """A straight path in a named arena, with its letter in the paper."""

    letter: str
    motion: str
    arena: str
    start_m: tuple[float, float]
    end_m: tuple[float, float]


SCENARIOS = (
    Scenario("A", "towards a wall", "square", (0.55, 0.0), (0.975, 0.0)),
    Scenario("C", "away from a wall", "square", (0.975, 0.0), (0.55, 0.0)),
    Scenario("D", "towards a corner", "square", (0.55, 0.55), (_CORNER, _CORNER)),
    Scenario("B", "away from a corner", "square", (_CORNER, _CORNER), (0.55, 0.55)),
    Scenario("F", "towards a curved wall", "circle2m", (0.2, _CURVE[0]), (_CURVE[1], _CURVE[0])),
    Scenario("E", "away from a curved wall", "circle2m", (_CURVE[1], _CURVE[0]), (0.2, _CURVE[0])),
)

MAPPED = ((0, 0), (0, 3), (0, 5), (3, 3))
"""Cells with a rate map: numbers of the preferred bearing and of the preferred distance."""


def boundary_scenarios(
    data_folder: Path | None, out_folder: Path, minutes: float = 30.0
) -> dict[str, Any]:
    """Run the six scenarios, and make rate maps of boundary cells in a square and a circle.

    Args:
        data_folder: Not used.
        out_folder: ``results.json``, ``scenarios.png``, ``active_cells.png`` and
            ``firing_maps.png`` are written there.
        minutes: Length of the walks for the rate maps.

    Returns:
        The content of ``results.json``: ``rows``, one for each scenario.
    """
    out = Path(out_folder)
    approaches = [walk_straight(scenario) for scenario in SCENARIOS]
    title = f"Boundary cells on paths towards and away from walls, at {SPEED_M_S:g} m/s"
    save(plot_approaches(approaches, title), out / "scenarios.png")
    cells = BoundaryCells(BoundaryCellConfig())
    bearings, distances = cells.preferred_rad.numpy(), cells.preferred_m.numpy()
    active = [active_cells(scenario) for scenario in SCENARIOS]
    title = "Boundary cells by preferred bearing and distance, along the paths"
    figure = plot_active_cells(active, bearings, distances, FIRES, title)
    save(figure, out / "active_cells.png")
    maps = [map_firing(name, minutes) for name in ("square", "circle2m")]
    title = f"Rate maps of four boundary cells over {minutes:g} minutes"
    save(plot_firing_maps(maps, title, "mean rate (1 at most)"), out / "firing_maps.png")
    return write_results(
        out,
        {
            "experiment": "boundary-scenarios",
            "speed_m_s": SPEED_M_S,
            "rate_hz": RATE_HZ,
            "paper": "rises in the growth zone, falls in the attenuation zone, 0 in the inhibition "
            "zone (Section 2.1); it gives no numbers",
            "rows": [
                measure(scenario, approach)
                for scenario, approach in zip(SCENARIOS, approaches, strict=True)
            ],
        },
    )


def walk_straight(scenario: Scenario, config: BoundaryCellConfig | None = None) -> Approach:
    """Follow the path of a scenario without noise, from rest, and record the boundary cells."""
    return _approach(scenario, config or BoundaryCellConfig())[0]


def _approach(scenario: Scenario, config: BoundaryCellConfig) -> tuple[Approach, np.ndarray]:
    """Return the path of a scenario, and the rates of all cells along it."""
    start, end = np.array(scenario.start_m), np.array(scenario.end_m)
    n = 1 + round(float(np.hypot(*(end - start))) / SPEED_M_S * RATE_HZ)
    path = start + np.linspace(0.0, 1.0, n)[:, None] * (end - start)
    arena = named_arena(scenario.arena)
    activity, rates = respond(*arena.walls_near(path, math.inf), 1.0 / RATE_HZ, config)
    distance = arena.clearance(path)
    found = Approach(
        f"{scenario.letter}: {scenario.motion}",
        arena,
        path,
        np.arange(n) / RATE_HZ,
        distance,
        boundary_zone(torch.from_numpy(distance), config.reach_m).numpy(),
        activity,
        (rates > FIRES).mean(axis=(1, 2)),
        rates.max(axis=-1),
    )
    return found, rates


def active_cells(scenario: Scenario) -> ActiveCells:
    """Return the rates of all cells at some distances from the wall, in the order of the path."""
    approach, rates = _approach(scenario, BoundaryCellConfig())
    steps = sorted(int(np.abs(approach.distance_m - at).argmin()) for at in _SHOWN_M)
    moments = tuple(f"{100.0 * approach.distance_m[i]:.0f} cm" for i in steps)
    return ActiveCells(scenario.letter, moments, rates[steps])


def respond(
    distance_m: np.ndarray, bearing_rad: np.ndarray, dt_s: float, config: BoundaryCellConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Run boundary cells on sensed walls, ``(t, n_walls)``, in order of time.

    Returns:
        Activity ``(t,)`` and rates ``(t, n_bearings, n_distances)``.
    """
    cells, activity, rates = BoundaryCells(config), [], []
    with torch.inference_mode():
        for walls in zip(torch.from_numpy(distance_m), torch.from_numpy(bearing_rad), strict=True):
            rates.append(cells(*walls, dt_s).numpy())
            activity.append(cells.activity.item())
    return np.array(activity), np.array(rates)


def measure(scenario: Scenario, approach: Approach) -> dict[str, Any]:
    """Return the time in each zone, and the change of the activity there."""
    change = np.diff(approach.activity, prepend=0.0)
    zone = approach.zone
    rise, fall = change[zone == GROWTH], change[zone == ATTENUATION]
    outside = approach.activity[zone == INHIBITION]
    return {
        "scenario": f"{scenario.letter}: {scenario.motion}",
        "inhibition_s": float((zone == INHIBITION).sum() / RATE_HZ),
        "attenuation_s": float((zone == ATTENUATION).sum() / RATE_HZ),
        "growth_s": float((zone == GROWTH).sum() / RATE_HZ),
        "peak_activity": float(approach.activity.max()),
        "change_in_growth": float(rise.sum()),
        "change_in_attenuation": float(fall.sum()),
        "most_cells_firing_share": float(approach.active.max()),
        "as_in_the_paper": bool(rise.sum() > 0 and (fall <= 0).all() and not outside.any()),
    }


def map_firing(name: str, minutes: float, seed: int = 0) -> list[Firing]:
    """Simulate an animal in a named arena and return rate maps of some of its boundary cells."""
    arena, config = named_arena(name), BoundaryCellConfig()
    walk = roam(arena, minutes, np.random.default_rng(seed), speed_m_s=SPEED_M_S)
    walls = arena.nearest_walls(walk.positions, config.reach_m, 2)
    _, rates = respond(*walls, 1.0 / walk.rate_hz, config)
    bins = Bins.around(np.reshape(arena.bounds, (2, 2)).T, _BIN_M)
    cells = BoundaryCells(config)
    degrees, distances_cm = cells.preferred_rad.rad2deg(), 100.0 * cells.preferred_m
    fired = np.stack([rates[:, k, d] for k, d in MAPPED], axis=1)
    return [
        Firing(
            f"wall at {degrees[k]:.0f}°, {distances_cm[d]:.1f} cm",
            f"peak {np.nanmax(one):.2f}",
            one,
            bins,
            arena,
        )
        for (k, d), one in zip(MAPPED, rate_map(walk.positions, fired, bins), strict=True)
    ]


def write_results(out: Path, results: dict[str, Any]) -> dict[str, Any]:
    """Write ``results.json``, with ``null`` for NaN, and return the results."""
    text = json.dumps(results, indent=1).replace("NaN", "null") + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    return results
