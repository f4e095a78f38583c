"""Readers for the files of a run: rows, plan, figures, and the pose of every frame."""

import csv
import json
import math
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import RunError, counted
from neuroslam.geometry import compose_poses, integrate_velocities
from neuroslam.limits import (
    MOST_CONFIG_BYTES,
    MOST_JSON_BYTES,
    fits,
    parse_json,
    parse_toml,
    read_bounded,
    too_much,
)
from neuroslam.mapping.tables import origin_key
from neuroslam.runs.files import (
    FRAME_COLUMNS,
    RUN_FILES,
    TRACE_COLUMNS,
    RunPlan,
    is_whole,
    missing_rows,
    refuse_many,
)
from neuroslam.runs.manifest import check_saved
from neuroslam.types import NO_EXPERIENCE, Pose

_FIGURES: dict[str, Any] = {
    "frames": int, "seconds": int | float, "cpu_seconds": int | float, "skipped": list,
    "merge_reports": list, "refused_merges": list,
}  # fmt: skip
"""Figures that every run has, and their types."""

_PLAN = TypeAdapter(RunPlan)


def read_trace(
    out: str | Path, rows: int | None = None, min_rows: int = 1
) -> dict[str, np.ndarray]:
    """Read ``trace.f64`` of a run: one array for each of ``TRACE_COLUMNS``.

    Args:
        out: Folder of the run.
        rows: Number of rows to read, without those after the last save of a killed run; ``None``:
            all.
        min_rows: Least number of rows expected.

    Raises:
        RunError: If it is missing or has fewer rows.
    """
    path = Path(out) / "trace.f64"
    if not path.is_file():
        raise RunError(f"{path}: missing; expected the folder of a run")
    if not fits(needed := 4 * path.stat().st_size):
        raise RunError(f"{path}: {too_much(needed)}")
    values, width = np.fromfile(path, dtype="<f8"), len(TRACE_COLUMNS)
    there = len(values) // width
    if not path.stat().st_size and (rows or min_rows):
        raise RunError(f"{path}: holds no frames; a run merged from brain files has none")
    if there < (rows or min_rows):
        raise RunError(
            f"{path}: damaged, {counted(there, 'whole row')}; expected {rows or min_rows}"
        )
    check_saved(path)
    table = values[: (rows or there) * width].reshape(-1, width)
    return {name: table[:, i] for i, name in enumerate(TRACE_COLUMNS)}


def read_planned(out: str | Path) -> list[int]:
    """Read the experiences of ``plan.csv``, which ``plan`` wrote; none if there is no such file.

    Raises:
        RunError: If it is damaged.
    """
    path = Path(out) / "plan.csv"
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as opened:
            return [int(row["experience"]) for row in csv.DictReader(opened)]
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        raise RunError(
            f"{path}: damaged; write it again with neuroslam plan, or delete it"
        ) from None


