"""The experiments of the multisession paper, each against a single session over the same frames.

Menezes et al., "A Multisession SLAM Approach for RatSLAM", J. Intell. Robot. Syst. 108:61, 2023.
Where the paper has recordings that are not free, a rendered world has the same course.
"""

import json
import math
from collections.abc import Callable
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.evaluation.icp import map_rmse
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.lives import Life, bindings, live, measure, stages, track
from neuroslam.figures.sessions import plot_accuracy, plot_bindings, plot_overlay, plot_stages
from neuroslam.figures.style import save
from neuroslam.merging.match import find_match
from neuroslam.sensors import Source, open_source
from neuroslam.state.files import write_atomically

Cut = tuple[int, int]
"""First frame of a session, and the frame before which it ends."""


class Plan(NamedTuple):
    """An experiment.

    Attributes:
        title: What its figures are headed with.
        source: What the single session drives through.
        cuts: Works out the sessions from the opened source.
        config: Parameters that differ from the defaults.
        paper_rmse: The paper's ICP RMSE, in its own map units; NaN where it has none.
        preset: What the parameters are laid over.
    """

    title: str
    source: str
    cuts: Callable[[Source], list[Cut]]
    config: dict[str, Any] = {}  # noqa: RUF012
    paper_rmse: float = math.nan
    preset: str = ""


