"""The experiments of the multisession paper, each compared with a single session.

Menezes et al., "A Multisession SLAM Approach for RatSLAM", J. Intell. Robot. Syst. 108:61, 2023.
Rendered worlds with similar routes replace recordings that are not public.
"""

import json
import math
from collections.abc import Callable
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.evaluation.icp import map_rmse
from neuroslam.evaluation.trajectory import AlignmentMode, align
from neuroslam.experiments.session_runs import (
    SessionRun,
    bindings,
    measure,
    run_session,
    stages,
    track,
)
from neuroslam.figures.sessions import plot_accuracy, plot_bindings, plot_overlay, plot_stages
from neuroslam.figures.style import save
from neuroslam.merging.match import find_match
from neuroslam.sensors import open_source
from neuroslam.sensors.source import IndexedSource
from neuroslam.state.files import write_atomically
from neuroslam.worlds.world import WorldSource

Cut = tuple[int, int]
"""First frame of a session, and the frame after its last."""


class Plan(NamedTuple):
    """An experiment.

    Attributes:
        title: Title of the figures.
        source: Source of the single session.
        cuts: Function from the opened source to the sessions.
        config: Parameters that differ from the preset.
        paper_rmse: The paper's ICP RMSE, in its own map units; NaN without one.
        preset: Name of the preset; empty: the defaults.
    """

    title: str
    source: str
    cuts: Callable[[IndexedSource], list[Cut]]
    config: dict[str, Any] = {}  # noqa: RUF012
    paper_rmse: float = math.nan
    preset: str = ""


