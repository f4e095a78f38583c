"""The files of a run; their names and columns are a contract."""

import contextlib
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, TextIO

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.config.files import toml_text
from neuroslam.errors import RunError, counted, printable
from neuroslam.limits import MOST_JSON_BYTES, parse_json, read_bounded
from neuroslam.mapping.tables import Links
from neuroslam.state.files import write_atomically
from neuroslam.types import Frame, StepResult

FRAME_COLUMNS = (
    "frame,time_s,v_m_s,w_rad_s,template,match_error,relative_heading_rad,action,experience,"
    "x_m,y_m,theta_rad,pose_x,pose_y,pose_theta,n_templates,n_experiences,n_links"
)

# One row per frame of trace.f64: what trajectory.tum and map.png need beyond frames.csv.
TRACE_COLUMNS = (
    "time_s", "session", "number", "dx_m", "dy_m", "dtheta_rad", "v_m_s", "w_rad_s", "dt_s",
    "truth_x_m", "truth_y_m", "truth_theta_rad",
)  # fmt: skip

RUN_FILES = (
    "frames.csv", "trace.f64", "config.toml", "metrics.json", "brain.safetensors",
    "experiences.csv", "links.csv", "trajectory.tum", "map.png",
)  # fmt: skip
LANDMARKS_FILE = "landmarks.csv"
"""Written if the brain has a semantic map; other populations can write tables of their own."""

TIMINGS = ("seconds", "cpu_seconds", "frames_per_s", "frames_per_cpu_s")
"""Figures that differ between two runs of one source and config; all others are equal."""


OnBadFrame = Literal["skip", "stop"]


@dataclass(frozen=True)
class RunPlan:
    """The source of a run and the range of its frames: table ``[run]`` of its ``config.toml``."""

    source: str
    start: int = 0
    stop: int | None = None
    on_bad_frame: OnBadFrame = "stop"
    maps: tuple[str, ...] = ()
    truth: str = ""
    axes: str = ""

    @property
    def name(self) -> str:
        """Short name of the source: the last two parts of its path."""
        return printable("/".join(Path(self.source).parts[-2:]))

    @property
    def skips(self) -> bool:
        """Whether unusable frames are skipped."""
        return self.on_bad_frame == "skip"

    def to_toml(self) -> str:
        """Write the table."""
        lines = [f"source = {toml_text(self.source)}", f"start = {self.start}"]
        if self.stop is not None:
            lines.append(f"stop = {self.stop}")
        lines.append(f'on_bad_frame = "{self.on_bad_frame}"')
        if self.maps:
            lines.append(f"maps = [{', '.join(map(toml_text, self.maps))}]")
        if self.truth:
            lines.append(f"truth = {toml_text(self.truth)}")
        if self.axes:
            lines.append(f"axes = {toml_text(self.axes)}")
        return "\n".join(["\n[run]", *lines]) + "\n"


def brain_file(path: str | Path) -> Path:
    """Return the brain file of a run folder, or the path itself if it is no folder."""
    path = Path(path)
    refuse_many(path)
    return path / "brain.safetensors" if path.is_dir() else path


def refuse_many(out: Path) -> None:
    """Refuse the folder of a sweep, a fleet or a tuning where a run is expected.

    Raises:
        RunError: If it is such a folder; the message says where its runs are.
    """
    if (out / "brain.safetensors").exists() or (out / "frames.csv").exists():
        return
    if (out / "sweep.json").exists():
        one = next((f", e.g. {path.parent}" for path in sorted(out.glob("*/frames.csv"))), "")
        what = f"a sweep; expected one of its runs, which are folders in it{one}"
    elif (out / "fleet.json").exists():
        merged = (out / "merged").is_dir()
        what = f"a fleet; its {'merged map is' if merged else 'maps are'} in {out}/"
        what += "merged" if merged else "sessions"
    elif (out / "tune.json").exists():
        what = f"a tuning; use its config with --config {out}/config.toml"
    else:
        return
    raise RunError(f"{out}: is {what}")


def run_files(out: Path) -> tuple[str, ...]:
    """Name all files of a run, including the tables that its populations have written."""
    try:
        tables = parse_json(read_bounded(out / "metrics.json", MOST_JSON_BYTES))["tables"]
        own = [name for name in tables if isinstance(name, str) and Path(name).name == name]
    except (OSError, ValueError, KeyError, TypeError):  # no run, or one of an older version
        own = []
    return (*RUN_FILES, *dict.fromkeys([LANDMARKS_FILE, *own]))


