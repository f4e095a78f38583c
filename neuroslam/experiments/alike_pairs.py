"""Merges of pairs of maps of buildings that repeat, and of buildings that differ in one mark alone.

Rooms in a row, a loop of equal corners and a corridor with one wallpaper
(:mod:`neuroslam.worlds.alike`); of each a second building with another mark. Sessions of 0.25 to
1.4 laps are mapped with three configs, and every pair of sessions of one config is tried; short
sessions, which see one period of what repeats, are tried among themselves. A merge is wrong if the
sessions are of two buildings, or if more than 5 % of the matched pairs of experiences are two
places in truth.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, read_preset
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.geometry import wrap_angles
from neuroslam.merging.match import find_match
from neuroslam.runs.parallel import parallel_map
from neuroslam.threads import limit_threads
from neuroslam.worlds import alike
from neuroslam.worlds.world import WorldOptions, WorldSource

WORLDS = {"rooms": alike.rooms, "corners": alike.corners, "wallpaper": alike.wallpaper}

CONFIGS: dict[str, dict[str, Any]] = {
    "threshold 0.05": {},
    "threshold 0.15": {"view": {"threshold": 0.15}},
    "auto": read_preset("auto"),
}
"""What the maps are made with -> the config."""

OTHER_MARK = 500
"""Difference of the seeds of the marks of two buildings."""

SESSIONS, SHORT = 6, 4
"""Sessions in each building, and short ones of at most about one period of what repeats."""

LAPS, SHORT_LAPS = (0.25, 1.4), (0.12, 0.25)
"""Their lengths: a side of the corners is 0.25 laps, a room there and back 0.18."""

NEAR_M, SAME_RAD = 1.8, 1.0
"""Distance and heading within which two experiences are one place, as in ``same-places``."""


class Session(NamedTuple):
    """A map and the truth about it.

    Attributes:
        building: 0 or 1: the building with the first or the second mark.
        laps: Its length.
        brain: The brain at the end.
        truth: True x, y in metres and heading of each experience, ``(n, 3)``.
    """

    building: int
    laps: float
    brain: NavigationBrain
    truth: np.ndarray


@torch.inference_mode()
def map_sessions(world: str, seed: int) -> dict[str, list[Session]]:
    """Map all sessions in both buildings of a world with each config.

    Args:
        world: A name of :data:`WORLDS`.
        seed: Of walls, marks, sessions, odometry and light.
    """
    rng = np.random.default_rng([seed, 88])
    found: dict[str, list[Session]] = {name: [] for name in CONFIGS}
    for building in (0, 1):
        built = WORLDS[world](seed, seed + OTHER_MARK * building)
        for number in range(SESSIONS + SHORT):
            laps = rng.uniform(*(LAPS if number < SESSIONS else SHORT_LAPS))
            options = WorldOptions(
                laps=laps, start=rng.uniform(0.0, 1.0), look=seed, grey=True,
                seed=int(rng.integers(1_000_000)), noise=rng.uniform(0.01, 0.04),
                light=rng.uniform(0.0, 0.1),
            )  # fmt: skip
            source = WorldSource(world, options, built)
            brains = {name: NavigationBrain(build_config(values))
                      for name, values in CONFIGS.items()}  # fmt: skip
            for brain in brains.values():
                brain.about = f"{world} {building} {options.seed}", "", ""
            for frame in source:
                for brain in brains.values():
                    brain(frame._replace(truth=None))
            truths = source.truths()
            for name, brain in brains.items():
                truth = truths[brain.map.experiences.array("first_frame")]
                found[name].append(Session(building, laps, brain, truth))
    return found


@torch.inference_mode()
def try_merge(one: Session, other: Session) -> dict[str, Any]:
    """Match and merge two sessions; return the result beside the truth."""
    row: dict[str, Any] = {
        "same_building": one.building == other.building,
        "short": one.laps < LAPS[0],
        "laps": (round(one.laps, 2), round(other.laps, 2)),
        "experiences": (one.brain.map.n, other.brain.map.n),
    }
    found = find_match(one.brain, other.brain)
    row |= {"merged": False, "right": False, "reason": found.reason}
    if found.match is None:
        return row
    merged, report = one.brain.merge(other.brain, found.match)
    pairs = found.match.pairs
    off = one.truth[pairs.loaded] - other.truth[pairs.partial]
    same = np.hypot(off[:, 0], off[:, 1]) < NEAR_M
    same &= np.abs(wrap_angles(off[:, 2])) < SAME_RAD
    right = row["same_building"] and float(same.mean()) >= 0.95
    return row | {
        "merged": merged is not None,
        "right": merged is not None and right,
        "pairs": len(pairs.partial),
        "found": found.reason,
        "reason": report.reason,
    }


def alike_pairs(
    _data_folder: Path | None,
    out_folder: Path,
    worlds: Sequence[str] = tuple(WORLDS),
    seeds: Sequence[int] = (102, 103),
    jobs: int | None = 1,
    ray: str | None = None,
) -> dict[str, Any]:
    """Try to merge sessions in buildings that repeat, and of two buildings alike but for a mark.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` is written there.
        worlds: Of :data:`WORLDS`.
        seeds: Of everything; those below 102 were used to make the rules.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: a row for each world, and every pair.
    """
    places = [(world, seed) for world in worlds for seed in seeds]
    tries = [row for rows in parallel_map(_pairs, places, jobs, ray) for row in rows]
    results = {
        "experiment": "alike_pairs",
        "seeds": list(seeds),
        "rows": [
            _row(tries, world, short) for short in (False, True) for world in (*worlds, "all")
        ],
        "tries": tries,
    }
    write_results(Path(out_folder), results)
    return results


def _pairs(place: tuple[str, int]) -> list[dict[str, Any]]:
    world, seed = place
    rows = []
    with limit_threads(1):
        for config, sessions in map_sessions(world, seed).items():
            for one, other in combinations(sessions, 2):
                if (one.laps < LAPS[0]) != (other.laps < LAPS[0]):
                    continue
                rows.append({"world": world, "seed": seed, "config": config}
                            | try_merge(one, other))  # fmt: skip
    return rows


def _row(tries: Sequence[Mapping[str, Any]], world: str, short: bool) -> dict[str, Any]:
    some = [one for one in tries if world in (one["world"], "all") and one["short"] == short]
    two = [one for one in some if not one["same_building"]]
    same = [one for one in some if one["same_building"]]
    return {
        "world": world,
        "sessions": "short" if short else "long",
        "pairs_of_two_buildings": len(two),
        "merged": sum(one["merged"] for one in two),
        "pairs_of_one_building": len(same),
        "merged_right": sum(one["right"] for one in same),
        "merged_wrong": sum(one["merged"] and not one["right"] for one in same),
    }
