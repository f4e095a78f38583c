"""A bump of place cells against the winner: how exactly each says where the animal is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.config import BrainConfig
from neuroslam.experiments.animals import RATE_HZ, TRACKS, read_track, simulate
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.place_errors import plot_errors
from neuroslam.figures.style import CURVES, save

CONDITIONS: dict[str, dict[str, Any]] = {
    "winner takes all": {},
    "no excitation": {"power": 10.0},
    "excitation": {"power": 10.0, "excitation": 0.5},
}
"""Condition -> section ``place_cells``."""

_EVERY = round(0.5 * RATE_HZ)
_READ = ("integrator", "winner", "bump")


def place_bump(
    data_folder: Path,
    out_folder: Path,
    minutes: float = 30.0,
    seeds: Sequence[int] = range(10),
    tracks: Sequence[str] = tuple(TRACKS),
) -> dict[str, Any]:
    """Compare positions read from the winner and from the bump, in the second half of each walk.

    Args:
        data_folder: Folder of the recordings.
        out_folder: ``results.json`` and ``errors.png`` are written there.
        minutes: Length of a walk.
        seeds: Seed of the noise of each animal.
        tracks: Names of tracks.

    Returns:
        The content of ``results.json``: ``rows``, one for each track and condition.
    """
    out, rows = Path(out_folder), []
    errors: dict[str, dict[str, np.ndarray]] = {}
    for name in tracks:
        walk = read_track(Path(data_folder), name, minutes)
        for condition, section in CONDITIONS.items():
            config = BrainConfig.model_validate({"place_cells": section})
            found: dict[str, list[np.ndarray]] = {what: [] for what in _READ}

            def note(
                i: int,
                here: NavigationEstimate,
                cells: NavigationCells,
                found: dict[str, list[np.ndarray]] = found,
                truth: np.ndarray = walk.positions,
            ) -> None:
                if i % _EVERY or 2 * i < len(truth):
                    return
                believed = cells.oscillators.position_m
                _, centre = cells.place.bump(cells.grid.rates.flatten(-2), believed)
                read = believed, cells.place.centre_of(here.place), centre
                for what, position in zip(_READ, read, strict=True):
                    apart = position.numpy() + truth[0] - truth[i]
                    found[what].append(np.linalg.norm(apart, axis=-1))

            done = simulate(walk, seeds, config, hook=note)
            mean = {what: np.stack(found[what]).mean(0) for what in _READ}
            bump = done.cells.place.bump(
                done.cells.grid.rates.flatten(-2), done.cells.oscillators.position_m
            )[0]
            rows.append(
                {"track": name, "condition": condition}
                | {f"{what}_error_m": float(mean[what].mean()) for what in _READ}
                | {f"{what}_error_sd_m": float(mean[what].std()) for what in _READ}
                | {"place_cells": float(done.cells.place.n_cells.double().mean()),
                   "cells_in_bump": float((bump > 0).double().sum(-1).mean())}
            )  # fmt: skip
            best = "winner" if condition == "winner takes all" else "bump"
            errors.setdefault(f"{best}, {condition}" if section else best, {})[name] = mean[best]
            errors.setdefault("integrator", {}).setdefault(name, mean["integrator"])
    figure = plot_errors(
        errors, title=f"Position read from place cells, {minutes:g} min, {len(seeds)} seeds",
        colours=dict(zip(errors, CURVES, strict=False)),
    )  # fmt: skip
    save(figure, out / "errors.png")
    return write_results(out, {"experiment": "place-bump", "minutes": minutes, "rows": rows})
