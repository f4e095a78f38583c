"""Maps of place cells by SLRB, competitive Hebbian learning, RatSLAM and path integration.

Paper: SLRB, Figs. 7, 8, 9, 12 and 13; it gives 0.031 m on the Hafting track after half an hour,
47.2 % less than competitive Hebb and 56.9 % less than RatSLAM. Differences and conditions:

- Competitive Hebb is the same network without correction by walls; its integrator is plain path
  integration, to which it adds the error of its winning cell.
- RatSLAM is its pose cells alone, without correction by views, as in the paper.
- The several place cells that respond until walls correct (Fig. 8) are not reproduced: drift moves
  the phases of all modules together, so the pattern of the grid cells stays sharp, but is that of
  a wrong position.
- The reduction of the number of cells by half is not reproduced: competitive Hebb has 15 to 30 %
  more cells. RatSLAM has 70 to 90 % more for another reason: its cells are a lattice, which needs
  more cells for a plane than place cells with a least distance.
- The error of the winner is that of the winning cell's centre, which is above 0 for cells 0.06 m
  apart.
- By default the bearing of a wall is relative to the true heading, and gets the noise of the
  compass when the compass is added. The reference figures used bearings relative to the noisy
  compass, in which that noise cancels: an easier sense, which is a condition of its own here.
"""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroslam.config import BrainConfig, PlaceCellConfig
from neuroslam.evaluation.ratemap import responding
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.experiments.animals import (
    TRACKS,
    WALLS,
    arena_of,
    position_errors,
    read_track,
    run_cells,
)
from neuroslam.experiments.place_methods import (
    EASY,
    FULL,
    HEBB,
    PATH,
    RATSLAM,
    SLRB,
    MethodResult,
    PlaceCellLog,
    TrackResult,
    run_track,
)
from neuroslam.figures.place_errors import Spread, plot_errors, plot_growth, plot_sweep
from neuroslam.figures.places import (
    EstimatedPath,
    PlaceMap,
    Response,
    plot_paths,
    plot_place_maps,
    plot_responses,
)
from neuroslam.figures.style import save
from neuroslam.runs.parallel import parallel_map
from neuroslam.state.files import write_atomically
from neuroslam.worlds.senses import SenseNoise, sense

PAPER = {
    "mean_error_m": 0.031,
    "mean_error_m_below_hebb_percent": 47.2,
    "mean_error_m_below_ratslam_percent": 56.9,
}
"""The paper's values, for the Hafting track."""

RATIO_TARGETS = dict.fromkeys(TRACKS, 0.25) | {"hafting": 0.40, "sargolini": 0.55}
ERROR_TARGETS_M = dict.fromkeys(TRACKS, 0.035) | {"hafting": 0.05, "sargolini": None}
ALIGNED_TARGET_M = 0.030
BELOW_HEBB_TARGET_PERCENT, BELOW_RATSLAM_TARGET_PERCENT = 47.0, 57.0
GROWTH_TARGET_PERCENT, SINGLE_TARGET = 5.0, 0.95
_COMPARED = "mean_error_m", "last_sixth_mean_error_m", "winner_mean_error_m"
_CURVE_POINTS = 30
_PATH_SHARE = 0.1  # share of the time, at the end, of the paths drawn: longer ones overlap


def summarise(results: Sequence[MethodResult]) -> list[dict[str, Any]]:
    """Return means and sds over seeds: a row for each track, condition and method."""
    rows = []
    for one in results:
        errors = position_errors(one.estimate_m, one.truth_m)
        free = _counterpart(results, one, PATH)
        drifted = position_errors(free.estimate_m, free.truth_m)
        last = one.minutes >= one.minutes[-1] * 5 / 6
        distance = np.linalg.norm(one.estimate_m - one.truth_m, axis=-1)
        aligned = [absolute_trajectory_error(x, one.truth_m, "rigid").mean for x in one.estimate_m]
        values = {
            "mean_error_m": errors.mean_m,
            "rmse_m": errors.rmse_m,
            "mean_error_aligned_m": np.array(aligned),
            "rmse_aligned_m": errors.aligned_m,
            "ratio_to_path_integration": errors.rmse_m / drifted.rmse_m.mean(),
            "ratio_aligned": errors.aligned_m / drifted.aligned_m.mean(),
            "last_sixth_mean_error_m": distance[:, last].mean(axis=1),
        }
        if one.winner_m is not None:
            values["winner_mean_error_m"] = position_errors(one.winner_m, one.truth_m).mean_m
        if one.cells is not None:
            values["cells"] = one.cells.values[:, -1]
            values["cells_growth_last_third_percent"] = growth_percent(one.cells)
        row: dict[str, Any] = {"track": one.track, "condition": one.condition, "method": one.method}
        for key, value in values.items():
            row |= {key: float(np.mean(value)), f"{key}_sd": float(np.std(value))}
        rows.append(row | dict(one.more))
    for row in rows:
        if row["method"] == SLRB:
            for other in (HEBB, RATSLAM):
                base = _row_of(rows, row, other)
                for key in _COMPARED:
                    row[f"{key}_below_{other.split()[-1].lower()}_percent"] = 100.0 * (
                        1.0 - row[key] / base[key]
                    )
    return rows


