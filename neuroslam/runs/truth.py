"""Ground truth from a file of its own, for a source that has none: a video, a camera, a log."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from neuroslam.errors import SourceError
from neuroslam.evaluation.trajectory import Track, read_tum_file
from neuroslam.sensors.axes import ROBOT, Axes, axes_note, on_ground, parse_axes
from neuroslam.sensors.datasets import at_times, lost_rows
from neuroslam.sensors.images import read_text
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.sensors.times import in_seconds, unit_note
from neuroslam.sensors.tracks import Table, parse_table, rising, time_text
from neuroslam.types import Frame, Pose

_POSITION = ("x_m", "y_m", "z_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ALIASES = {
    spelling.format(letter): f"{letter}_m"
    for letter in "xyz"
    for spelling in ("{}", "{} [m]", "{}[m]", "{} (m)", "t{}", "p{}", "p_{}", "p_rs_r_{}",
                     "p_rs_r_{} [m]", "pos_{}", "position_{}", "position.{}")
} | {
    spelling.format(letter): f"q{letter}"
    for letter in "xyzw"
    for spelling in ("q_{}", "q_rs_{}", "q_rs_{} []", "orientation_{}", "orientation.{}")
} | {"theta": "theta_rad", "yaw": "theta_rad"}  # fmt: skip
_NEEDED = ("time_s", "x_m", "y_m")
_EXPECTED = "expected time_s,x_m,y_m and optionally theta_rad (or time,x,y,theta)"


def read_truth(
    path: str | Path,
    axes: str | Axes | None = None,
    on_note: Callable[[str], object] | None = None,
    option: str = "--axes camera",
) -> Track:
    """Read ground truth: a CSV with a header, or a TUM file.

    A CSV has the columns ``time_s``, ``x_m``, ``y_m`` and optionally ``theta_rad``, or ``time``,
    ``x``, ``y``, ``theta``, and other usual names; with ``z`` and a quaternion ``qx`` ... ``qw`` it
    is a pose in three dimensions, as in a TUM file. Rows without a usable pose are left out; an
    unknown heading is NaN. Times are in seconds, or in ms, us or ns if the name states that or
    their size shows it.

    Args:
        path: The file; one named ``.csv`` is a CSV, any other a TUM file.
        axes: Axes that span the ground plane, see :func:`~neuroslam.sensors.axes.parse_axes`;
            ``None``: x and y, with a note if the file moves along z instead.
        on_note: Called with each note on how the file was read.
        option: What to do about axes of a camera, for the note.

    Returns:
        Times in seconds, rising, and poses ``(n, 3)``.

    Raises:
        SourceError: If the file is missing or damaged, has no position, half of its rows or more
            cannot be used, or ``axes`` are none.
    """
    path, note = Path(path), on_note or (lambda _: None)
    span = ROBOT if axes is None else parse_axes(axes) if isinstance(axes, str) else axes
    faults: list[str] = []
    if path.suffix.lower() == ".csv":
        times_s, positions, poses = _from_csv(path, span, faults, note)
        n_rows = len(times_s) + len(faults)
    else:
        content = read_tum_file(path, faults.append)
        n_rows = len(content.times_s) + len(faults)
        times_s, unit = in_seconds(content.times_s, "s")
        if unit != "s":
            note(unit_note(str(path), "s", unit))
        positions = content.positions
        poses = on_ground(positions, content.quaternions, span)
    if faults:
        note(lost_rows(f"truth {path}", faults, n_rows))
    if axes is None and (found := axes_note(f"truth {path}", positions, option)):
        note(found)
    up = positions[:, 2]
    known = span == ROBOT and np.isfinite(up).all() and up.any()
    return Track(times_s, poses, up if known else None)


def _from_csv(
    path: Path, axes: Axes, faults: list[str], note: Callable[[str], object]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, positions in three dimensions, and poses of the usable rows of a CSV."""
    if not path.is_file():
        raise SourceError(f"truth {path}: no such file; {_EXPECTED}")
    several = ("theta_rad", "z_m", *_QUATERNION)
    table: Table = parse_table(
        read_text(path), str(path), _NEEDED, _EXPECTED, several, (), _ALIASES, faults.append
    )
    columns, rows = table.columns, table.rows
    for line in table.notes:
        note(line)
    n = len(rows)
    unknown = np.full(n, np.nan)
    if any(_POSITION[k] == "z_m" for k, _ in (axes.ahead, axes.left)) and "z_m" not in columns:
        raise SourceError(f"truth {path}: has no column z, which --axes {axes.name} needs")
    positions = np.column_stack([columns.get(name, unknown) for name in _POSITION])
    quaternions = None
    if all(name in columns for name in _QUATERNION):
        quaternions = np.column_stack([columns[name] for name in _QUATERNION])
    poses = on_ground(positions, quaternions, axes)
    if quaternions is None and axes == ROBOT:
        poses[:, 2] = columns.get("theta_rad", unknown)
    times_s = columns["time_s"]
    placed = np.isfinite(poses[:, :2]).all(axis=1)
    if not placed.any():
        raise SourceError(
            f"truth {path}: {faults[0] if faults else f'has no position; {_EXPECTED}'}"
        )
    late = np.zeros(n, dtype=bool)
    late[placed] = rising(times_s[placed])
    for row in np.flatnonzero(placed & ~late):
        faults.append(f"{rows[row]}: its time does not rise; sort the rows")
    if len(faults) >= late.sum():
        raise SourceError(f"truth {path}: {faults[0]}")
    return times_s[late], positions[late], poses[late]


