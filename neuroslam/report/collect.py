"""Content of a report page: facts as plain values, tables as arrays."""

import base64
import inspect
import math
import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.config import BrainConfig, build_config, preset_names, read_preset
from neuroslam.errors import MapError, counted
from neuroslam.evaluation.trajectory import align
from neuroslam.figures.style import readable_source, render
from neuroslam.mapping.tables import closes_loop
from neuroslam.merging.report import MergeReport
from neuroslam.report.decisions import cells_apart
from neuroslam.report.reading import Curve, FinishedRun
from neuroslam.report.rows import config_rows, metric_rows
from neuroslam.runs.cells import activity_of, draw_cells
from neuroslam.runs.reading import (
    experiences_of,
    moved_onto,
    odometry_track,
    trajectory,
    true_poses,
    unit_of,
)
from neuroslam.spiking.ask import contents
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.state.answers import counts_of, pictures_of

_DRAWN = ("pose", "place", "semantic")  # kinds that the page draws by scripts of its own
ACTIONS = ("none", "create", "link", "set")
MOST_ROWS = 100_000
"""Frames on a page, about: of longer runs every k-th, and those that changed the map."""

_TEMPLATE_BYTES = 4_000_000


class Facts(NamedTuple):
    """The content of a page, without pictures of frames.

    Attributes:
        about: Plain values for JSON: names, counts, reports, config.
        arrays: ``row_...`` for each frame, ``place_...`` for each experience, ``link_...``,
            ``cell_...`` and ``wall_...`` likewise, ``plan_place`` the experiences of a planned
            path; lengths in m, angles in rad, times in s.
    """

    about: dict[str, Any]
    arrays: dict[str, np.ndarray]


def collect(run: FinishedRun) -> Facts:
    """Collect the content of a page from a run."""
    rows = chosen_rows(run.actions)
    arrays = _rows(run, rows) | _map(run) | _cells(run.brain)
    notes = []
    planned, note = planned_path(run)
    if planned:
        arrays["plan_place"] = np.array(planned, np.int32)
    if note:
        notes.append(note)
    if len(rows) < len(run.actions):
        notes.append(
            f"{len(rows):,} of {len(run.actions):,} frames are on this page: every "
            f"{_stride(len(run.actions))}th, and all that changed the map."
        )
    if not len(run.actions):
        notes.append("This map was merged from two brain files: it has experiences, but no frames.")
    for name, curve in run.curves.items():
        key = name.rpartition("/")[2]
        arrays |= {
            f"{key}_row": np.searchsorted(rows, curve.rows).clip(max=len(rows) - 1),
            f"{key}_value": curve.values,
        }
    base_name, base = _base(run)
    about = {
        "name": readable_source(run.plan.name),
        "unit": _unit(run),
        "cells": list(run.brain.config.cells),
        "torus": [run.brain.config.pose_cells.n_xy, run.brain.config.pose_cells.n_theta],
        "threshold": run.brain.config.view.threshold,
        "create_threshold": run.brain.config.pose_cells.create_threshold_cells,
        "features": run.brain.config.view.features,
        "orientations": run.brain.config.view.orientations,
        "actions": ACTIONS,
        "summary": _summary(run),
        "sessions": _sessions(run),
        "merges": [_merge(report, run) for report in run.metrics["merge_reports"]],
        "refused": [_merge(report, run) for report in run.metrics["refused_merges"]],
        "not_joined": run.metrics.get("not_joined", []),
        "skipped": run.metrics.get("skipped", []),
        "metrics": metric_rows(run.metrics, _unit(run)),
        "config": config_rows(run.brain.config, base),
        "base": base_name,
        "range": {"start": run.plan.start, "stop": run.plan.stop,
                  "on_bad_frame": run.plan.on_bad_frame},
        "truth_scale": truth_on_map(trajectory(run.brain, run.trace), true_poses(run.trace))[1],
        "lost": [_within(rows, span) for span in lost_spans(run)],
        "populations": populations(run.brain),
        "activity": activity(run),
        "notes": notes,
        **_words(run.brain),
    }  # fmt: skip
    lost_s = run.metrics.get("lost_s", 0.0)
    if lost_s and not about["lost"]:
        notes.append(
            f"The robot was lost for {lost_s:.1f} s in all; the times are only in events/, "
            "which this run does not have."
        )
    return Facts(about, arrays)