def equal_parts(k: int) -> Callable[[Source], list[Cut]]:
    """Cut a source into ``k`` sessions of equal length.

    Example:
        >>> from types import SimpleNamespace
        >>> equal_parts(2)(SimpleNamespace(n_frames=101))
        [(0, 50), (50, 101)]
    """
    return lambda source: [
        (source.n_frames * i // k, source.n_frames * (i + 1) // k) for i in range(k)
    ]


def _virtual_tour(_source: Source) -> list[Cut]:
    """Three quarters of a lap of 400 frames; then almost three laps from an unknown place."""
    return [(0, 300), (320, 1520)]


def _lab_tour(source: Source) -> list[Cut]:
    """Two laps of one rectangle; then from the far side of the other, until the end."""
    laps = source.n_frames / 5.0
    return [(0, round(2.0 * laps)), (round(2.5 * laps), source.n_frames)]


def _town(source: Source) -> list[Cut]:
    """Two laps around each block, and the outer lap."""
    return _split_where(source, (0.0, 0.0), 4.0, (3, 5, 7, 9))


def _campus(source: Source) -> list[Cut]:
    """Laps of the court; then of the park, to where that tour leaves it; then of everything."""
    truth = source.truths()
    in_park = np.flatnonzero(truth[:, 0] > 10.0)
    first = int(in_park[0])
    court = np.flatnonzero((truth[:, 0] < -25.0) & (np.arange(len(truth)) > first))
    return [(0, first), (first, int(court[0])), (int(court[0]), source.n_frames)]


def _split_where(
    source: Source, at_m: tuple[float, float], radius_m: float, passes: tuple[int, ...]
) -> list[Cut]:
    """Cut a drive where it passes a place, at these passes."""
    apart = np.hypot(*(source.truths()[:, :2] - at_m).T)
    inside = np.flatnonzero((apart[1:] < radius_m) & (apart[:-1] >= radius_m)) + 1
    ends = [int(inside[k - 1]) for k in passes]
    return list(zip([0, *ends], [*ends, source.n_frames], strict=True))


PLANS = {
    "virtual-tour": Plan(
        "Virtual tour",
        "world:ellipse?laps=3.8&width=256&height=64",
        _virtual_tour,
        paper_rmse=0.00773327,
    ),
    "lab-tour": Plan(
        "Lab tour",
        "world:figure_eight?route=2&laps=1&width=256&height=128",
        _lab_tour,
        {"odometry": {"speed_scaling_m_s": 50.0}, "pose_cells": {"cell_size_m": 0.5}},
        paper_rmse=0.00883269,
    ),
    "five-sessions": Plan(
        "Five sessions in a town",
        "world:town?route=6&laps=1&noise=0.03",
        _town,
        {
            "view": {"threshold": 0.035, "template_height": 20},
            "pose_cells": {"cell_size_m": 2.0},
        },
        paper_rmse=0.0127,
    ),
    "campus": Plan(
        "Three sessions on a campus",
        "world:campus?route=4&laps=1&noise=0.02&grey=true",
        _campus,
        {
            "view": {"threshold": 0.02, "panoramic": True},
            "pose_cells": {"cell_size_m": 2.0},
        },
        paper_rmse=85.0,
    ),
}


class Result(NamedTuple):
    """Lives of an experiment: the single session's, and the sessions'."""

    single: Life
    lives: list[Life]
    cuts: list[Cut]
    source: Source


def run_plan(plan: Plan, overrides: dict[str, Any] | None = None) -> Result:
    """Live through all frames at once, and in sessions, each with the map of those before."""
    values = merge_values(read_preset(plan.preset) if plan.preset else {}, plan.config)
    config = build_config(merge_values(values, overrides or {}), plan.title)
    source = open_source(plan.source, config.frame_rate_hz)
    single = live(source.frames(), config, name=plan.source)
    cuts = plan.cuts(source)
    return Result(single, _sessions(plan, config, source, cuts), cuts, source)


def _sessions(plan: Plan, config: BrainConfig, source: Source, cuts: list[Cut]) -> list[Life]:
    lives: list[Life] = []
    for first, stop in cuts:
        stored = lives[-1].brain if lives else None
        lives.append(live(source.frames(first, stop), config, stored, plan.source))
    return lives


def _rows(plan: Plan, result: Result, name: str = "multi-session") -> list[dict[str, Any]]:
    everything = np.arange(len(result.single.trace["session"]))
    rows = [measure("single session", [result.single], None, everything)]
    rows.append(measure(name, result.lives, result.single, _lived(result.cuts)))
    rows[-1]["paper_icp_rmse_in_its_units"] = plan.paper_rmse
    return rows


def _lived(cuts: list[Cut]) -> np.ndarray:
    return np.array(list(chain.from_iterable(range(*cut) for cut in cuts)))


def draw(plan: Plan, result: Result, out: Path, stem: str = "") -> None:
    """Write the figures: stages, bindings, overlay of both maps, tracks against the truth."""
    single, lives = result.single, result.lives
    save(plot_stages(stages(single, lives), plan.title), out / f"{stem}stages.png")
    if any(life.joints for life in lives):
        cells = single.brain.config.pose_cells
        torus = (cells.n_xy, cells.n_xy, cells.n_theta)
        save(plot_bindings(bindings(single, lives), torus, plan.title), out / f"{stem}bindings.png")
    here, there = lives[-1].brain.map, single.brain.map
    found = map_rmse(here.poses[:, :2], there.poses[:, :2], "rigid")
    diagonal = float(np.linalg.norm(np.ptp(there.poses[:, :2], axis=0)))
    links = [np.column_stack(one.links[:2]) for one in (there, here)]
    overlay = plot_overlay(
        there.poses[:, :2],
        found.alignment.apply(here.poses[:, :2]),
        found.rmse,
        found.rmse / diagonal,
        f"{plan.title}: merged map on the single session's",
        *links,
    )
    save(overlay, out / f"{stem}overlay.png")
    rows = []
    n_single = len(single.trace["session"])
    ends = np.cumsum([0, *(len(life.trace["session"]) for life in lives)]).tolist()
    for name, own, ranges in (
        ("single session", [single], [(0, n_single)]),
        ("multi-session", lives, list(pairwise(ends))),
    ):
        xy, truth = track(own[-1].brain, own)
        if not np.isfinite(truth).all():
            return
        on = np.isfinite(xy[:, 0])
        mode = "rigid" if result.source.frame(0).velocity else "similarity"
        moved = align(xy[on], truth[on], mode).apply(xy)
        error = float(np.sqrt(np.mean(np.sum((moved - truth)[on] ** 2, axis=1))))
        rows.append((name, moved, truth, error, ranges))
    title = f"{plan.title}: tracks against the truth"
    save(plot_accuracy(rows, title), out / f"{stem}accuracy.png")


def _write(name: str, rows: list[dict[str, Any]], lives: list[Life], out: Path) -> dict[str, Any]:
    results = {
        "experiment": name,
        "rows": rows,
        "merges": [joint.report for life in lives for joint in life.joints],
    }
    text = json.dumps(results, indent=1).replace("NaN", "null") + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    return results


def _repeat(name: str, out: Path) -> dict[str, Any]:
    plan, out = PLANS[name], Path(out)
    result = run_plan(plan)
    draw(plan, result, out)
    return _write(name, _rows(plan, result), result.lives, out)


def virtual_tour(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map an elliptic gallery in two sessions (paper's Figs. 9-11)."""
    return _repeat("virtual-tour", out)


def lab_tour(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map a laboratory with visual odometry in two sessions that meet (paper's Figs. 13, 14)."""
    return _repeat("lab-tour", out)


def five_sessions(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map the blocks of a town in four sessions, and join them in a fifth (Figs. 15, 16)."""
    return _repeat("five-sessions", out)


def campus(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map a campus of more than 20 000 frames in three sessions (paper's Figs. 17, 18)."""
    return _repeat("campus", out)


def virtual_tour_no_shift(_data: Path | None, out: Path) -> dict[str, Any]:
    """Repeat the virtual tour without moving the pose cells (paper's Fig. 12).

    Besides with the paper's shift alone: the sessions' headings differ, so that the ways between
    the partial session's places run in other directions on the torus, and places are made twice.
    """
    plan, out = PLANS["virtual-tour"], Path(out)
    results = {cells: run_plan(plan, {"sessions": {"cells": cells}}) for cells in
               ("turn", "shift", "none")}  # fmt: skip
    names = {
        "turn": "shifted and turned",
        "shift": "only shifted, as the paper",
        "none": "not moved",
    }
    rows = _rows(plan, results["turn"], names["turn"])
    rows += [_rows(plan, results[cells], names[cells])[1] for cells in ("shift", "none")]
    for cells, stem in (("none", "not_moved_"), ("shift", "only_shifted_")):
        draw(
            plan._replace(title=f"Virtual tour, pose cells {names[cells]}"),
            results[cells],
            out,
            stem,
        )
    return _write("virtual-tour-no-shift", rows, results["none"].lives, out)


RECORDINGS = ("circuit_launch", "usi_track1")


def real_two_sessions(data: Path, out: Path) -> dict[str, Any]:
    """Cut two real drives into 2 and 5 sessions with cold starts; try to join what does not belong.

    Args:
        data: Folder that holds ``circuit_launch`` and ``usi_track1``.
        out: Where to write.
    """
    out, rows, lives = Path(out), [], []
    for name in RECORDINGS:
        for k in (2, 5):
            title = f"{name.replace('_', ' ')} in {k} sessions"
            source = str(Path(data) / name / "frames.tar")
            plan = Plan(title, source, equal_parts(k), preset="rc_car")
            result = run_plan(plan)
            rows += [{"recording": name, **row} for row in _rows(plan, result, f"{k} sessions")]
            lives += result.lives
            draw(plan, result, out, f"{name}_{k}_")
    rows = [row for i, row in enumerate(rows) if i % 4 != 2]  # a single session once
    return _write("real-two-sessions", [*rows, wrong_merges(data)], lives, out)


def wrong_merges(data: Path, n: int = 8, seed: int = 0) -> dict[str, Any]:
    """Try to join ``n`` cuts of one recording with ``n`` of the other, all with all.

    Returns:
        A row: tries, how many merged, and what the refusals said.
    """
    config = build_config(read_preset("rc_car"), "preset rc_car")
    rng, cut_lives = np.random.default_rng(seed), []
    for name in RECORDINGS:
        frames = list(open_source(Path(data) / name / "frames.tar", config.frame_rate_hz).frames())
        lengths = rng.integers(200, len(frames) // 2, n)
        starts = [int(rng.integers(0, len(frames) - length)) for length in lengths]
        cuts = zip(starts, lengths.tolist(), strict=True)
        cut_lives.append([live(frames[a : a + length], config).brain for a, length in cuts])
    found = [find_match(one, other) for one in cut_lives[0] for other in cut_lives[1]]
    refused = [each.reason for each in found if each.match is None]
    return {
        "recording": "one against the other",
        "map": "cuts that do not belong together",
        "tries": len(found),
        "merges": len(found) - len(refused),
        "most_places_that_agreed": max(each.groups[0] if each.groups else 0 for each in found),
        "reasons": sorted({reason.split(";")[0] for reason in refused}),
    }
