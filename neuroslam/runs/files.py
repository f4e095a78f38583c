"""The files of a run: their names and columns are a contract, and nothing else writes them."""

import contextlib
import json
import math
import os
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, BinaryIO, Literal, TextIO

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import RunError, counted
from neuroslam.geometry import integrate_velocities, wrap_angles
from neuroslam.mapping.tables import Links, origin_key
from neuroslam.state.tables import write_atomically
from neuroslam.types import NO_EXPERIENCE, Frame, Pose, StepResult

FRAME_COLUMNS = (
    "frame,time_s,v_m_s,w_rad_s,template,match_error,relative_heading_rad,action,experience,"
    "x_m,y_m,theta_rad,pose_x,pose_y,pose_theta,n_templates,n_experiences,n_links"
)

# One row a frame in trace.f64: what trajectory.tum and map.png need and frames.csv lacks.
TRACE_COLUMNS = (
    "time_s", "session", "number", "dx_m", "dy_m", "dtheta_rad", "v_m_s", "w_rad_s", "dt_s",
    "truth_x_m", "truth_y_m", "truth_theta_rad",
)  # fmt: skip

RUN_FILES = (
    "frames.csv", "trace.f64", "config.toml", "metrics.json", "brain.safetensors",
    "experiences.csv", "links.csv", "trajectory.tum", "map.png",
)  # fmt: skip
LANDMARKS_FILE = "landmarks.csv"
"""Besides, where the brain has a semantic map."""

TEXT_COLUMNS = ("name",)
"""Columns of experiences.csv, links.csv and landmarks.csv that hold text; all others: numbers."""

_FIGURES = ("frames", "seconds", "cpu_seconds", "skipped", "merge_reports", "refused_merges")

TIMINGS = ("seconds", "cpu_seconds", "frames_per_s", "frames_per_cpu_s")
"""Figures of a run that differ from one time to the next; all others do not."""


OnBadFrame = Literal["skip", "stop"]