def planned_path(run: FinishedRun) -> tuple[list[int], str]:
    """Return the experiences of the path in ``plan.csv``, and a line about it; empty for none.

    A path whose links are not on the map was planned on an earlier one, and is left out.
    """
    path, links, n = run.planned, run.brain.map.links, run.brain.map.n
    if not path:
        return [], ""
    there = set(zip(links.source.tolist(), links.target.tolist(), strict=True))
    steps = list(pairwise(path))
    stale = min(path) < 0 or max(path) >= n
    if stale or any(step not in there and step[::-1] not in there for step in steps):
        return [], (
            "The planned path in plan.csv is of another map, and is not shown; "
            "run neuroslam plan again."
        )
    xy = run.brain.map.poses[path, :2]
    length_m = float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())
    return path, (
        f"Planned path: from experience {path[0]} to {path[-1]}, {counted(len(steps), 'link')}, "
        f"{length_m:.1f} {_unit(run)}."
    )


def chosen_rows(actions: np.ndarray) -> np.ndarray:
    """Choose the rows of the frames on a page: all, or about :data:`MOST_ROWS` of a longer run.

    Example:
        >>> chosen_rows(np.array(["create", "none", "none"])).tolist()
        [0, 1, 2]
    """
    n = len(actions)
    if n <= MOST_ROWS:
        return np.arange(n)
    some = (np.arange(0, n, _stride(n)), np.flatnonzero(actions != "none"), np.array([n - 1]))
    return np.unique(np.concatenate(some))


def _stride(n: int) -> int:
    return math.ceil(n / MOST_ROWS)


