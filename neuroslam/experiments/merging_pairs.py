"""Merges of pairs of short maps: those that overlap, and those that only look alike.

The drives, their cuts and the pairs follow from a seed. The sets ``development`` and ``second``
served to choose the rules of :mod:`neuroslam.merging`; ``held-out`` and ``fourth`` were looked at
with the rules fixed. They differ in textures, buildings, noise and cuts; the recordings of the
last two are those of the others, cut elsewhere. A merge is right if the maps overlap, at least
95 % of the matched pairs of experiences are the same place in truth, and the merged map of a
rendered world fits the truth about as well as the maps did before.
"""

import json
import math
from collections.abc import Iterable
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.evaluation.trajectory import align
from neuroslam.geometry import TWO_PI
from neuroslam.merging.match import find_match
from neuroslam.sensors import open_source
from neuroslam.state.files import write_atomically
from neuroslam.types import Frame
from neuroslam.worlds import paint, paint_outdoors
from neuroslam.worlds.scene import Sense, Surface, World, rounded_route
from neuroslam.worlds.site import Site
from neuroslam.worlds.world import WorldOptions, WorldSource

HALVES = {"development": 1, "second": 2, "held-out": 3, "fourth": 4}
"""Sets of pairs, and the seed of each."""

RECORDINGS = ("usi_track1", "usi_day1", "usi_day2", "circuit_launch")

SAME_PLACE = 0.05
"""Largest distance, in laps, between two visits of one place (the rule of the recordings)."""

WRONG_PLACE = 0.1
"""Distance, in laps, from which a loop of a recording is wrong: its phases are known to 0.02."""

LEAST_OVERLAP = 0.3
"""Common path, in laps, from which two maps count as overlapping."""

N_TRUE = {"rendered": 40, "cuts of one recording": 30, "two recordings of one track": 30}
"""Kinds of pairs that overlap, and how many of each."""

N_FALSE = {
    "other textures": 60,
    "one wallpaper": 50,
    "straight aisles": 50,
    "other tracks": 60,
    "other parts of one track": 20,
    "few templates": 60,
}
"""Kinds of pairs that do not overlap, and how many of each."""

_TOWN = {"view": {"threshold": 0.035, "template_height": 20}, "pose_cells": {"cell_size_m": 2.0}}
_WORLDS: dict[str, dict[str, Any]] = {
    "corridor": {},
    "ellipse": {},
    "figure_eight": {"odometry": {"speed_scaling_m_s": 50.0}, "pose_cells": {"cell_size_m": 0.5}},
    "town": _TOWN,
}


_ALL = {"usi_day2": (0, 3070), "usi_day1": (0, 3778), "circuit_launch": (0, 1000)}
_TRACKS = {
    "development": {"usi_track1": (0, 2800), "usi_day1": (0, 1889), "circuit_launch": (0, 500)},
    "second": {"usi_day2": (0, 3070), "usi_day1": (1889, 3778), "circuit_launch": (500, 1000)},
    "held-out": _ALL,
    "fourth": _ALL,
}


class Drive(NamedTuple):
    """A session.

    Attributes:
        place: Name of the building or track; drives of one place share the frame of their truth.
        kind: World, recording or kind of building.
        source: Specification of the frames.
        span: First frame, and the frame after the last.
        values: Parameters.
    """

    place: str
    kind: str
    source: str
    span: tuple[int, int]
    values: dict[str, Any]


class Driven(NamedTuple):
    """A map and the truth about it.

    Attributes:
        drive: How it was made.
        brain: The brain at the end.
        truth: True x, y in metres and heading of each experience, ``(n, 3)``; of a track without
            metric truth, the point of a circle of circumference 1 at the phase of the lap.
        lap_m: Length of a lap in the unit of the truth.
        known_scale: Whether odometry measures metres.
    """

    drive: Drive
    brain: NavigationBrain
    truth: np.ndarray
    lap_m: float
    known_scale: bool


