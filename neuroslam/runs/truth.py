"""Ground truth from a file of its own, for a source that has none: a video, a camera, a log."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neuroslam.errors import SourceError
from neuroslam.evaluation.trajectory import Track, read_tum
from neuroslam.sensors.datasets import at_times
from neuroslam.sensors.images import read_text
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.sensors.tracks import parse_table, rising, time_text
from neuroslam.types import Frame, Pose

_SHORT = {"time": "time_s", "x": "x_m", "y": "y_m", "theta": "theta_rad"}
_NEEDED = ("time_s", "x_m", "y_m")
_EXPECTED = "expected time_s,x_m,y_m and optionally theta_rad (or time,x,y,theta)"


def read_truth(path: str | Path) -> Track:
    """Read ground truth: a CSV with a header, or a TUM file.

    A CSV has the columns ``time_s``, ``x_m``, ``y_m`` and optionally ``theta_rad``, or ``time``,
    ``x``, ``y``, ``theta``. Rows with an empty position are left out; an unknown heading is NaN.

    Args:
        path: The file; one named ``.csv`` is a CSV, any other a TUM file.

    Returns:
        Times in seconds, rising, and poses ``(n, 3)``.

    Raises:
        SourceError: If the file is missing, damaged, has no position, or its times do not rise.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        return read_tum(path)
    if not path.is_file():
        raise SourceError(f"truth {path}: no such file; {_EXPECTED}")
    header, mark, rest = read_text(path).lstrip().partition("\n")
    names = [_SHORT.get(name.strip().lower(), name) for name in header.split(",")]
    text = ",".join(names) + mark + rest
    table, rows = parse_table(text, str(path), _NEEDED, _EXPECTED, optional=("theta_rad",))
    theta = table.get("theta_rad", np.full(len(rows), np.nan))
    times_s, poses = table["time_s"], np.column_stack([table["x_m"], table["y_m"], theta])
    known = np.isfinite(poses[:, :2]).all(axis=1)
    times_s, poses = times_s[known], poses[known]
    if not len(times_s):
        raise SourceError(f"truth {path}: has no position; {_EXPECTED}")
    if not rising(times_s).all():
        at = int(np.argmin(rising(times_s)))
        row = np.flatnonzero(known)[at]
        raise SourceError(f"truth {path}: {rows[row]}: its time does not rise; sort the rows")
    return Track(times_s, poses)


class WithTruth(Source):
    """A source whose frames have the true poses of a file.

    A pose is interpolated between its neighbours in time, and unknown where none is within 0.1 s.

    Args:
        source: The source; a true pose that it knows itself is replaced.
        path: File that :func:`read_truth` reads.

    Raises:
        SourceError: If the file cannot be read.
    """

    def __init__(self, source: Source, path: str | Path) -> None:
        self.source, self.path = source, Path(path)
        self.track = read_truth(path)
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
        """The notes of the source."""
        return self.source.notes

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
