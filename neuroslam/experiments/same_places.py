"""Places that look the same: RatSLAM alone, sequences of views, and clone cells, in one run.

Rendered drives through rooms in a row, a corridor with one wallpaper and a loop of equal corners
(:mod:`neuroslam.worlds.alike`). The robot maps the world in 1.35 laps, and is then kidnapped three
times to a place that looks the same, so that no change of view shows it.
"""

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.style import CURVES, INK, STYLE, new_figure, save, write_title
from neuroslam.geometry import wrap_angles
from neuroslam.runs.parallel import parallel_map
from neuroslam.threads import limit_threads
from neuroslam.worlds.alike import MOTIF_M, N_ROOMS, ROOM_M, SIDE_M
from neuroslam.worlds.catalogue import build_world
from neuroslam.worlds.world import WorldOptions, WorldSource

METHODS: dict[str, dict[str, Any]] = {
    "RatSLAM": read_preset("ratslam"),
    "sequences": read_preset("auto"),
    "clone cells": merge_values(read_preset("auto"), {"cells": "pose+clones"}),
}
"""What decides about loop closures -> the config."""

WITHIN_M, WINDOW_M = 30.0, 2.0
"""Path after a kidnapping on which the robot has to find itself, and how long it is looked at."""

NEAR_M, SAME_RAD = 1.8, 1.0
"""Distance (half of that of two twins) and heading within which an experience is the place."""

WRONG_LINK_M, WRONG_LINK_RAD = 1.5, 0.8
"""Error of a link's displacement or turn from which it is wrong."""

_RATE_HZ = 10.0
_SIGHT_M = 6.0
"""Distance within which the mark of a world is seen: kidnappings there would be noticed."""


class Drive(NamedTuple):
    """A drive with kidnappings.

    Attributes:
        source: The frames.
        kidnapped: Frame of each kidnapping.
        step_m: Path between two frames.
    """

    source: WorldSource
    kidnapped: tuple[int, ...]
    step_m: float


def plan_drive(world: str, seed: int, legs: int = 3, noise: float = 0.02) -> Drive:
    """Choose kidnappings that no view shows: between places that look the same.

    Args:
        world: ``rooms``, ``wallpaper`` or ``corners``.
        seed: Of textures, odometry, light and kidnappings.
        legs: Number of kidnappings.
        noise: Level of the noise of odometry.
    """
    rng = np.random.default_rng([seed, 77])
    built = build_world(world, seed)
    n = built.sense.frames_per_lap
    lap, step_m = built.routes[0].poses(n), built.routes[0].length_m / n
    at, kidnapped = math.ceil(0.135 * n) * 10, []
    along = at
    for _ in range(legs):
        wait, to = int(rng.integers(0, 5)), np.empty(0, dtype=int)
        while not len(to) or wait > 0:
            at, along, wait = at + 10, along + 10, wait - 1
            to = _twins(world, lap, along % n)
        shift = int(rng.choice(to)) - along % n
        kidnapped.append((at, shift % n))
        legs_frames = math.ceil((WITHIN_M + WINDOW_M + 1.0) / step_m / 10) * 10
        at, along = at + legs_frames, along + shift + legs_frames
    text = ",".join(f"{at // 10}:{shift / n:.6f}" for at, shift in kidnapped)
    options = WorldOptions(
        laps=at / n, rate=_RATE_HZ, look=seed, seed=seed, noise=noise, light=0.1, grey=True,
        kidnapped=text,
    )  # fmt: skip
    return Drive(WorldSource(world, options), tuple(at for at, _ in kidnapped), step_m)