class Pair(NamedTuple):
    """Two drives, by number, the kind of the pair, and whether they overlap."""

    one: int
    other: int
    kind: str
    overlaps: bool


def drives(half: str) -> list[Drive]:
    """Return the drives of a set."""
    seed = HALVES[half]
    rng = np.random.default_rng([17, seed])
    found: list[Drive] = []
    for name, values in _WORLDS.items():
        for look in (10 * seed, 10 * seed + 1):
            found += [_rendered(rng, name, look, values) for _ in range(4)]
    for threshold in (0.05, 0.1, 0.15):
        values = {"view": {"threshold": threshold}}
        for kind in ("ring", "aisle"):
            for number in range(8):
                building = f"{kind}?building={100 * seed + number}"
                found.append(_wallpapered(rng, kind, building, values))
    for name in ("corridor", "ellipse"):
        for look, threshold in ((10 * seed + 2, 0.12), (10 * seed + 3, 0.12),
                                (10 * seed + 4, 0.15), (10 * seed + 5, 0.15)):  # fmt: skip
            values = {"view": {"threshold": threshold}}
            found += [_rendered(rng, name, look, values) for _ in range(2)]
    for name, (first, last) in _TRACKS[half].items():
        for threshold, n in ((None, 10), (0.12, 4), (0.15, 4)):
            found += [_recorded(rng, name, first, last, threshold) for _ in range(n)]
            if threshold is None and name != "circuit_launch":
                found += [_recorded(rng, name, first, last, None, (40, 80)) for _ in range(6)]
    return found


def _rendered(rng: np.random.Generator, name: str, look: int, values: dict[str, Any]) -> Drive:
    start, laps = rng.uniform(0.0, 1.0), rng.uniform(0.5, 1.8)
    noise, light = rng.uniform(0.01, 0.05), rng.uniform(0.0, 0.2)
    people = int(rng.integers(0, 4))
    source = (
        f"world:{name}?look={look}&start={start:.3f}&laps={laps:.3f}&noise={noise:.3f}"
        f"&light={light:.2f}&people={people}&seed={rng.integers(1_000_000)}&grey=true"
    )
    return Drive(f"{name} {look}", name, source, (0, -1), values)


def _wallpapered(
    rng: np.random.Generator, kind: str, building: str, values: dict[str, Any]
) -> Drive:
    start = rng.uniform(0.0, 1.0)
    laps = rng.uniform(0.5, 1.2) if kind == "ring" else 0.0
    source = (
        f"{building}&start={start:.3f}&laps={laps:.3f}&noise={rng.uniform(0.01, 0.05):.3f}"
        f"&light={rng.uniform(0.0, 0.1):.2f}&seed={rng.integers(1_000_000)}"
    )
    return Drive(building, kind, source, (0, -1), values)


def _recorded(
    rng: np.random.Generator,
    name: str,
    first: int,
    last: int,
    threshold: float | None,
    lengths: tuple[int, int] = (150, 600),
) -> Drive:
    length = int(rng.integers(lengths[0], min(lengths[1], last - first)))
    begin = int(rng.integers(first, last - length))
    values = read_preset("rc_car")
    if threshold is not None:
        values = merge_values(values, {"view": {"threshold": threshold}})
    place = "usi" if name.startswith("usi") else name
    return Drive(place, name, name, (begin, begin + length), values)