def growth_percent(cells: Spread) -> np.ndarray:
    """Return the growth of the number of cells in the last third of the time, ``(seeds,)``.

    Example:
        >>> growth_percent(Spread(np.array([0.0, 20.0, 30.0]), np.array([[1, 100, 104]])))
        array([4.])
    """
    then = int(np.searchsorted(cells.minutes, cells.minutes[-1] * 2 / 3 - 1e-9))
    return np.asarray(100.0 * (cells.values[:, -1] / cells.values[:, then] - 1.0))


def _motion(condition: str) -> str:
    """Return the condition with the same noise of motion, which all methods have run."""
    return FULL if condition == EASY else condition


def _counterpart(results: Sequence[MethodResult], one: MethodResult, method: str) -> MethodResult:
    wanted = one.track, _motion(one.condition), method
    return next(o for o in results if (o.track, o.condition, o.method) == wanted)


def _row_of(
    rows: Sequence[Mapping[str, Any]], row: Mapping[str, Any], method: str
) -> Mapping[str, Any]:
    wanted = row["track"], _motion(row["condition"]), method
    return next(r for r in rows if (r["track"], r["condition"], r["method"]) == wanted)


def check_targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Compare SLRB at full noise with the targets and with the paper.

    Args:
        rows: Rows of :func:`summarise`.

    Returns:
        Rows of ``track``, ``what``, ``ours``, ``target``, whether it is ``met``, and the value of
        the ``paper`` where it has one: for the Hafting track.
    """
    growth = "cells_growth_last_third_percent"
    checks = []
    for row in rows:
        if (row["condition"], row["method"]) != (FULL, SLRB):
            continue
        track, hebb = row["track"], _row_of(rows, row, HEBB)
        targets = (
            ("ratio_to_path_integration", "<=", RATIO_TARGETS[track]),
            ("mean_error_m", "<=", ERROR_TARGETS_M[track]),
            ("mean_error_aligned_m", "<=", ALIGNED_TARGET_M),
            ("mean_error_m_below_hebb_percent", ">=", BELOW_HEBB_TARGET_PERCENT),
            ("mean_error_m_below_ratslam_percent", ">=", BELOW_RATSLAM_TARGET_PERCENT),
            (growth, "<=", min(GROWTH_TARGET_PERCENT, hebb[growth])),
            ("one_cell_share", ">=", SINGLE_TARGET),
        )
        for what, sign, target in targets:
            if target is None:
                continue
            met = row[what] <= target if sign == "<=" else row[what] >= target
            paper = PAPER.get(what) if track == "hafting" else None
            checks.append(
                {"track": track, "what": what, "ours": row[what], "target": f"{sign} {target:.4g}",
                 "met": bool(met), "paper": paper}
            )  # fmt: skip
    return checks


_SHORT = (
    "track", "condition", "method", "mean_error_m", "rmse_m", "rmse_aligned_m",
    "ratio_to_path_integration", "winner_mean_error_m", "cells",
)  # fmt: skip


def place_map(
    data_folder: Path,
    out_folder: Path,
    tracks: Sequence[str] = tuple(TRACKS),
    minutes: float = 30.0,
    seeds: Sequence[int] = range(10),
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Map five tracks with and without walls, and with pose cells (Figs. 8, 9, 12, 13).

    Args:
        data_folder: Holds the recordings of ``TRACKS``.
        out_folder: ``results.json`` and the figures are written there.
        tracks: Names in ``TRACKS``.
        minutes: Duration; at most 20 min of Sargolini's rat.
        seeds: Seed of the noise of each animal.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`: tracks in parallel.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`; the folders must be on a disk that
            all machines share.

    Returns:
        The content of ``results.json``: ``rows`` in short, ``details`` with standard deviations
        over seeds and the responses, ``checks`` of the targets, and values of the ``paper``.
    """
    out = Path(out_folder).resolve()
    run = partial(_run_and_draw, Path(data_folder).resolve(), out, minutes, seeds)
    results = [one for each in parallel_map(run, tracks, jobs, ray) for one in each]
    details = summarise(results)
    _draw_errors(results, out)
    return _write(
        out,
        {
            "experiment": "place-map",
            "rows": [{key: row.get(key) for key in _SHORT} for row in details],
            "checks": check_targets(details),
            "details": details,
            "paper": PAPER,
            "minutes": minutes,
            "seeds": len(seeds),
        },
    )