def require_free(out: Path, source: str, overwrite: bool) -> None:
    """Check that a new run in a folder overwrites neither its source nor an earlier run.

    Raises:
        RunError: If ``out`` is a file, is or holds the source, or holds a run already.
    """
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder")
    written = run_files(out)
    if Path(source) in (out.resolve(), *(out.resolve() / name for name in written)):
        raise RunError(f"{out}: a run here would overwrite its source; choose another folder")
    if not overwrite and any((out / name).exists() for name in written):
        raise RunError(
            f"{out}: holds a run already; resume it, choose another folder or use --overwrite"
        )


class RowWriter:
    """Writes the two files that grow by one row per frame: ``frames.csv`` and ``trace.f64``."""

    def __init__(self, frames: TextIO, trace: BinaryIO) -> None:
        self.frames, self.trace = frames, trace

    @classmethod
    @contextlib.contextmanager
    def create(cls, out: Path) -> Iterator["RowWriter"]:
        """Start the files of a new run; those of an earlier run are removed."""
        try:
            out.mkdir(parents=True, exist_ok=True)
            with (out / "frames.csv").open("w") as frames, (out / "trace.f64").open("wb") as trace:
                _remove_partial_files(out)
                shutil.rmtree(out / "events", ignore_errors=True)
                for name in run_files(out)[2:]:  # they belong to the earlier run
                    (out / name).unlink(missing_ok=True)
                frames.write(FRAME_COLUMNS + "\n")
                yield cls(frames, trace)
        except OSError as error:
            raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None

    @classmethod
    @contextlib.contextmanager
    def reopen(cls, out: Path, rows: int) -> Iterator["RowWriter"]:
        """Continue after ``rows`` rows; rows after the last save of a killed run are cut off."""
        row_bytes = 8 * len(TRACE_COLUMNS)
        try:
            with (
                (out / "frames.csv").open("r+") as frames,
                (out / "trace.f64").open("r+b") as trace,
            ):
                frames.readline()
                for done in range(rows):
                    if not is_whole(frames.readline()):
                        raise RunError(f"{missing_rows(out, done, rows)}; cannot resume")
                frames.seek(frames.tell())
                frames.truncate()
                if trace.seek(0, os.SEEK_END) < rows * row_bytes:
                    there = trace.tell() // row_bytes
                    raise RunError(
                        f"{out}/trace.f64: {counted(there, 'row')}, the brain has seen "
                        f"{counted(rows, 'frame')}; cannot resume"
                    )
                trace.truncate(rows * row_bytes)
                trace.seek(0, os.SEEK_END)
                _remove_partial_files(out)
                yield cls(frames, trace)
        except OSError as error:
            raise RunError(
                f"{error.filename or out}: cannot be opened ({error.strerror or error}); "
                "cannot resume"
            ) from None

    def flush(self) -> None:
        """Write the rows so far to the disk, so that neither a kill nor a power cut loses them."""
        for file in (self.frames, self.trace):
            file.flush()
            os.fsync(file.fileno())

    def write(self, r: StepResult, frame: Frame, brain: NavigationBrain) -> None:
        """Append the rows of one frame."""
        motion, match, pose, cells = (
            ",".join([repr(float(value)) for value in values])  # sources may return numpy scalars
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


def _remove_partial_files(out: Path) -> None:
    """Remove the temporary files of a run that was killed while it wrote."""
    for name in run_files(out):
        for partial in out.glob(f".{name}.*.tmp"):
            partial.unlink(missing_ok=True)


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


def links_csv(links: Links) -> str:
    """Write the links as CSV: from,to,distance_m,heading_rad,facing_rad,duration_s."""
    rows = zip(*(column.tolist() for column in links), strict=True)
    lines = [",".join(repr(value) for value in row) for row in rows]
    return "\n".join(["from,to,distance_m,heading_rad,facing_rad,duration_s", *lines]) + "\n"


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def is_whole(line: str) -> bool:
    """Return whether a row of ``frames.csv`` is complete."""
    return line.endswith("\n") and line.count(",") == FRAME_COLUMNS.count(",")


def missing_rows(out: str | Path, there: int, seen: int) -> str:
    """Return the message for a ``frames.csv`` that lacks rows of frames the brain has seen."""
    return (
        f"{Path(out) / 'frames.csv'}: damaged, {counted(there, 'whole row')}; "
        f"the brain has seen {counted(seen, 'frame')}"
    )