def _rows(run: FinishedRun, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of all frames; experiences and poses are those of the final map."""
    frames, trace, brain = run.frames, run.trace, run.brain
    place = experiences_of(brain, trace)[0]
    track = trajectory(brain, trace)
    odometry = moved_onto(odometry_track(brain.config, trace), track)
    truth = truth_on_map(track, true_poses(trace))[0]
    whole = {
        "frame": frames["frame"].astype(np.int32),
        "time_s": frames["time_s"],
        "place": place.astype(np.int32),
        "action": np.array([ACTIONS.index(name) for name in run.actions.tolist()], np.uint8),
        "x_m": track[:, 0],
        "y_m": track[:, 1],
        "theta_rad": track[:, 2],
        "odometry_x_m": odometry[:, 0],
        "odometry_y_m": odometry[:, 1],
        **({} if truth is None else {"truth_x_m": truth[:, 0], "truth_y_m": truth[:, 1]}),
    }
    for name in ("v_m_s", "w_rad_s", "match_error", "pose_x", "pose_y", "pose_theta"):
        whole[name] = frames[name]
    for name in ("template", "n_templates", "n_experiences", "n_links"):
        whole[name] = frames[name].astype(np.int32)
    apart = cells_apart(run)
    if apart is not None:
        whole["cells_apart"] = apart
    return {f"row_{name}": column[rows] for name, column in whole.items()}


def truth_on_map(
    track: np.ndarray, truth: np.ndarray | None
) -> tuple[np.ndarray | None, float | None]:
    """Align the true track to the map by a similarity transform, as ``map.png`` does.

    Returns:
        Positions ``(frames, 2)`` in the coordinates of the map, and metres of the truth per metre
        of the map; ``None`` without truth, or if the track fixes no alignment.
    """
    if truth is None:
        return None, None
    on_map = np.isfinite(track[:, 0]) & np.isfinite(truth[:, 0])
    if not on_map.any():
        return None, None
    try:
        alignment = align(track[on_map, :2], truth[on_map, :2], "similarity")
    except MapError:  # the robot stood still
        return None, None
    return alignment.undo(truth[:, :2]), alignment.scale


def _map(run: FinishedRun) -> dict[str, np.ndarray]:
    brain = run.brain
    table = {name: brain.map.experiences[name].numpy() for name in brain.map.experiences.columns}
    links, known = brain.map.links, {s.id: i for i, s in enumerate(brain.sessions.sessions)}
    poses = brain.map.poses
    return {
        "place_x_m": poses[:, 0],
        "place_y_m": poses[:, 1],
        "place_theta_rad": poses[:, 2],
        "place_cell": table["cell"],
        "place_template": table["template"].astype(np.int32),
        "place_first_frame": table["first_frame"].astype(np.int32),
        "place_session": np.array([known.get(s, 0) for s in table["session"].tolist()], np.int32),
        "link_from": links.source.astype(np.int32),
        "link_to": links.target.astype(np.int32),
        "link_distance_m": links.distance_m,
        "link_facing_rad": links.facing_rad,
        "link_duration_s": links.duration_s,
        "link_off_m": brain.map.residuals_m,
        "link_loop": closes_loop(links.source, links.target).astype(np.uint8),
        "templates": template_pictures(brain),
    }


def template_pictures(brain: NavigationBrain) -> np.ndarray:
    """Return the templates as grey pictures, ``uint8``, ``(n, h, w)``; reduced if many.

    Templates of gradients are maps of their orientations, one below the other.
    """
    view = brain.config.view
    maps = max(view.orientations, 1)
    height, width = view.template_height // maps, view.template_width
    if not brain.view.n:
        return np.zeros((0, maps * height, width), np.uint8)
    pictures = np.stack([brain.view.template_image(i) for i in range(brain.view.n)])
    shrink = math.sqrt(pictures.nbytes / _TEMPLATE_BYTES)
    if shrink <= 1.0:
        return pictures
    size = (max(1, int(width / shrink)), max(1, int(height / shrink)))
    layers = pictures.reshape(-1, height, width)
    reduced = [cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in layers]
    return np.stack(reduced).reshape(len(pictures), -1, size[0])


def _cells(brain: NavigationBrain) -> dict[str, np.ndarray]:
    """Return the activity of the cells at the end of the run, place cells, and landmarks."""
    arrays: dict[str, np.ndarray] = {}
    for kind, population in brain.populations.items():
        if kind in _ARRAYS:
            arrays |= _ARRAYS[kind](population)
    if (spots := brain.landmarks_m) is not None:
        arrays |= {"landmark_x_m": spots[:, 0], "landmark_y_m": spots[:, 1]}
    return arrays


def _words(brain: NavigationBrain) -> dict[str, Any]:
    """Return names and words of landmarks, walls and regions, if the brain has words."""
    cells = brain.populations.get("semantic")
    if not isinstance(cells, SemanticCells) or not cells.words.entries:
        return {}
    return {"words": [one.to_dict() for one in contents(cells).found]}


def _pose_cells(cells: PoseCellNetwork) -> dict[str, np.ndarray]:
    activity = cells.activity.numpy(force=True)
    return {"activity_xy": activity.sum(axis=0), "activity_theta_x": activity.sum(axis=1)}


def _navigation_cells(cells: NavigationCells) -> dict[str, np.ndarray]:
    centres, links = (part.numpy(force=True) for part in cells.place.graph())
    n = len(centres)
    wall = cells.walls.remembered()[0]
    x, y, bearing, distance = (column.numpy(force=True) for column in wall[:4])
    return {
        "cell_x_m": centres[:, 0],
        "cell_y_m": centres[:, 1],
        "cell_visits": cells.place.visits[0, :n].numpy(force=True).astype(np.int32),
        "cell_time_s": cells.place.time_s[0, :n].numpy(force=True),
        "cell_links": links.astype(np.int32),
        "wall_x_m": x + distance * np.cos(bearing),
        "wall_y_m": y + distance * np.sin(bearing),
        "wall_bearing_rad": bearing,
    }


_ARRAYS: dict[str, Callable[[Any], dict[str, np.ndarray]]] = {
    "pose": _pose_cells,
    "place": _navigation_cells,
}
"""Kind of a population -> the arrays that the page draws of it."""


def populations(brain: NavigationBrain) -> list[dict[str, Any]]:
    """Tell what each population has learnt, and what it looks like at the end of the run.

    Pictures of populations that the page draws itself are left out; one that has no other and
    counts nothing is left out altogether.
    """
    cards = []
    for kind, population in brain.populations.items():
        drawn = {} if kind in _DRAWN else pictures_of(population)
        card = {
            "kind": kind.replace("_", " "),
            "what": _plain((inspect.getdoc(type(population)) or "").partition("\n")[0]),
            "counts": metric_rows(counts_of(population)),
            "pictures": [
                {"tag": tag, "layers": [_png(layer) for layer in layers]}
                for tag, picture in drawn.items()
                for layers in (picture if isinstance(picture, tuple) else (picture,),)
            ],
        }
        if card["counts"] or card["pictures"]:
            cards.append(card)
    return cards


def activity(run: FinishedRun) -> dict[str, Any]:
    """Draw the cells of a run as ``neuroslam plot`` does: a figure for each kind, and a raster."""
    log, note = activity_of(run.out, run.brain, run.trace)
    figures = []
    for name, drawn in ({} if log is None else draw_cells(log, "", most=5)).items():
        kind = name.removeprefix("cells_").removesuffix(".png").replace("_", " ")
        title = "All cells over time" if name == "raster.png" else f"{kind.capitalize()} cells"
        pixels = render(drawn, dpi=90)
        bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
        data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, 101])[1]  # without loss
        height, width = pixels.shape[:2]
        picture = base64.b64encode(data.tobytes()).decode()
        figures.append({"title": title, "webp": picture, "width": width, "height": height})
    return {"note": note, "figures": figures}


def _plain(text: str) -> str:
    """Drop the roles and quotes of a docstring.

    Example:
        >>> _plain("See :func:`~a.b`, or ``c``.")
        'See b, or c.'
    """
    return re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text).replace("`", "")


def _png(picture: np.ndarray) -> dict[str, Any]:
    """Write activity as a picture, a pixel for each cell; rows point up."""
    if picture.ndim == 2:
        shown = np.nan_to_num(np.asarray(picture, dtype=np.float64), posinf=0.0, neginf=0.0)
        grey = (255.0 * shown / max(float(shown.max()), 1e-300)).round().clip(0, 255)
        pixels = cv2.applyColorMap(grey[::-1].astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    else:
        pixels = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    height, width = pixels.shape[:2]
    data = base64.b64encode(cv2.imencode(".png", pixels)[1].tobytes()).decode()
    return {"png": data, "width": width, "height": height}


def lost_spans(run: FinishedRun) -> list[tuple[int, int]]:
    """Find when the robot was lost, from ``cells/doubt_s`` in ``events/``.

    The robot is lost from when this time exceeds ``wall_memory.lost_after_s`` until it is 0, as
    :class:`~neuroslam.cells.familiarity.Familiarity` defines it.

    Returns:
        First and last row of ``frames.csv`` of each span, accurate to the recording interval.
    """
    doubt = run.curves.get("cells/doubt_s")
    if doubt is None:
        return []
    return spans_above(doubt, run.brain.config.wall_memory.lost_after_s)


def spans_above(curve: Curve, limit: float) -> list[tuple[int, int]]:
    """Find the rows from where a curve exceeds a limit to where it returns to 0.

    Example:
        >>> spans_above(Curve(np.arange(6), np.array([0.0, 1, 3, 1, 0, 1])), 2.0)
        [(2, 4)]
    """
    spans: list[tuple[int, int]] = []
    began: int | None = None
    for row, value in zip(curve.rows.tolist(), curve.values.tolist(), strict=True):
        if began is None and value > limit:
            began = row
        elif began is not None and value <= 0.0:
            spans.append((began, row))
            began = None
    return spans if began is None else [*spans, (began, int(curve.rows[-1]))]


def _within(rows: np.ndarray, span: tuple[int, int]) -> list[int]:
    """Convert a span of rows of ``frames.csv`` to rows of the page."""
    return [int(i) for i in np.searchsorted(rows, span).clip(max=len(rows) - 1)]


def _summary(run: FinishedRun) -> dict[str, Any]:
    brain, frames, links = run.brain, run.frames, run.brain.map.links
    times, trace = frames["time_s"], run.trace
    width, height = np.ptp(brain.map.poses[:, :2], axis=0) if brain.map.n else (0.0, 0.0)
    return {
        "frames": len(times),
        "seconds": float(times[-1] - times[0]) if len(times) else 0.0,
        "driven_m": float(np.abs(trace["v_m_s"] * trace["dt_s"]).sum()),
        "places": brain.map.n,
        "templates": brain.view.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(links.source, links.target).sum()),
        "width_m": float(width),
        "height_m": float(height),
        "current": brain.map.current,
        "robot": list(brain.map.pose),
        "interrupted": bool(run.metrics.get("interrupted")),
        "ate_m": run.metrics.get("ate_rmse_m"),
        "odometry_ate_m": run.metrics.get("odometry_ate_rmse_m"),
    }


def _base(run: FinishedRun) -> tuple[str, BrainConfig]:
    """Return the config that the run began with, and its name: its preset, or the defaults."""
    sessions = run.brain.sessions.sessions
    preset = sessions[-1].preset if sessions else ""
    if preset in preset_names():
        return f"the preset {preset}", build_config(read_preset(preset), f"preset {preset}")
    return "the defaults", BrainConfig()


def _sessions(run: FinishedRun) -> list[dict[str, Any]]:
    log = run.brain.sessions
    drive = log.this_drive() if log.sessions else set()
    return [
        {
            "name": session.name,
            "source": session.source,
            "preset": session.preset,
            "recorded": session.recorded,
            "frames": session.frames,
            "first_frame": session.first_frame,
            "began": session.began,
            "own": session.name in drive,
        }
        for session in log.sessions
    ]


def _unit(run: FinishedRun) -> str:
    return unit_of(run.metrics.get("measured_motion"))


def _merge(report: dict[str, Any], run: FinishedRun) -> dict[str, Any]:
    """Return the lines of a merge report, and the experience of the merge on the final map."""
    place = None
    if report["at_frame"] is None and report["merged"] and report == run.brain.sessions.merges[-1]:
        place = report["match"].get("loaded_experience")  # ids before a later merge are not valid
    return {
        "lines": MergeReport(**report).lines(_unit(run)),
        "frame": report["at_frame"],
        "place": place,
        "loaded": report["loaded_sessions"],
        "partial": report["partial_sessions"],
    }