def _run_and_draw(
    data: Path, out: Path, minutes: float, seeds: Sequence[int], name: str
) -> list[MethodResult]:
    result = run_track(data, name, minutes, seeds)
    draw_track(result, out)
    return result.results


def _write(out: Path, results: dict[str, Any]) -> dict[str, Any]:
    text = json.dumps(results, indent=1).replace("NaN", "null") + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    return results


def _draw_errors(results: Sequence[MethodResult], out: Path) -> None:
    errors: dict[str, dict[str, np.ndarray]] = {}
    for one in results:
        if one.condition == FULL and one.method != PATH:
            mean = position_errors(one.estimate_m, one.truth_m).mean_m
            errors.setdefault(one.method, {})[one.track] = mean
    marks = {"paper's SLRB, Hafting": PAPER["mean_error_m"]}
    save(
        plot_errors(errors, marks, "Position error by method; SLRB corrects drift by walls"),
        out / "errors.png",
    )


def draw_track(result: TrackResult, out: Path) -> None:
    """Write the figures of a track: maps, paths, responses, curves."""
    name, walk, arena = result.name, result.walk, arena_of(result.walk)
    full = {one.method: one for one in result.results if one.condition == FULL}
    slrb, hebb, pose = (full[method] for method in (SLRB, HEBB, RATSLAM))
    times = (f"{result.early_min:.3g} min", f"{slrb.minutes[-1]:.3g} min")
    sources = (
        (SLRB, result.logs[SLRB].maps),
        (HEBB, result.logs[HEBB].maps),
        (f"{RATSLAM} pose cells", result.pose_maps),
    )
    maps = [
        [PlaceMap(f"{method}, {when}", *kept[i]) for method, kept in sources]
        for i, when in enumerate(times)
    ]
    truth = walk.positions
    title = f"Maps of cells on the {name} track, first seed"
    save(plot_place_maps(maps, arena, truth, title), out / f"{name}_maps.png")
    walls = result.walls
    feet = torch.stack(
        [
            walls.x_m + walls.distance_m * walls.bearing_rad.cos(),
            walls.y_m + walls.distance_m * walls.bearing_rad.sin(),
        ],
        dim=1,
    ).numpy()
    last = slrb.minutes >= slrb.minutes[-1] * (1.0 - _PATH_SHARE)
    paths = [
        EstimatedPath(SLRB, slrb.estimate_m[0, last], feet + truth[0]),
        EstimatedPath(PATH, full[PATH].estimate_m[0, last]),
    ]
    span = f"{slrb.minutes[last][0]:.3g} to {times[1]}"
    title = f"Estimated and true path on the {name} track, {span}, first seed"
    save(plot_paths(paths, arena, truth[last], title), out / f"{name}_paths.png")
    if picture := _responses(result):
        at = (walk.times_s[picture[0]] - walk.times_s[0]) / 60.0
        title = (
            f"Place cells beside a wall, {name} track, {at:.1f} min: most cells without correction"
        )
        save(plot_responses(picture[1], arena, title), out / f"{name}_responses.png")
    cells = {one.method: one.cells for one in (slrb, hebb, pose) if one.cells is not None}
    errors = {SLRB: _curve(slrb), HEBB: _curve(hebb), RATSLAM: _curve(pose)}
    marks = {"paper's SLRB at the end": PAPER["mean_error_m"]} if name == "hafting" else {}
    title = f"Place cells and errors on the {name} track; no walls for {HEBB} and {RATSLAM}"
    save(plot_growth(cells, errors, marks, title), out / f"{name}_growth.png")