def experiences_of(
    brain: NavigationBrain, trace: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the experience of every frame on the final map.

    Returns:
        Present id of the experience, ``(frames,)``, -1 where it is not on this map or there was
        none yet; and the pose that the experience was created with, in the frame of the one that
        it is part of now, ``(frames, 3)``.
    """
    origins = brain.map.origins()
    keys = origin_key(origins._asdict())
    own = origin_key({name: trace[name].astype(np.int64) for name in ("session", "number")})
    experience, part_of = np.full(len(own), NO_EXPERIENCE), np.zeros((len(own), 3))
    if len(keys):
        order = np.argsort(keys)
        found = order[np.searchsorted(keys, own, sorter=order).clip(max=len(keys) - 1)]
        known = (keys[found] == own) & (trace["number"] >= 0)
        experience[known] = origins.experience[found[known]]
        columns = origins.ahead_m, origins.left_m, origins.turn_rad
        part_of[known] = np.column_stack(columns)[found[known]]
    return experience, part_of


def trajectory(brain: NavigationBrain, trace: dict[str, np.ndarray]) -> np.ndarray:
    """Return the pose of every frame on the final map: its experience composed with its offset.

    The trace can be that of any session of the map.

    Returns:
        x, y in metres and heading in radians, shape ``(frames, 3)``; NaN where the experience of
        the frame is on a stored map that was not joined.
    """
    experience, part_of = experiences_of(brain, trace)
    on_map = experience >= 0
    at = np.full((len(experience), 3), np.nan)
    at[on_map] = brain.map.poses[experience[on_map]]
    moved = part_of.any(axis=1)
    at[moved] = compose_poses(at[moved], part_of[moved])
    if not brain.sessions.merges:
        ours = np.isin(trace["session"], [session.id for session in brain.sessions.sessions])
        at[ours & (trace["number"] < 0)] = 0.0  # before the first experience
    return compose_poses(at, np.column_stack([trace[n] for n in ("dx_m", "dy_m", "dtheta_rad")]))


def odometry_track(config: BrainConfig, trace: dict[str, np.ndarray]) -> np.ndarray:
    """Integrate the odometry of a run from the start of the map; shape ``(frames, 3)``."""
    start = Pose(0.0, 0.0, math.radians(config.map.initial_heading_deg))
    return integrate_velocities(trace["v_m_s"], trace["w_rad_s"], trace["dt_s"], start)


def moved_onto(odometry: np.ndarray, track: np.ndarray) -> np.ndarray:
    r"""Turn and move dead reckoning so that it begins where the track does, for a picture of both.

    The rotation is the one that brings the two nearest to each other about their common start,

    .. math:: \alpha = \arg\min_\alpha \sum_i \lVert R_\alpha (o_i - o_0) - (p_i - p_0) \rVert^2
        = \operatorname{atan2}\Big(\sum_i o'_i \times p'_i, \sum_i o'_i \cdot p'_i\Big)

    Args:
        odometry: Poses by dead reckoning, ``(frames, 3)``: m, m, rad.
        track: Poses on the map, of equal shape; NaN where a frame is on no joined map.

    Returns:
        Poses of ``odometry`` in the coordinates of the map; as they are if no frame is on it.

    Example:
        >>> line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> up = np.array([[5.0, 5.0, 0.0], [5.0, 7.0, 0.0]])
        >>> moved_onto(line, up).round(3)[:, :2].tolist()
        [[5.0, 5.0], [5.0, 6.0]]
    """
    known = np.flatnonzero(np.isfinite(track[:, 0]))
    if not len(known):
        return odometry
    first = known[0]
    own = odometry[:, :2] - odometry[first, :2]
    there = track[known, :2] - track[first, :2]
    dot = float((own[known] * there).sum())
    cross = float((own[known, 0] * there[:, 1] - own[known, 1] * there[:, 0]).sum())
    turn = math.atan2(cross, dot) if dot or cross else 0.0
    turned = own @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.column_stack([turned + track[first, :2], odometry[:, 2] + turn])


def frame_rows(out: str | Path, rows: int | None = None) -> list[str]:
    """Read the rows of ``frames.csv`` as text, up to the first incomplete row.

    Args:
        out: Folder of the run.
        rows: Most rows to read; ``None``: all.

    Raises:
        RunError: If it is missing or not text.
    """
    path = Path(out) / "frames.csv"
    try:
        with path.open(encoding="utf-8") as file:
            return list(takewhile(is_whole, islice(file, 1, None if rows is None else rows + 1)))
    except FileNotFoundError:
        raise RunError(f"{path}: missing; expected the folder of a run") from None
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: damaged ({error})") from None


def _all_rows(out: str | Path, rows: int | None) -> list[str]:
    lines = frame_rows(out, rows)
    if rows is not None and len(lines) < rows:
        raise RunError(missing_rows(out, len(lines), rows))
    check_saved(Path(out) / "frames.csv")
    return lines


def read_frames(out: str | Path, rows: int | None = None) -> dict[str, np.ndarray]:
    """Read the columns of ``frames.csv`` that hold numbers, also those of populations, as arrays.

    Args:
        out: Folder of the run.
        rows: Number of rows, as for :func:`read_trace`; ``None``: all complete rows.

    Raises:
        RunError: If it is missing or damaged.
    """
    names = _columns(out)
    numbers = [i for i, name in enumerate(names) if name != "action"]
    lines = _all_rows(out, rows)
    if not lines:
        return {names[i]: np.zeros(0) for i in numbers}
    try:
        table = np.loadtxt(lines, delimiter=",", usecols=numbers, ndmin=2)
    except ValueError as error:
        raise RunError(f"{Path(out) / 'frames.csv'}: damaged ({error})") from None
    return {names[i]: table[:, column] for column, i in enumerate(numbers)}


def _columns(out: str | Path) -> list[str]:
    """Return the names of the columns of ``frames.csv``; populations add some after the first."""
    try:
        with (Path(out) / "frames.csv").open(encoding="utf-8") as file:
            header = file.readline().rstrip("\n")
    except (OSError, ValueError):
        header = ""
    return (header if header.startswith(f"{FRAME_COLUMNS},") else FRAME_COLUMNS).split(",")


def read_actions(out: str | Path, rows: int | None = None) -> np.ndarray:
    """Read the column ``action`` of ``frames.csv``, as text ``(frames,)``.

    Args:
        out: Folder of the run.
        rows: As for :func:`read_frames`.

    Raises:
        RunError: As :func:`read_frames`.
    """
    column = FRAME_COLUMNS.split(",").index("action")
    return np.array([line.split(",")[column] for line in _all_rows(out, rows)], dtype=np.str_)


def read_plan(out: str | Path) -> RunPlan:
    """Read source and range of a run from its ``config.toml``.

    Raises:
        RunError: If the folder holds no run.
    """
    refuse_many(Path(out))  # settles it too
    path = Path(out) / "config.toml"
    if (Path(out) / "frames.csv").exists() and not any(
        (Path(out) / name).exists() for name in RUN_FILES[4:]
    ):
        raise RunError(
            f"{out}: the run was cut off before its first save; run again with --overwrite"
        )
    try:
        table = parse_toml(read_bounded(path, MOST_CONFIG_BYTES).decode())["run"]
        plan = _PLAN.validate_json(json.dumps(table), strict=True)
    except OSError:
        if (Path(out) / "brain.safetensors").exists():
            raise RunError(
                f"{path}: missing; it holds the source of the run. Restore it, or use "
                f"{Path(out) / 'brain.safetensors'} alone"
            ) from None
        raise RunError(f"{out}: not a run; expected a folder with config.toml") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError):  # not TOML, text ...
        raise RunError(f"{path}: has no valid [run] table; expected the config of a run") from None
    check_saved(path)
    return plan


def read_metrics(out: str | Path) -> dict[str, Any]:
    """Read the figures of a run.

    Raises:
        RunError: If they are missing or damaged.
    """
    path = Path(out) / "metrics.json"
    try:
        metrics: dict[str, Any] = parse_json(read_bounded(path, MOST_JSON_BYTES))
        for name, kind in _FIGURES.items():
            if not isinstance(metrics[name], kind):
                raise TypeError(f"{name} is {metrics[name]!r}")
    except FileNotFoundError:
        raise RunError(f"{path}: missing; expected the folder of a run") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RunError(f"{path}: damaged ({error})") from None
    check_saved(path)
    return metrics


def length_unit(path: str | Path) -> str:
    """Return the unit of lengths on the map of a run: ``arbitrary unit`` for one camera alone.

    Args:
        path: Folder of a run, or its brain file; elsewhere the unit is taken to be ``m``.
    """
    path = Path(path)
    try:
        metrics = read_metrics(path if path.is_dir() else path.parent)
    except RunError:
        return "m"
    return unit_of(metrics.get("measured_motion"))


def unit_of(measured: bool | None) -> str:
    """Return the unit of lengths of a run with or without measured motion; ``None``: unknown."""
    return "arbitrary unit" if measured is False else "m"


def true_poses(trace: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the true pose of every frame, ``(frames, 3)``; ``None`` if none is known.

    A frame without a true position is a row of NaN; an unknown heading alone is NaN.
    """
    truth = np.column_stack([trace[f"truth_{name}"] for name in ("x_m", "y_m", "theta_rad")])
    known = np.isfinite(truth[:, :2]).all(axis=1)
    return truth if known.any() else None


def track_file(out: Path) -> Path:
    """Return the trajectory file of a run, which is written at its end.

    Raises:
        RunError: If the run was killed before its end.
    """
    refuse_many(out)
    track = out / "trajectory.tum"
    check_saved(track)
    if (
        not track.exists()
        and (out / "brain.safetensors").exists()
        and (out / "frames.csv").exists()
    ):
        raise RunError(f"{out}: the run was cut off; continue it with: neuroslam resume {out}")
    return track