@dataclass(frozen=True)
class RunPlan:
    """What a run reads and how far: the ``[run]`` table of its ``config.toml``."""

    source: str
    start: int = 0
    stop: int | None = None
    on_bad_frame: OnBadFrame = "stop"
    maps: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The source as a reader knows it: the last two parts of its path."""
        return "/".join(Path(self.source).parts[-2:])

    @property
    def skips(self) -> bool:
        """Whether frames that cannot be used are left out."""
        return self.on_bad_frame == "skip"

    def to_toml(self) -> str:
        """Write the table."""
        lines = [f"source = {json.dumps(self.source, ensure_ascii=False)}", f"start = {self.start}"]
        if self.stop is not None:
            lines.append(f"stop = {self.stop}")
        lines.append(f'on_bad_frame = "{self.on_bad_frame}"')
        if self.maps:
            lines.append(f"maps = {json.dumps(self.maps, ensure_ascii=False)}")
        return "\n".join(["\n[run]", *lines]) + "\n"


def brain_file(path: str | Path) -> Path:
    """Return the brain file of a run folder, or the path itself if it is none."""
    path = Path(path)
    refuse_many(path)
    return path / "brain.safetensors" if path.is_dir() else path


def refuse_many(out: Path) -> None:
    """Say what a folder is that a command for runs made no run in.

    Raises:
        RunError: If it is that of a sweep, a fleet or a tuning.
    """
    if (out / "brain.safetensors").exists() or (out / "frames.csv").exists():
        return
    if (out / "sweep.json").exists():
        one = next((f", as {path.parent}" for path in sorted(out.glob("*/frames.csv"))), "")
        what = f"a sweep; its runs are folders in it{one}"
    elif (out / "fleet.json").exists():
        merged = (out / "merged").is_dir()
        what = f"a fleet; its {'map is in' if merged else 'maps are in'} {out}/"
        what += "merged" if merged else "sessions"
    elif (out / "tune.json").exists():
        what = f"a tuning; use it as --config {out}/config.toml"
    else:
        return
    raise RunError(f"{out}: is {what}")


def track_file(out: Path) -> Path:
    """Return the track of a run, which is written at its end.

    Raises:
        RunError: If the run was killed before.
    """
    refuse_many(out)
    track = out / "trajectory.tum"
    if (
        not track.exists()
        and (out / "brain.safetensors").exists()
        and (out / "frames.csv").exists()
    ):
        raise RunError(f"{out}: was cut off before its end; go on with: neuroslam resume {out}")
    return track


def require_free(out: Path, source: str, overwrite: bool) -> None:
    """Make sure that a new run in a folder destroys nothing that it should not.

    Raises:
        RunError: If ``out`` is a file, is or holds the source, or holds a run already.
    """
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder to write")
    written = (*RUN_FILES, LANDMARKS_FILE)
    if Path(source) in (out.resolve(), *(out.resolve() / name for name in written)):
        raise RunError(f"{out}: is where the source is, which would change; take another folder")
    if not overwrite and any((out / name).exists() for name in written):
        raise RunError(f"{out}: holds a run already; resume it, take another folder or --overwrite")


class RowWriter:
    """Writes the two files that grow by a row a frame: ``frames.csv`` and ``trace.f64``."""

    def __init__(self, frames: TextIO, trace: BinaryIO) -> None:
        self.frames, self.trace = frames, trace

    @classmethod
    @contextlib.contextmanager
    def create(cls, out: Path) -> Iterator["RowWriter"]:
        """Start the files of a new run, in place of an earlier one's."""
        try:
            out.mkdir(parents=True, exist_ok=True)
            with (out / "frames.csv").open("w") as frames, (out / "trace.f64").open("wb") as trace:
                _remove_halves(out)
                shutil.rmtree(out / "events", ignore_errors=True)
                for name in (*RUN_FILES[2:], LANDMARKS_FILE):  # none would fit the new rows
                    (out / name).unlink(missing_ok=True)
                frames.write(FRAME_COLUMNS + "\n")
                yield cls(frames, trace)
        except OSError as error:
            raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None

    @classmethod
    @contextlib.contextmanager
    def reopen(cls, out: Path, rows: int) -> Iterator["RowWriter"]:
        """Go on after ``rows`` rows; whatever a killed run wrote after its last save is cut off."""
        row_bytes = 8 * len(TRACE_COLUMNS)
        try:
            with (
                (out / "frames.csv").open("r+") as frames,
                (out / "trace.f64").open("r+b") as trace,
            ):
                frames.readline()
                for done in range(rows):
                    if not _is_whole(frames.readline()):
                        raise RunError(f"{missing_rows(out, done, rows)}; cannot resume")
                frames.seek(frames.tell())
                frames.truncate()
                if trace.seek(0, os.SEEK_END) < rows * row_bytes:
                    raise RunError(f"{out}/trace.f64: shorter than the run; cannot resume")
                trace.truncate(rows * row_bytes)
                trace.seek(0, os.SEEK_END)
                _remove_halves(out)
                yield cls(frames, trace)
        except OSError as error:
            raise RunError(
                f"{error.filename or out}: cannot be used ({error.strerror or error}); "
                "cannot resume"
            ) from None

    def flush(self) -> None:
        """Bring the rows so far to the disk: neither a kill nor a power cut loses them."""
        for file in (self.frames, self.trace):
            file.flush()
            os.fsync(file.fileno())

    def write(self, r: StepResult, frame: Frame, brain: NavigationBrain) -> None:
        """Append the rows of one frame."""
        motion, match, pose, cells = (
            ",".join([repr(float(value)) for value in values])  # float: sources may hand numpy's
            for values in (
                (r.time_s, *r.motion[:2]),
                (r.view.error, r.view.relative_heading_rad),
                r.pose,
                r.cells,
            )
        )
        self.frames.write(
            f"{r.frame},{motion},{r.view.template},{match},{r.action},{r.experience},{pose},{cells},"
            f"{r.n_templates},{r.n_experiences},{r.n_links}\n"
        )
        truth = frame.truth or (math.nan, math.nan, math.nan)
        row = (r.time_s, *brain.map.origin, *brain.map.offset, *r.motion, *truth)
        self.trace.write(np.array(row, dtype="<f8").tobytes())


def _remove_halves(out: Path) -> None:
    """Remove what a run that was killed while it wrote a file has left of it."""
    for name in (*RUN_FILES, LANDMARKS_FILE):
        for half in out.glob(f".{name}.*.tmp"):
            half.unlink(missing_ok=True)