def _responses(result: TrackResult) -> tuple[int, list[Response]] | None:
    """Return the last step with the largest number of responding cells without correction."""
    before, after = result.logs[HEBB].looks, result.logs[SLRB].looks
    common = sorted(before.keys() & after.keys())
    if not common:
        return None
    most = [int(responding(before[i][2][None])[0]) for i in common]
    step = common[len(most) - 1 - int(np.argmax(most[::-1]))]
    here = result.walk.positions[step]
    return step, [
        Response("Without correction, grid only", before[step][0], before[step][2], here),
        Response("With correction by walls", after[step][0], after[step][1], here),
    ]


def _curve(one: MethodResult) -> Spread:
    """Return the mean error in each of 30 windows of time."""
    distance = np.linalg.norm(one.estimate_m - one.truth_m, axis=-1)
    parts = np.array_split(np.arange(len(one.minutes)), _CURVE_POINTS)
    return Spread(
        np.array([one.minutes[part].mean() for part in parts]),
        np.stack([distance[:, part].mean(axis=1) for part in parts], axis=1),
    )


def threshold_sweep(
    data_folder: Path,
    out_folder: Path,
    thresholds_m: Sequence[float] = (0.04, 0.06, 0.08, 0.10, 0.15),
    track: str = "hafting",
    minutes: float = 30.0,
    seeds: Sequence[int] = range(10),
) -> dict[str, Any]:
    """Vary the least distance between place cells (Fig. 7).

    The paper has the least error at 0.06 m. Here the error of the winner rises with the distance,
    which is the resolution of the cells, and the integrated position does not depend on it.

    Args:
        data_folder: Holds the recordings of ``TRACKS``.
        out_folder: ``results.json`` and ``thresholds.png`` are written there.
        thresholds_m: Distances, rising.
        track: Name in ``TRACKS``.
        minutes: Duration.
        seeds: Seed of the noise of each animal.

    Returns:
        The content of ``results.json``: ``rows``, and the distances of the least error here and in
        the paper.
    """
    walk = read_track(Path(data_folder), track, minutes)
    senses = sense(walk, SenseNoise(), seeds, k=WALLS)
    rows, winners, integrators, counts = [], [], [], []
    for threshold in thresholds_m:
        log = PlaceCellLog(np.zeros(senses.speed_m_s.shape, dtype=bool), walk.positions[0], 0)
        run_cells(senses, BrainConfig(place_cells=PlaceCellConfig(threshold_m=threshold)), log)
        start = walk.positions[0]
        apart = [
            np.linalg.norm(x + start - walk.positions[:, None], axis=-1)
            for x in (log.winner, log.estimate)
        ]
        winners.append(apart[0].ravel())
        integrators.append(apart[1].ravel())
        counts.append(log.counted[-1])
        row = {"threshold_m": threshold}
        for name, error in zip(("winner", "integrator"), apart, strict=True):
            mean = error.mean(axis=0)
            row |= {
                f"{name}_mean_error_m": float(mean.mean()),
                f"{name}_mean_error_m_sd": float(mean.std()),
                f"{name}_median_error_m": float(np.median(error)),
            }
        rows.append(row | {"cells": float(counts[-1].mean()), "cells_sd": float(counts[-1].std())})
    title = f"Error over the least distance between place cells, {track} track"
    out = Path(out_folder)
    save(plot_sweep(thresholds_m, winners, integrators, counts, title), out / "thresholds.png")
    least = min(rows, key=lambda row: row["winner_mean_error_m"])
    return _write(
        out,
        {
            "experiment": "threshold-sweep",
            "rows": rows,
            "paper_threshold_of_least_error_m": 0.06,
            "our_threshold_of_least_winner_error_m": least["threshold_m"],
            "track": track,
            "minutes": minutes,
            "seeds": len(seeds),
        },
    )