def equal_parts(k: int) -> Callable[[IndexedSource], list[Cut]]:
    """Cut a source into ``k`` sessions of equal length.

    Example:
        >>> from types import SimpleNamespace
        >>> equal_parts(2)(SimpleNamespace(n_frames=101))
        [(0, 50), (50, 101)]
    """
    return lambda source: [
        (source.n_frames * i // k, source.n_frames * (i + 1) // k) for i in range(k)
    ]


def _virtual_tour(_source: IndexedSource) -> list[Cut]:
    """Cut into three quarters of a lap of 400 frames, and almost three laps from a new place."""
    return [(0, 300), (320, 1520)]


def _lab_tour(source: IndexedSource) -> list[Cut]:
    """Cut into two laps of one rectangle, and from the far side of the other to the end."""
    laps = source.n_frames / 5.0
    return [(0, round(2.0 * laps)), (round(2.5 * laps), source.n_frames)]


def _town(source: IndexedSource) -> list[Cut]:
    """Cut into two laps around each block, and the outer lap."""
    return _cut_at_passes(source, (0.0, 0.0), 4.0, (3, 5, 7, 9))


def _campus(source: IndexedSource) -> list[Cut]:
    """Cut into laps of the court, laps of the park, and laps of everything."""
    truth = _truths(source)
    in_park = np.flatnonzero(truth[:, 0] > 10.0)
    first = int(in_park[0])
    court = np.flatnonzero((truth[:, 0] < -25.0) & (np.arange(len(truth)) > first))
    return [(0, first), (first, int(court[0])), (int(court[0]), source.n_frames)]


def _truths(source: IndexedSource) -> np.ndarray:
    assert isinstance(source, WorldSource)  # by the plan
    return source.truths()


def _cut_at_passes(
    source: IndexedSource, at_m: tuple[float, float], radius_m: float, passes: tuple[int, ...]
) -> list[Cut]:
    """Cut a drive at some of its passes of a position."""
    apart = np.hypot(*(_truths(source)[:, :2] - at_m).T)
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
    """Runs of an experiment: that of the single session, and those of the sessions."""

    single: SessionRun
    runs: list[SessionRun]
    cuts: list[Cut]
    source: IndexedSource


def run_plan(plan: Plan, overrides: dict[str, Any] | None = None) -> Result:
    """Run all frames in one session, and in several, each with the map of those before."""
    values = merge_values(read_preset(plan.preset) if plan.preset else {}, plan.config)
    config = build_config(merge_values(values, overrides or {}), plan.title)
    source = open_source(plan.source, config.frame_rate_hz, config.view.grey)
    if not isinstance(source, IndexedSource):
        raise RunError(f"{plan.source}: is read in order only; expected frames by number")
    single = run_session(source.frames(), config, name=plan.source)
    cuts = plan.cuts(source)
    return Result(single, _sessions(plan, config, source, cuts), cuts, source)


def _sessions(
    plan: Plan, config: BrainConfig, source: IndexedSource, cuts: list[Cut]
) -> list[SessionRun]:
    runs: list[SessionRun] = []
    for first, stop in cuts:
        stored = runs[-1].brain if runs else None
        runs.append(run_session(source.frames(first, stop), config, stored, plan.source))
    return runs


def _rows(plan: Plan, result: Result, name: str = "multi-session") -> list[dict[str, Any]]:
    everything = np.arange(len(result.single.trace["session"]))
    rows = [measure("single session", [result.single], None, everything)]
    rows.append(measure(name, result.runs, result.single, _frames_of(result.cuts)))
    rows[-1]["paper_icp_rmse_in_its_units"] = plan.paper_rmse
    return rows


def _frames_of(cuts: list[Cut]) -> np.ndarray:
    return np.array(list(chain.from_iterable(range(*cut) for cut in cuts)))


def draw(plan: Plan, result: Result, out: Path, stem: str = "") -> None:
    """Write the figures: stages, bindings, overlay of both maps, and tracks with the truth."""
    single, runs = result.single, result.runs
    save(plot_stages(stages(single, runs), plan.title), out / f"{stem}stages.png")
    if any(run.merge_snapshots for run in runs):
        cells = single.brain.config.pose_cells
        torus = (cells.n_xy, cells.n_xy, cells.n_theta)
        save(plot_bindings(bindings(single, runs), torus, plan.title), out / f"{stem}bindings.png")
    here, there = runs[-1].brain.map, single.brain.map
    found = map_rmse(here.poses[:, :2], there.poses[:, :2], "rigid")
    diagonal = float(np.linalg.norm(np.ptp(there.poses[:, :2], axis=0)))
    overlay = plot_overlay(
        there.poses[:, :2],
        found.alignment.apply(here.poses[:, :2]),
        found.rmse,
        found.rmse / diagonal,
        f"{plan.title}: merged map over that of the single session",
        np.column_stack(there.links[:2]),
        np.column_stack(here.links[:2]),
    )
    save(overlay, out / f"{stem}overlay.png")
    rows = []
    n_single = len(single.trace["session"])
    ends = np.cumsum([0, *(len(run.trace["session"]) for run in runs)]).tolist()
    for name, own, ranges in (
        ("single session", [single], [(0, n_single)]),
        ("multi-session", runs, list(pairwise(ends))),
    ):
        xy, truth = track(own[-1].brain, own)
        if not np.isfinite(truth).all():
            return
        on = np.isfinite(xy[:, 0])
        mode: AlignmentMode = "rigid" if result.source.frame(0).velocity else "similarity"
        moved = align(xy[on], truth[on], mode).apply(xy)
        error = float(np.sqrt(np.mean(np.sum((moved - truth)[on] ** 2, axis=1))))
        rows.append((name, moved, truth, error, ranges))
    title = f"{plan.title}: tracks and truth"
    save(plot_accuracy(rows, title), out / f"{stem}accuracy.png")


def _write(
    name: str, rows: list[dict[str, Any]], runs: list[SessionRun], out: Path
) -> dict[str, Any]:
    results = {
        "experiment": name,
        "rows": rows,
        "merges": [merge.report for run in runs for merge in run.merge_snapshots],
    }
    text = json.dumps(results, indent=1).replace("NaN", "null") + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    return results


def _repeat(name: str, out: Path) -> dict[str, Any]:
    plan, out = PLANS[name], Path(out)
    result = run_plan(plan)
    draw(plan, result, out)
    return _write(name, _rows(plan, result), result.runs, out)


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
    """Map a campus of more than 20 000 frames in three sessions (paper's Figs. 17, 18).

    The same frames again under the rule of the paper, preset ``multisession_2023``: the first view
    match decides, pose cells are only shifted, and no merge is refused.
    """
    plan, out = PLANS["campus"], Path(out)
    result = run_plan(plan)
    by_rule = run_plan(plan, read_preset("multisession_2023"))
    rows = _rows(plan, result, "multi-session")
    rows.append(_rows(plan, by_rule, "multi-session, rule of the paper")[1])
    draw(plan, result, out)
    draw(plan._replace(title=f"{plan.title}, rule of the paper"), by_rule, out, "rule_of_paper_")
    return _write("campus", rows, [*result.runs, *by_rule.runs], out)


def virtual_tour_no_shift(_data: Path | None, out: Path) -> dict[str, Any]:
    """Repeat the virtual tour without moving the pose cells (paper's Fig. 12).

    A third run has only the paper's shift. The headings of the sessions differ, so the links of the
    partial session have other directions on the torus, and some experiences are created twice.
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
    return _write("virtual-tour-no-shift", rows, results["none"].runs, out)


RECORDINGS = ("circuit_launch", "usi_track1")


def real_two_sessions(data: Path, out: Path) -> dict[str, Any]:
    """Cut two real drives into 2 and 5 sessions with cold starts; try to merge unrelated maps.

    Args:
        data: Folder that holds ``circuit_launch`` and ``usi_track1``.
        out: Folder to write.
    """
    out = Path(out)
    rows: list[dict[str, Any]] = []
    runs: list[SessionRun] = []
    for name in RECORDINGS:
        for k in (2, 5):
            title = f"{name.replace('_', ' ')} in {k} sessions"
            source = str(Path(data) / name / "frames.tar")
            plan = Plan(title, source, equal_parts(k), preset="rc_car")
            result = run_plan(plan)
            rows += [{"recording": name, **row} for row in _rows(plan, result, f"{k} sessions")]
            runs += result.runs
            draw(plan, result, out, f"{name}_{k}_")
    rows = [row for i, row in enumerate(rows) if i % 4 != 2]  # a single session once
    return _write("real-two-sessions", [*rows, wrong_merges(data)], runs, out)


def wrong_merges(data: Path, n: int = 8, seed: int = 0) -> dict[str, Any]:
    """Try to merge ``n`` cuts of one recording with ``n`` of the other, all pairs.

    Returns:
        A row: number of tries, number of merges, and the reasons of refusals.
    """
    config = build_config(read_preset("rc_car"), "preset rc_car")
    rng, brains = np.random.default_rng(seed), []
    for name in RECORDINGS:
        frames = list(open_source(Path(data) / name / "frames.tar", config.frame_rate_hz).frames())
        lengths = rng.integers(200, len(frames) // 2, n)
        starts = [int(rng.integers(0, len(frames) - length)) for length in lengths]
        cuts = zip(starts, lengths.tolist(), strict=True)
        brains.append([run_session(frames[a : a + length], config).brain for a, length in cuts])
    found = [find_match(one, other) for one in brains[0] for other in brains[1]]
    refused = [each.reason for each in found if each.match is None]
    return {
        "recording": "one against the other",
        "map": "cuts that do not belong together",
        "tries": len(found),
        "merges": len(found) - len(refused),
        "most_places_that_agreed": max(each.groups[0] if each.groups else 0 for each in found),
        "reasons": sorted({reason.split(";")[0] for reason in refused}),
    }
