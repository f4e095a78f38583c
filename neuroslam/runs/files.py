"""The files of a run; their names and columns are a contract."""

import contextlib
import hashlib
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from pydantic import ConfigDict

from neuroslam.brain import NavigationBrain
from neuroslam.config.files import toml_text
from neuroslam.errors import RunError, counted, printable
from neuroslam.limits import MOST_JSON_BYTES, parse_json, read_bounded
from neuroslam.mapping.tables import Links
from neuroslam.runs.manifest import MANIFEST, ROWS, Extent, check_saved
from neuroslam.runs.saves import settle
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

    __pydantic_config__ = ConfigDict(extra="forbid")  # of what is read

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
    """Return the brain file of a run folder, or the path itself if it is no folder.

    Raises:
        RunError: If it is the folder of many runs, or the brain is not that of its last save.
    """
    path = Path(path)
    refuse_many(path)
    if not path.is_dir():
        return path
    check_saved(path / "brain.safetensors")
    return path / "brain.safetensors"


def refuse_many(out: Path) -> None:
    """Refuse the folder of a sweep, a fleet or a tuning where a run is expected.

    Raises:
        RunError: If it is such a folder; the message says where its runs are.
    """
    if out.is_dir():
        settle(out)
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
    return (*RUN_FILES, MANIFEST, *dict.fromkeys([LANDMARKS_FILE, *own]))


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
    """Writes the two files that grow by one row per frame: ``frames.csv`` and ``trace.f64``.

    Attributes:
        folder: Where they are: in the folder of the run, or beside those of an earlier run until
            the first save replaces that.
    """

    def __init__(self, folder: Path, frames: BinaryIO, trace: BinaryIO) -> None:
        self.folder = folder
        self.files: dict[str, BinaryIO] = dict(zip(ROWS, (frames, trace), strict=True))
        self._sizes: dict[str, int] = dict.fromkeys(self.files, 0)
        self._digests = {name: hashlib.sha256() for name in self.files}

    @classmethod
    @contextlib.contextmanager
    def create(cls, folder: Path, more: Iterable[str] = ()) -> Iterator["RowWriter"]:
        """Start the files of a new run, in a folder that is made if it is missing.

        Args:
            folder: Where they are.
            more: Columns that populations add, names of :func:`more_columns`.
        """
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "frames.csv").open("wb") as frames, (folder / "trace.f64").open("wb") as t:
            writer = cls(folder, frames, t)
            header = ",".join([FRAME_COLUMNS, *more])
            writer._append("frames.csv", f"{header}\n".encode())
            yield writer

    @classmethod
    @contextlib.contextmanager
    def reopen(cls, out: Path, rows: int) -> Iterator["RowWriter"]:
        """Continue after ``rows`` rows; rows after the last save of a killed run are cut off.

        Raises:
            RunError: If a file is missing, has fewer rows, or other rows than were saved.
        """
        with contextlib.ExitStack() as stack:
            try:
                opened = [stack.enter_context((out / n).open("r+b")) for n in ROWS]
                writer = cls(out, *opened)
                writer._continue_after(rows)
            except OSError as error:
                raise RunError(
                    f"{error.filename or out}: cannot be opened ({error.strerror or error}); "
                    "cannot resume"
                ) from None
            yield writer

    def _continue_after(self, rows: int) -> None:
        frames, trace = self.files.values()
        self._take(frames.readline(), "frames.csv")
        for done in range(rows):
            line = frames.readline()
            if not is_whole(line.decode(errors="replace")):
                raise RunError(f"{missing_rows(self.folder, done, rows)}; cannot resume")
            self._take(line, "frames.csv")
        n_bytes = rows * 8 * len(TRACE_COLUMNS)
        if trace.seek(0, os.SEEK_END) < n_bytes:
            raise RunError(
                f"{self.folder}/trace.f64: "
                f"{counted(trace.tell() // (8 * len(TRACE_COLUMNS)), 'row')}, the brain has seen "
                f"{counted(rows, 'frame')}; cannot resume"
            )
        trace.seek(0)
        self._take(trace.read(n_bytes), "trace.f64")
        for name in self.files:
            check_saved(self.folder / name)
        for name, file in self.files.items():
            file.seek(self._sizes[name])
            file.truncate()

    def saved(self) -> dict[str, Extent]:
        """Write the rows so far to the disk, and return what there is of each file."""
        for file in self.files.values():
            if not file.closed:
                file.flush()
                os.fsync(file.fileno())
        return {
            name: Extent(self._sizes[name], digest.hexdigest())
            for name, digest in self._digests.items()
        }

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
        line = (
            f"{r.frame},{motion},{r.view.template},{match},{r.action},{r.experience},{pose},{cells},"
            f"{r.n_templates},{r.n_experiences},{r.n_links}"
        )
        line = ",".join([line, *(repr(float(v)) for v in more_columns(brain).values())]) + "\n"
        self._append("frames.csv", line.encode())
        truth = frame.truth or (math.nan, math.nan, math.nan)
        row = (r.time_s, *brain.map.origin, *brain.map.offset, *r.motion, *truth)
        self._append("trace.f64", np.array(row, dtype="<f8").tobytes())

    def _append(self, name: str, row: bytes) -> None:
        self.files[name].write(row)
        self._take(row, name)

    def _take(self, row: bytes, name: str) -> None:
        self._sizes[name] += len(row)
        self._digests[name].update(row)


def more_columns(brain: NavigationBrain) -> dict[str, float]:
    """Return the columns that populations add to ``frames.csv``, with their values now."""
    found: dict[str, float] = {}
    for population in brain.populations.values():
        found |= population.frame_columns()
    return found


def experiences_csv(brain: NavigationBrain) -> str:
    """Write the experiences as CSV: id,x_m,y_m,theta_rad,template,first_frame, and populations'."""
    table = brain.map.experiences
    rows = zip(
        brain.map.poses.tolist(),
        table["template"].tolist(),
        table["first_frame"].tolist(),
        strict=True,
    )
    lines = [f"{i},{x!r},{y!r},{t!r},{v},{f}" for i, ((x, y, t), v, f) in enumerate(rows)]
    names = ["id,x_m,y_m,theta_rad,template,first_frame"]
    for population in brain.populations.values():
        for name, column in population.experience_columns().items():
            names.append(name)
            both = zip(lines, column.tolist(), strict=True)
            lines = [f"{line},{value!r}" for line, value in both]
    return "\n".join([",".join(names), *lines]) + "\n"


def links_csv(links: Links, weights: np.ndarray | None = None) -> str:
    """Write the links as CSV: from,to,distance_m,heading_rad,facing_rad,duration_s,weight.

    Args:
        links: Links of the map.
        weights: Their weights, as ``ExperienceMap.link_weights``; ``None``: without that column,
            as it was before there were weights.
    """
    columns, header = [*links], "from,to,distance_m,heading_rad,facing_rad,duration_s"
    if weights is not None:
        columns, header = [*columns, weights], f"{header},weight"
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows)]) + "\n"


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def is_whole(line: str) -> bool:
    """Return whether a row of ``frames.csv`` is complete."""
    return line.endswith("\n") and line.count(",") >= FRAME_COLUMNS.count(",")


def missing_rows(out: str | Path, there: int, seen: int) -> str:
    """Return the message for a ``frames.csv`` that lacks rows of frames the brain has seen."""
    return (
        f"{Path(out) / 'frames.csv'}: damaged, {counted(there, 'whole row')}; "
        f"the brain has seen {counted(seen, 'frame')}"
    )