def read_trace(
    out: str | Path, rows: int | None = None, min_rows: int = 1
) -> dict[str, np.ndarray]:
    """Read ``trace.f64`` of a run: one array for each of ``TRACE_COLUMNS``.

    Args:
        out: Folder of the run.
        rows: So many, without what a killed run wrote after its last save; ``None``: all.
        min_rows: It must have so many.

    Raises:
        RunError: If there is none, or it has fewer rows.
    """
    path = Path(out) / "trace.f64"
    if not path.is_file():
        raise RunError(f"{path}: missing; is {out} a run?")
    values, width = np.fromfile(path, dtype="<f8"), len(TRACE_COLUMNS)
    there = len(values) // width
    if not path.stat().st_size and (rows or min_rows):
        raise RunError(f"{path}: holds no frames; was it merged from brain files alone?")
    if there < (rows or min_rows):
        raise RunError(f"{path}: damaged, {there} whole rows; expected {rows or 'some'}")
    table = values[: (rows or there) * width].reshape(-1, width)
    return {name: table[:, i] for i, name in enumerate(TRACE_COLUMNS)}


def places_of(
    brain: NavigationBrain, trace: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Find where every frame was, on the final map.

    Returns:
        Id of the experience as it is now, ``(frames,)``, -1 where it is not of this map or there
        was none yet; and the heading that the experience was made with, minus the heading of what
        it is now, in radians, ``(frames,)``.
    """
    origins = brain.map.origins()
    keys = origin_key(origins._asdict())
    own = origin_key({name: trace[name].astype(np.int64) for name in ("session", "number")})
    place, turn_rad = np.full(len(own), NO_EXPERIENCE), np.zeros(len(own))
    if len(keys):
        order = np.argsort(keys)
        found = order[np.searchsorted(keys, own, sorter=order).clip(max=len(keys) - 1)]
        known = (keys[found] == own) & (trace["number"] >= 0)
        place[known] = origins.experience[found[known]]
        turn_rad[known] = origins.turn_rad[found[known]]
    return place, turn_rad


def trajectory(brain: NavigationBrain, trace: dict[str, np.ndarray]) -> np.ndarray:
    """Place every frame on the final map: each keeps its offset from its experience.

    The trace may be of any session that the map holds.

    Returns:
        x, y in metres and heading in radians, shape ``(frames, 3)``; NaN where the frame's place
        is not of this map: it is of a stored one that was not joined.
    """
    place, turn_rad = places_of(brain, trace)
    on_map = place >= 0
    at = np.full((len(place), 3), np.nan)
    at[on_map] = brain.map.poses[place[on_map]]
    at[:, 2] += turn_rad
    if not brain.sessions.merges:
        at[trace["number"] < 0] = 0.0  # before the first experience
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    x = at[:, 0] + c * trace["dx_m"] - s * trace["dy_m"]
    y = at[:, 1] + s * trace["dx_m"] + c * trace["dy_m"]
    return np.column_stack([x, y, wrap_angles(at[:, 2] + trace["dtheta_rad"])])


def odometry_track(config: BrainConfig, trace: dict[str, np.ndarray]) -> np.ndarray:
    """Dead-reckon the run's odometry from the map's start; shape ``(frames, 3)``."""
    start = Pose(0.0, 0.0, math.radians(config.map.initial_heading_deg))
    return integrate_velocities(trace["v_m_s"], trace["w_rad_s"], trace["dt_s"], start)


def experiences_csv(brain: NavigationBrain) -> str:
    """Write the experiences as CSV: id,x_m,y_m,theta_rad,template,first_frame."""
    table = brain.map.experiences
    rows = zip(
        brain.map.poses.tolist(),
        table["template"].tolist(),
        table["first_frame"].tolist(),
        strict=True,
    )
    lines = [f"{i},{x!r},{y!r},{t!r},{v},{f}" for i, ((x, y, t), v, f) in enumerate(rows)]
    return "\n".join(["id,x_m,y_m,theta_rad,template,first_frame", *lines]) + "\n"


def landmarks_csv(brain: NavigationBrain) -> str:
    """Write what the semantic map knows: name,x_m,y_m,seen,first_frame,experience."""
    known = brain.semantic.landmarks()
    columns = ("name", "place_m", "seen", "first_frame", "experience")
    rows = zip(*(known[column].tolist() for column in columns), strict=True)
    lines = [f"{name},{x!r},{y!r},{n},{f},{e}" for name, (x, y), n, f, e in rows]
    return "\n".join(["name,x_m,y_m,seen,first_frame,experience", *lines]) + "\n"


def links_csv(links: Links) -> str:
    """Write the links as CSV: from,to,distance_m,heading_rad,facing_rad,duration_s."""
    rows = zip(*(column.tolist() for column in links), strict=True)
    lines = [",".join(repr(value) for value in row) for row in rows]
    return "\n".join(["from,to,distance_m,heading_rad,facing_rad,duration_s", *lines]) + "\n"


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def frame_rows(out: str | Path, rows: int | None = None) -> list[str]:
    """Read the whole rows of ``frames.csv``, those before the first that was cut off, as text.

    Args:
        out: Folder of the run.
        rows: No more than so many.

    Raises:
        RunError: If there is none, or it is not text.
    """
    path = Path(out) / "frames.csv"
    try:
        with path.open(encoding="utf-8") as file:
            return list(takewhile(_is_whole, islice(file, 1, None if rows is None else rows + 1)))
    except FileNotFoundError:
        raise RunError(f"{path}: missing; is {out} a run?") from None
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: damaged ({error})") from None


def _is_whole(line: str) -> bool:
    return line.endswith("\n") and line.count(",") == FRAME_COLUMNS.count(",")


def missing_rows(out: str | Path, there: int, seen: int) -> str:
    """Say that ``frames.csv`` has fewer whole rows than the brain has seen frames."""
    return (
        f"{Path(out) / 'frames.csv'}: damaged, {counted(there, 'whole row')}; "
        f"the brain has seen {counted(seen, 'frame')}"
    )


def _all_rows(out: str | Path, rows: int | None) -> list[str]:
    lines = frame_rows(out, rows)
    if rows is not None and len(lines) < rows:
        raise RunError(missing_rows(out, len(lines), rows))
    return lines


def read_frames(out: str | Path, rows: int | None = None) -> dict[str, np.ndarray]:
    """Read the columns of ``frames.csv`` that hold numbers, each as an array.

    Args:
        out: Folder of the run.
        rows: So many, as for :func:`read_trace`; ``None``: all that are whole.

    Raises:
        RunError: If there is none, or it is damaged.
    """
    names = FRAME_COLUMNS.split(",")
    numbers = [i for i, name in enumerate(names) if name != "action"]
    lines = _all_rows(out, rows)
    if not lines:
        return {names[i]: np.zeros(0) for i in numbers}
    try:
        table = np.loadtxt(lines, delimiter=",", usecols=numbers, ndmin=2)
    except ValueError as error:
        raise RunError(f"{Path(out) / 'frames.csv'}: damaged ({error})") from None
    return {names[i]: table[:, column] for column, i in enumerate(numbers)}


def read_actions(out: str | Path, rows: int | None = None) -> np.ndarray:
    """Read the column of ``frames.csv`` that is no number: what was done, as text ``(frames,)``.

    Args:
        out: Folder of the run.
        rows: As for :func:`read_frames`.

    Raises:
        RunError: As :func:`read_frames`.
    """
    column = FRAME_COLUMNS.split(",").index("action")
    return np.array([line.split(",")[column] for line in _all_rows(out, rows)], dtype=np.str_)


def read_plan(out: str | Path) -> RunPlan:
    """Read what a run was made from, out of its ``config.toml``.

    Raises:
        RunError: If the folder holds no run.
    """
    refuse_many(Path(out))
    path = Path(out) / "config.toml"
    if (Path(out) / "frames.csv").exists() and not any(
        (Path(out) / name).exists() for name in RUN_FILES[4:]
    ):
        raise RunError(
            f"{out}: was cut off before anything was saved; run it again with --overwrite"
        )
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))["run"]
        return RunPlan(**table | {"maps": tuple(table.get("maps", ()))})
    except OSError:
        if (Path(out) / "brain.safetensors").exists():
            raise RunError(
                f"{path}: is missing, and says what the run reads; put it back. The map is in "
                f"{Path(out) / 'brain.safetensors'}, which can be used alone"
            ) from None
        raise RunError(f"{out}: not a run, it has no config.toml") from None
    except (KeyError, TypeError, ValueError):  # not TOML, not text, or not of a run
        raise RunError(f"{path}: has no usable [run] table; is it of a run?") from None


def read_metrics(out: str | Path) -> dict[str, Any]:
    """Read the figures of a run.

    Raises:
        RunError: If there are none, or they are damaged.
    """
    path = Path(out) / "metrics.json"
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
        for name in _FIGURES:
            metrics[name]
    except FileNotFoundError:
        raise RunError(f"{path}: missing; is {out} a run?") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: damaged ({error})") from None
    return metrics


def true_poses(trace: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the true pose of every frame, ``(frames, 3)``, or ``None`` where it is not known."""
    truth = np.column_stack([trace[f"truth_{name}"] for name in ("x_m", "y_m", "theta_rad")])
    return truth if np.isfinite(truth).all() else None