class WithTruth(Source):
    """A source whose frames have the true poses of a file.

    A pose is interpolated between its neighbours in time, and unknown where none is nearer than
    0.1 s, or, before the first and after the last, within 0.02 s.

    Args:
        source: The source; a true pose that it knows itself is replaced.
        path: File that :func:`read_truth` reads.
        axes: Axes of the ground plane in the file, as for :func:`read_truth`.

    Raises:
        SourceError: If the file cannot be read.
    """

    def __init__(self, source: Source, path: str | Path, axes: str | None = None) -> None:
        self.source, self.path = source, Path(path)
        self.truth_notes: list[str] = []
        self.track = read_truth(path, axes, self.truth_notes.append)
        self.name, self.n_frames = source.name, source.n_frames
        self.frame_rate_hz, self.live = source.frame_rate_hz, source.live
        self.landmark_words = source.landmark_words
        self._span_s: tuple[float, float] | None = None
        self._any_known = False

    @property
    def unused(self) -> tuple[str, ...]:  # type: ignore[override]
        """The unused data of the source, and the truth if it is of no frame."""
        if self._span_s is None or self._any_known:
            return self.source.unused
        first, last = (time_text(float(t)) for t in self.track.times_s[[0, -1]])
        start, stop = map(time_text, self._span_s)
        note = (
            f"{self.path}: no frame has a true pose: it spans {first} to {last}, the frames "
            f"{start} to {stop}; expected the times of the source"
        )
        return (*self.source.unused, note)

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """The notes of the source, and how the truth was read."""
        return (*self.source.notes, *self.truth_notes)

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames of the source with the true pose, see :meth:`Source.frames`."""
        for frame in self.source.frames(start, stop, on_bad_frame):
            at = max(int(np.searchsorted(self.track.times_s, frame.time_s)) - 1, 0)
            near = slice(at, at + 2)
            times_s, poses = self.track.times_s[near], self.track.poses[near]
            pose = at_times(times_s, poses, np.array([frame.time_s]))[0]
            known = bool(np.isfinite(pose[:2]).all())
            self._any_known |= known
            first = frame.time_s if self._span_s is None else self._span_s[0]
            self._span_s = first, frame.time_s
            yield frame._replace(truth=Pose(*pose.tolist()) if known else None)