def wallpapered(number: int, straight: bool) -> World:
    """Build an office building in which every 2.4 m of wall look the same.

    Args:
        number: Its seed, which decides the lengths of its corridors and nothing else.
        straight: Make the corridors so long that a drive stays in one.
    """
    site, rng, height, per_m = Site(0), np.random.default_rng([31, number]), 2.6, 64.0
    tile = paint.interior(np.random.default_rng(7), 2.4, height, per_m)

    def painter(_rng: np.random.Generator, length_m: float) -> tuple[np.ndarray, float]:
        columns = np.arange(round(length_m * per_m)) % tile.shape[1]
        return np.ascontiguousarray(tile[:, columns]), per_m

    x, y = rng.uniform(11.0, 15.0, 2) if straight else rng.uniform(3.0, 8.0, 2)
    ring = [(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]
    outer = [(math.copysign(abs(a) + 0.9, a), math.copysign(abs(b) + 0.9, b)) for a, b in ring]
    inner = [(math.copysign(abs(a) - 0.9, a), math.copysign(abs(b) - 0.9, b)) for a, b in ring]
    site.wall(outer[::-1], painter)
    site.wall(inner, painter)
    width, depth = 2.0 * x + 2.0, 2.0 * y + 2.0
    ground = paint_outdoors.floor(np.random.default_rng(7), width, depth, 20.0, "tiles")
    lights = paint_outdoors.lamps(np.random.default_rng(7), width, depth, 20.0)
    route = rounded_route(ring[:-1], 0.8)
    return site.build(
        name="wallpaper",
        description="Office building with one wallpaper",
        ground=Surface(ground.image, 20.0, -x - 1.0, -y - 1.0, 0.0),
        ceiling=Surface(lights.image, 20.0, -x - 1.0, -y - 1.0, height),
        routes=[route],
        sense=Sense(frames_per_lap=round(route.length_m / 0.1)),
        sight_m=16.0,
    )


@lru_cache(maxsize=1)
def _building(number: int, straight: bool) -> World:
    return wallpapered(number, straight)


def _open_world(drive: Drive) -> WorldSource:
    if drive.source.startswith("world:"):
        source = open_source(drive.source, 10.0)
        assert isinstance(source, WorldSource)
        return source
    kind, _, query = drive.source.partition("?")
    given = dict(item.split("=") for item in query.split("&"))
    number, straight = int(given.pop("building")), kind == "aisle"
    world = _building(number, straight)
    if straight:  # from 1 m behind one corner to 1.5 m before the next
        rng = np.random.default_rng([32, number, round(1000 * float(given["start"]))])
        lap, n = world.routes[0].poses(4000), 4000
        along = np.abs(lap[:, 2] - np.round(lap[:, 2] / (TWO_PI / 4)) * (TWO_PI / 4)) < 1e-6
        begins = np.flatnonzero(along & ~np.roll(along, 1))
        begin = int(rng.choice(begins))
        steps = int(np.argmin(np.roll(along, -begin)))
        edge = round(n * 1.0 / world.routes[0].length_m)
        given["start"] = f"{(begin + edge) % n / n}"
        given["laps"] = f"{max(steps - 3 * edge, 10 * edge) / n}"
    options = WorldOptions.model_validate({"grey": True, **given})
    return WorldSource("wallpaper", options, world)


@lru_cache(maxsize=4)
def _recording(path: Path) -> list[Frame]:
    return list(open_source(path / "frames.tar", 20.0).frames())


@lru_cache(maxsize=4)
def _phases(path: Path) -> np.ndarray:
    """Return the point of each frame on a circle of circumference 1; NaN for a track without."""
    if not (path / "laps.csv").is_file():
        return np.full((len(_recording(path)), 3), np.nan)
    lap = TWO_PI * np.loadtxt(path / "laps.csv", delimiter=",", skiprows=1)[:, 2]
    return np.column_stack([np.cos(lap) / TWO_PI, np.sin(lap) / TWO_PI, np.zeros(len(lap))])


@torch.inference_mode()
def run_drive(drive: Drive, data: Path) -> Driven:
    """Map a drive."""
    # A session is one map here: a break would leave its first part out.
    values = merge_values(drive.values, {"sessions": {"kidnapped": "ignore"}})
    config = build_config(values, drive.source)
    frames: Iterable[Frame]
    if drive.kind in RECORDINGS:
        first, last = drive.span
        frames = _recording(data / drive.kind)[first:last]
        truths, lap_m, known = _phases(data / drive.kind), 1.0, False
        if drive.kind == "circuit_launch":
            lap_m = math.nan
    else:
        source = _open_world(drive)
        frames, truths = source.frames(), source.truths()
        lap_m, known = source.route.length_m, drive.kind != "figure_eight"
    brain = NavigationBrain(config)
    brain.about = (drive.source, "", "")
    for frame in frames:
        brain(frame)
    made = brain.map.experiences["first_frame"].numpy()
    return Driven(drive, brain, truths[made], lap_m, known)


def pairs(half: str, driven: list[Driven]) -> list[Pair]:
    """Choose the pairs of a set: as many of each kind as ``N_TRUE`` and ``N_FALSE`` say."""
    rng = np.random.default_rng([18, HALVES[half]])
    found: dict[str, list[Pair]] = {kind: [] for kind in (*N_TRUE, *N_FALSE)}
    for i, j in combinations(range(len(driven)), 2):
        kind = _kind(driven[i], driven[j])
        if kind:
            overlaps = kind in N_TRUE
            one, other = (i, j) if rng.uniform() < 0.5 else (j, i)
            found[kind].append(Pair(one, other, kind, overlaps))
    chosen: list[Pair] = []
    for kind, n in (N_TRUE | N_FALSE).items():
        some = found[kind]
        if len(some) < n:
            raise RunError(f"merging-pairs: only {len(some)} pairs of {kind!r}; expected {n}")
        chosen += [some[k] for k in sorted(rng.choice(len(some), n, replace=False))]
    return chosen


def _kind(one: Driven, other: Driven) -> str:
    """Return the kind of a pair; empty if it is not used."""
    a, b = one.drive, other.drive
    if a.values != b.values:
        return ""
    few = a.values.get("view", {}).get("threshold", 0.0) >= 0.12
    if a.place == b.place:
        if few or a.kind in ("ring", "aisle", "circuit_launch"):
            return ""
        common = overlap(one, other)
        if common >= LEAST_OVERLAP:
            if a.kind not in RECORDINGS:
                return "rendered"
            same = a.kind == b.kind
            if same and max(a.span[0], b.span[0]) < min(a.span[1], b.span[1]):
                return ""  # the same frames
            return "cuts of one recording" if same else "two recordings of one track"
        return "other parts of one track" if common == 0.0 and a.kind in RECORDINGS else ""
    if few:
        return "few templates"
    if "aisle" in (a.kind, b.kind):
        return "straight aisles"
    if a.kind == "ring" and b.kind == "ring":
        return "one wallpaper"
    if a.kind in _WORLDS and b.kind in _WORLDS:
        return "other textures"
    return "other tracks" if a.kind in RECORDINGS and b.kind in RECORDINGS else ""


def overlap(one: Driven, other: Driven) -> float:
    """Return the common path of two drives of one place, in laps."""
    apart = _apart(one.truth[:, None], other.truth[None])
    near = (apart < SAME_PLACE * one.lap_m).any(axis=1)
    steps = np.linalg.norm(np.diff(one.truth[:, :2], axis=0), axis=1)
    steps = np.append(np.minimum(steps, SAME_PLACE * one.lap_m), 0.0)
    share = steps[near].sum() / one.lap_m
    return float(share)


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of true poses; infinite where the headings differ by 45 degrees."""
    turn = np.abs((a[..., 2] - b[..., 2] + math.pi) % TWO_PI - math.pi)
    distance = np.linalg.norm(a[..., :2] - b[..., :2], axis=-1)
    return np.where(turn > math.pi / 4, np.inf, distance)


@torch.inference_mode()
def try_pair(pair: Pair, driven: list[Driven]) -> dict[str, Any]:
    """Match and merge a pair; return the result beside the truth."""
    loaded, partial = driven[pair.one], driven[pair.other]
    row: dict[str, Any] = {
        "kind": pair.kind, "overlaps": pair.overlaps, "one": pair.one, "other": pair.other,
        "loaded": loaded.drive.source, "partial": partial.drive.source,
        "threshold": loaded.brain.config.view.threshold,
        "templates": (loaded.brain.view.n, partial.brain.view.n),
    }  # fmt: skip
    found = find_match(loaded.brain, partial.brain)
    row |= {"merged": False, "reason": found.reason, "groups": found.groups[:3]}
    if found.match is None:
        return row
    matched = found.match.pairs
    merged, report = loaded.brain.merge(partial.brain, found.match)
    row |= {"merged": merged is not None, "found": found.reason, "reason": report.reason}
    row["pairs"] = len(matched.partial)
    if not pair.overlaps or not math.isfinite(loaded.lap_m):
        return row
    apart = _apart(loaded.truth[matched.loaded], partial.truth[matched.partial])
    allowed = SAME_PLACE if pair.kind == "rendered" else WRONG_PLACE
    row["pairs_wrong"] = float((apart > allowed * loaded.lap_m).mean())
    row["right"] = row["pairs_wrong"] <= 0.05
    if merged is not None and pair.kind == "rendered":
        row |= _accuracy(loaded, partial, merged)
        row["right"] &= row["ate_of_lap"] <= max(2.0 * row["ate_before_of_lap"], 0.02)
    return row


def _accuracy(loaded: Driven, partial: Driven, merged: NavigationBrain) -> dict[str, float]:
    """Return the error of the experiences of both maps and of the merged one, in laps."""
    merged.map.state.at_rest = 0
    merged.map.relax(3000)
    sessions = merged.map.experiences["session"].numpy()
    numbers = merged.map.experiences["number"].numpy()
    truth = np.empty((merged.map.n, 2))
    for one in (loaded, partial):
        own = sessions == one.brain.sessions.now.id
        truth[own] = one.truth[numbers[own], :2]
    mode = "rigid" if loaded.known_scale else "similarity"

    def error(poses: np.ndarray, true: np.ndarray) -> float:
        off = align(poses[:, :2], true, mode).apply(poses[:, :2]) - true
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) / loaded.lap_m

    before = max(error(one.brain.map.poses, one.truth[:, :2]) for one in (loaded, partial))
    return {"ate_of_lap": error(merged.map.poses, truth), "ate_before_of_lap": before}


def table(rows: list[dict[str, Any]], half: str) -> list[dict[str, Any]]:
    """Count the merges of each kind of pair."""
    found = []
    for kind in (*N_TRUE, *N_FALSE):
        of_kind = [row for row in rows if row["kind"] == kind]
        merged = [row for row in of_kind if row["merged"]]
        found.append(
            {
                "half": half,
                "kind": kind,
                "overlaps": kind in N_TRUE,
                "pairs": len(of_kind),
                "merged": len(merged),
                "right": sum(bool(row.get("right")) for row in merged) if kind in N_TRUE else None,
            }
        )
    return found


def merging_pairs(data: Path, out: Path) -> dict[str, Any]:
    """Try 100 pairs of maps that overlap and 300 that do not, in each set.

    Args:
        data: Folder that holds the recordings.
        out: Folder to write.
    """
    rows: list[dict[str, Any]] = []
    tries: list[dict[str, Any]] = []
    for half in HALVES:
        driven = [run_drive(drive, Path(data)) for drive in drives(half)]
        of_half = [try_pair(pair, driven) for pair in pairs(half, driven)]
        rows += table(of_half, half)
        tries += [{"half": half, **row} for row in of_half]
    results = {"experiment": "merging-pairs", "rows": rows, "tries": tries}
    text = json.dumps(results, indent=1) + "\n"
    write_atomically(
        Path(out) / "results.json", lambda path: path.write_text(text, encoding="utf-8")
    )
    return results
