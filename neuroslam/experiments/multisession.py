"""The experiments of the multisession paper, each compared with a single session.

Menezes et al., "A Multisession SLAM Approach for RatSLAM", J. Intell. Robot. Syst. 108:61, 2023.
Rendered worlds with similar routes replace recordings that are not public. Each experiment runs
three brains on the same frames: ours, ours under the paper's rule of merging, and the paper's
Table 1 under its rule.
"""

import json
import math
from collections.abc import Callable, Mapping
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.evaluation.icp import map_rmse
from neuroslam.evaluation.trajectory import AlignmentMode, align
from neuroslam.experiments.session_runs import (
    SessionRecorder,
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
        table: Name of the preset with the experiment's column of the paper's Table 1; empty: none.
    """

    title: str
    source: str
    cuts: Callable[[IndexedSource], list[Cut]]
    config: dict[str, Any] = {}  # noqa: RUF012
    paper_rmse: float = math.nan
    preset: str = ""
    table: str = ""


OURS, BY_RULE, BY_TABLE = "ours", "our parameters, paper's rule", "Table 1, paper's rule"
"""Names of the three brains of an experiment."""


def variants(plan: Plan) -> dict[str, dict[str, Any]]:
    """Return the parameters of the brains of an experiment, by name.

    The paper's rule is the preset ``multisession_2023``: the first view match decides, pose cells
    are only shifted, and no merge is refused. Of Table 1, odometry and the size of a pose cell,
    which belong to the paper's cameras and robots, are replaced by those of the plan.

    Example:
        >>> variants(PLANS["campus"])["Table 1, paper's rule"]["view"]["threshold"]
        0.059
    """
    ours = merge_values(read_preset(plan.preset) if plan.preset else {}, plan.config)
    rule = read_preset("multisession_2023")
    named = {OURS: ours, BY_RULE: merge_values(ours, rule)}
    if plan.table:
        table = read_preset(plan.table)
        size = build_config(ours, plan.title).pose_cells.cell_size_m
        kept = {name: table[name] for name in ("view", "map")}
        cells = {**table["pose_cells"], "cell_size_m": size}
        odometry = {"odometry": ours["odometry"]} if "odometry" in ours else {}
        named[BY_TABLE] = merge_values({**kept, "pose_cells": cells, **odometry}, rule)
    return named


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


def _district(source: IndexedSource) -> list[Cut]:
    """Cut into laps of each corner block, and the outer lap, which passes all of them.

    Neither these laps nor the streets between them have a street in common, so no two of the first
    four sessions see the same place.
    """
    x, y = _truths(source)[:, :2].T
    inside = (np.abs(x) > 13.0) & (np.abs(y) > 10.0)
    corner = np.where(inside, 1 + (x > 0) + 2 * (y > 0), 0)
    begins = np.flatnonzero(np.diff(corner, prepend=0) * inside)[:4].tolist()
    ends = [first + int(np.flatnonzero(~inside[first:])[0]) for first in begins]
    return [*zip(begins, ends, strict=True), (ends[-1], source.n_frames)]


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


PLANS = {
    "virtual-tour": Plan(
        "Virtual tour",
        "world:ellipse?laps=3.8&width=256&height=64",
        _virtual_tour,
        paper_rmse=0.00773327,
        table="virtual_tour",
    ),
    "lab-tour": Plan(
        "Lab tour",
        "world:figure_eight?route=2&laps=1&width=256&height=128",
        _lab_tour,
        {"odometry": {"speed_scaling_m_s": 50.0}, "pose_cells": {"cell_size_m": 0.5}},
        paper_rmse=0.00883269,
        table="lab_tour",
    ),
    "five-sessions": Plan(
        "Five sessions in a district",
        "world:district?route=6&laps=1&noise=0.03",
        _district,
        {
            "view": {"threshold": 0.035, "template_height": 20},
            "pose_cells": {"cell_size_m": 2.0},
        },
        paper_rmse=0.0127,
        table="irat",
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
        table="new_college",
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
    ours = variants(plan)[OURS]
    return run_variants(plan, {OURS: merge_values(ours, overrides or {})})[OURS]


def run_variants(plan: Plan, named: Mapping[str, Mapping[str, Any]]) -> dict[str, Result]:
    """Run several brains on the same frames, each of which is made once.

    Args:
        plan: The experiment; the first brain's frame rate and colours hold for all.
        named: Name of a brain -> its parameters.
    """
    configs = {name: build_config(dict(values), plan.title) for name, values in named.items()}
    first = next(iter(configs.values()))
    source = open_source(plan.source, first.frame_rate_hz, first.view.grey)
    if not isinstance(source, IndexedSource):
        raise RunError(f"{plan.source}: is read in order only; expected frames by number")
    cuts = plan.cuts(source)
    singles = {name: SessionRecorder(config, name=plan.source) for name, config in configs.items()}
    parts: dict[str, list[SessionRecorder]] = {name: [] for name in configs}
    session = 0
    for i, frame in enumerate(source.frames()):
        if session < len(cuts) and i == cuts[session][1]:
            session += 1
        inside = session < len(cuts) and cuts[session][0] <= i < cuts[session][1]
        for name, config in configs.items():
            singles[name].step(frame)
            runs = parts[name]
            if inside and len(runs) == session:
                stored = runs[-1].brain if runs else None
                runs.append(SessionRecorder(config, stored, plan.source))
            if inside:
                runs[session].step(frame)
    return {
        name: Result(singles[name].result(), [one.result() for one in runs], cuts, source)
        for name, runs in parts.items()
    }


def _rows(
    plan: Plan, result: Result, name: str = "multi-session", alone: str = "single session"
) -> list[dict[str, Any]]:
    everything = np.arange(len(result.single.trace["session"]))
    rows = [measure(alone, [result.single], None, everything)]
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
    pairs = (("single session", [single]), ("multi-session", runs))
    rows = [_track_of(name, own, result.source) for name, own in pairs]
    if all(np.isfinite(row[2]).all() for row in rows):
        title = f"{plan.title}: tracks and truth"
        save(plot_accuracy(rows, title), out / f"{stem}accuracy.png")


def draw_variants(plan: Plan, results: Mapping[str, Result], out: Path) -> None:
    """Write the tracks of several brains beside each other, with the truth."""
    rows = [
        _track_of(f"{name[:1].upper()}{name[1:]}", result.runs, result.source)
        for name, result in results.items()
    ]
    title = f"{plan.title}: all brains on the same frames"
    save(plot_accuracy(rows, title), out / "against_the_paper.png")


def _track_of(
    name: str, runs: list[SessionRun], source: IndexedSource
) -> tuple[str, np.ndarray, np.ndarray, float, list[Cut]]:
    """Return a row of :func:`plot_accuracy`; frames on maps that were not joined have no track."""
    ends = np.cumsum([0, *(len(run.trace["session"]) for run in runs)]).tolist()
    xy, truth = track(runs[-1].brain, runs)
    on = np.isfinite(xy[:, 0]) & np.isfinite(truth[:, 0])
    mode: AlignmentMode = "rigid" if source.frame(0).velocity else "similarity"
    moved = align(xy[on], truth[on], mode).apply(xy) if on.any() else xy
    error = float(np.sqrt(np.mean(np.sum((moved - truth)[on] ** 2, axis=1))))
    return name, moved, truth, error, list(pairwise(ends))


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
    results = run_variants(plan, variants(plan))
    rows = _rows(plan, results[OURS])
    rows += _rows(plan, results[BY_RULE], f"multi-session: {BY_RULE}")[1:]
    rows += _rows(plan, results[BY_TABLE], f"multi-session: {BY_TABLE}", "single session: Table 1")
    draw(plan, results[OURS], out)
    draw_variants(plan, results, out)
    return _write(name, rows, [run for each in results.values() for run in each.runs], out)


def virtual_tour(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map an elliptic gallery in two sessions (paper's Figs. 9-11)."""
    return _repeat("virtual-tour", out)


def lab_tour(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map a laboratory with visual odometry in two sessions that meet (paper's Figs. 13, 14)."""
    return _repeat("lab-tour", out)


def five_sessions(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map four blocks that share no street, and join them in a fifth session (Figs. 15, 16)."""
    return _repeat("five-sessions", out)


def campus(_data: Path | None, out: Path) -> dict[str, Any]:
    """Map a campus of more than 20 000 frames in three sessions (paper's Figs. 17, 18)."""
    return _repeat("campus", out)


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