def _twins(world: str, lap: np.ndarray, here: int) -> np.ndarray:
    """Return the frames of a lap that show what this one does, the mark being out of sight."""
    if not _plain(world, lap[here : here + 1])[0]:
        return np.empty(0, dtype=int)
    x, y, theta = lap[here]
    if world == "corners":
        quarters = (here + np.arange(1, 4) * len(lap) // 4) % len(lap)
        return quarters[_plain(world, lap[quarters])]
    period = ROOM_M if world == "rooms" else MOTIF_M
    off = np.abs((lap[:, 0] - x + 0.5 * period) % period - 0.5 * period)
    same = (np.abs(lap[:, 1] - y) < 0.01) & (np.abs(wrap_angles(lap[:, 2] - theta)) < 0.01)
    same &= (off < 0.07) & (np.abs(lap[:, 0] - x) > 0.9 * ROOM_M) & _plain(world, lap)
    return np.flatnonzero(same)


def _plain(world: str, poses: np.ndarray) -> np.ndarray:
    """Return whether the mark is out of sight, and nothing turns: on a straight piece indoors."""
    if world == "corners":
        corner = np.full(2, 0.5 * SIDE_M + 1.2) - poses[:, :2]
        bearing = wrap_angles(np.arctan2(corner[:, 1], corner[:, 0]) - poses[:, 2])
        apart = np.hypot(*corner.T)
        return (apart > _SIGHT_M) | ((np.abs(bearing) > 1.2) & (apart > 2.5))
    length = N_ROOMS * ROOM_M if world == "rooms" else 20.0
    east = np.abs(poses[:, 2]) < 0.01
    straight = east | (np.abs(wrap_angles(poses[:, 2] - math.pi)) < 0.01)
    ahead = np.where(east, length - _SIGHT_M, length - 1.5)
    return straight & (poses[:, 0] > 1.5) & (poses[:, 0] < ahead)


class Outcome(NamedTuple):
    """What a brain made of a drive.

    Attributes:
        right: Of every frame whether its experience is the place, made before the kidnapping.
        found: Of every kidnapping whether the robot had found itself.
        found_m: After which path it was right for good.
        links: Number of links.
        wrong_links: How many of them are wrong.
        experiences: Number of experiences.
        ms: Time a frame.
        entropy_bits: Of every frame, of clone cells; 0 without them.
    """

    right: np.ndarray
    found: tuple[bool, ...]
    found_m: tuple[float, ...]
    links: int
    wrong_links: int
    experiences: int
    ms: float
    entropy_bits: np.ndarray


def follow(drive: Drive, configs: Mapping[str, dict[str, Any]]) -> dict[str, Outcome]:
    """Show one drive to a brain of each config, and score what each makes of it."""
    brains = {name: NavigationBrain(build_config(values)) for name, values in configs.items()}
    n = drive.source.n_frames
    made = {name: np.full(n, -1) for name in brains}
    bits, spent = {name: np.zeros(n) for name in brains}, dict.fromkeys(brains, 0.0)
    with limit_threads(1):
        for i, frame in enumerate(drive.source):
            for name, brain in brains.items():
                began = time.process_time()
                result = brain(frame._replace(truth=None))
                spent[name] += time.process_time() - began
                if result.experience >= 0:
                    frames = brain.map.experiences.array("first_frame")
                    made[name][i] = frames[result.experience]
                cells = brain.populations.get("clones")
                if cells is not None:
                    bits[name][i] = cells.scalars()["clones/entropy_bits"]
    return {
        name: _score(drive, brain, made[name], 1e3 * spent[name] / n, bits[name])
        for name, brain in brains.items()
    }


def _score(
    drive: Drive, brain: NavigationBrain, made: np.ndarray, ms: float, bits: np.ndarray
) -> Outcome:
    truth = drive.source.truths()
    apart = np.hypot(*(truth[made] - truth)[:, :2].T)
    right = (apart < NEAR_M) & (np.abs(wrap_angles(truth[made, 2] - truth[:, 2])) < SAME_RAD)
    right &= made >= 0
    found, found_m = [], []
    begin, end = (round(m / drive.step_m) for m in (WITHIN_M, WITHIN_M + WINDOW_M))
    for at in drive.kidnapped:
        right[at : at + end] &= made[at : at + end] < at
        leg = right[at : at + end]
        found.append(bool(leg[begin:].mean() >= 0.9))
        wrong = np.flatnonzero(~leg[:begin])
        found_m.append(float((wrong[-1] + 1 if len(wrong) else 0) * drive.step_m))
    counts = [_wrong_links(one, truth) for one in (brain, *brain.stored)]
    links, wrong_links = (sum(column) for column in zip(*counts, strict=True))
    return Outcome(right, tuple(found), tuple(found_m), links, wrong_links, brain.map.n, ms, bits)


def _wrong_links(brain: NavigationBrain, truth: np.ndarray) -> tuple[int, int]:
    """Return how many links a map has, and how many contradict the truth."""
    links, at = brain.map.links, truth[brain.map.experiences.array("first_frame")]
    a, b = at[links.source], at[links.target]
    dx, dy = (b - a)[:, 0], (b - a)[:, 1]
    ahead = np.cos(a[:, 2]) * dx + np.sin(a[:, 2]) * dy
    left = -np.sin(a[:, 2]) * dx + np.cos(a[:, 2]) * dy
    off_x = ahead - links.distance_m * np.cos(links.heading_rad)
    off_y = left - links.distance_m * np.sin(links.heading_rad)
    turned = np.abs(wrap_angles(b[:, 2] - a[:, 2] - links.facing_rad))
    wrong = (np.hypot(off_x, off_y) > WRONG_LINK_M) | (turned > WRONG_LINK_RAD)
    return len(wrong), int(wrong.sum())


def same_places(
    _data_folder: Path | None,
    out_folder: Path,
    worlds: Sequence[str] = ("rooms", "corners", "wallpaper"),
    seeds: Sequence[int] = (100, 101),
    legs: int = 3,
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Measure whether a robot finds itself among places that look the same.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` and ``same_places.png`` are written there.
        worlds: Of :mod:`neuroslam.worlds.alike`.
        seeds: Of textures, odometry, light and kidnappings; those below 100 made the settings.
        legs: Kidnappings of each drive.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: a row for each world and method.
    """
    drives = [(world, seed, legs) for world in worlds for seed in seeds]
    outcomes = parallel_map(_one, drives, jobs, ray)  # a drive is the same in any process
    rows, of_drive = [], dict(zip(drives, outcomes, strict=True))
    for world in (*worlds, "all"):
        for method in METHODS:
            some = [o[method] for (of, _, _), o in of_drive.items() if world in (of, "all")]
            found = [ok for one in some for ok in one.found]
            rows.append({
                "world": world,
                "method": method,
                "kidnappings": len(found),
                "right_within_30_m": sum(found),
                "right_percent": round(100.0 * sum(found) / len(found), 1),
                "links": sum(one.links for one in some),
                "wrong_links": sum(one.wrong_links for one in some),
                "experiences": sum(one.experiences for one in some),
                "ms_a_frame": round(float(np.mean([one.ms for one in some])), 2),
            })  # fmt: skip
    results = {"experiment": "same_places", "seeds": list(seeds), "rows": rows}
    write_results(Path(out_folder), results)
    save(_plot(of_drive), Path(out_folder) / "same_places.png")
    return results


def _one(drive: tuple[str, int, int]) -> dict[str, Outcome]:
    return follow(plan_drive(*drive), METHODS)


def _plot(of_drive: Mapping[tuple[str, int, int], Mapping[str, Outcome]]) -> Figure:
    """Draw the share of legs that are right over the path, and how the belief collapses."""
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 4.0, "Places that look the same: kidnappings that no view shows")
        right, entropy = figure.subplots(1, 2)
        path = np.arange(0.0, WITHIN_M + WINDOW_M, 0.5)
        legs: dict[str, list[np.ndarray]] = {name: [] for name in METHODS}
        bits: list[tuple[str, np.ndarray]] = []
        for (world, seed, n), outcomes in of_drive.items():
            drive = plan_drive(world, seed, n)
            for name, outcome in outcomes.items():
                for at in drive.kidnapped:
                    rows = np.minimum(
                        at + (path / drive.step_m).astype(int), len(outcome.right) - 1
                    )
                    legs[name].append(outcome.right[rows])
                    if name == "clone cells":
                        bits.append((world, outcome.entropy_bits[rows]))
        for colour, (name, some) in zip(CURVES, legs.items(), strict=False):
            right.plot(path, 100.0 * np.mean(some, axis=0), color=colour, label=name)
        right.axhline(95.0, color=INK, lw=0.8, ls=":")
        right.set(
            xlabel="path after the kidnapping (m)", ylabel="robot found (%)", ylim=(0.0, 101.0)
        )
        right.legend(loc="lower right", frameon=False)
        worlds = list(dict.fromkeys(world for world, _ in bits))
        for colour, world in zip(CURVES, worlds, strict=False):
            some = np.array([curve for of, curve in bits if of == world])
            entropy.plot(path, some.mean(axis=0), color=colour, label=world)
        entropy.set(xlabel="path after the kidnapping (m)", ylabel="entropy of the belief (bits)")
        entropy.legend(frameon=False)
        write_title(right, "Found after a path", f"{len(legs['RatSLAM'])} kidnappings")
        write_title(entropy, "Clone cells: belief", "mean")
    return figure
