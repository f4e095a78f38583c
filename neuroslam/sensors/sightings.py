"""Landmark sightings as a CSV, and a source of motion that has them.

One sighting a line, ``time_s,number,distance_m,bearing_rad`` or ``bearing_deg`` in any order; the
number is empty or -1 for a landmark without a name; the time is read as in every table
(:mod:`neuroslam.sensors.times`). Lines need not be sorted. ``motion.csv+sightings.csv`` opens both:
a frame has the landmarks seen since the frame before it.
"""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from neuroslam.errors import SourceError, counted
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.sensors.source import IndexedSource, OnBadFrame, Source
from neuroslam.sensors.tracks import Clock, header_and_rows, parse_table, time_text
from neuroslam.types import Frame

_NEEDED = ("time_s", "number", "distance_m")
_EXPECTED = "expected time_s,number,distance_m,bearing_rad (or bearing_deg)"


def sightings_between(rows: np.ndarray, after_s: float, until_s: float) -> np.ndarray | None:
    """Return the landmarks sighted in an interval, ``(n, 3)``; ``None`` without any.

    Args:
        rows: Time, number, distance and bearing of each sighting, sorted by time, ``(m, 4)``.
        after_s: The interval begins after this time.
        until_s: It ends at this time.

    Example:
        >>> rows = np.array([[0.1, 7.0, 2.0, 0.5], [0.2, 8.0, 1.0, 0.0]])
        >>> sightings_between(rows, 0.1, 0.2).tolist()
        [[8.0, 1.0, 0.0]]
    """
    low, high = np.searchsorted(rows[:, 0], [after_s + 1e-9, until_s + 1e-9])
    return rows[low:high, 1:] if high > low else None


_MOST_RAD = 2.0 * np.pi + 0.01
_FAR_M = 200.0  # beyond the reach of robots' sensors
_MOST_NUMBER = 2**31
_SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")


def require_sightings(what: str, distances_m: np.ndarray, bearings_rad: np.ndarray) -> None:
    """Check the distances and bearings of sightings.

    Raises:
        SourceError: If a distance is negative, or a bearing more than a turn.

    Example:
        >>> require_sightings("posts.csv", np.array([2.0]), np.array([90.0]))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        neuroslam.errors.SourceError: posts.csv: bearings reach 90 rad, more than a turn; ...
    """
    if not len(distances_m):
        return
    if distances_m.min() < 0.0:
        raise SourceError(
            f"{what}: the smallest distance is {distances_m.min():g} m; expected at least 0"
        )
    most = float(bearings_rad[np.abs(bearings_rad).argmax()])
    if abs(most) > _MOST_RAD:
        raise SourceError(
            f"{what}: bearings reach {most:g} rad, more than a turn; expected radians: are they in "
            "degrees?"
        )


class SightingsSource(IndexedSource):
    """A table of landmark sightings: a frame at each of its times, without motion."""

    def __init__(self, name: str, rows: np.ndarray, notes: tuple[str, ...] = ()) -> None:
        self.name, self.rows = name, rows
        times = np.unique(rows[:, 0])
        self.clock = Clock(name, times, 20.0)
        self.n_frames, self.frame_rate_hz = len(times), self.clock.frame_rate_hz
        self.notes = (
            *notes,
            f"{name}: {counted(len(rows), 'sighting')} of "
            f"{counted(len(np.unique(rows[:, 1])), 'landmark')}",
        )
        usual_m = float(np.median(rows[:, 2]))
        if usual_m > _FAR_M:
            self.notes += (
                f"{name}: the median distance is {usual_m:g} m; expected at most {_FAR_M:g} m: are "
                "the distances in centimetres or millimetres?",
            )

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        low, high = (np.searchsorted(self.rows[:, 0], time_s, side) for side in _SIDES)
        return Frame(index, time_s, landmarks=self.rows[low:high, 1:])


class WithSightings(Source):
    """A source with the landmarks of a table of sightings.

    Args:
        source: The source; its own landmarks are replaced.
        sightings: The table.
        offset_s: Seconds to add to the times of the sightings, where the two clocks differ.

    Raises:
        SourceError: If no sighting is within the times of the first frame and those after.
    """

    def __init__(self, source: Source, sightings: SightingsSource, offset_s: float = 0.0) -> None:
        self.source = source
        self.rows = sightings.rows + np.array([offset_s, 0.0, 0.0, 0.0])
        self.name = f"{source.name}+{sightings.name}"
        self.n_frames, self.frame_rate_hz = source.n_frames, source.frame_rate_hz
        self.live = source.live
        self._of_rows = sightings.notes
        self._missed: tuple[str, ...] = ()
        first = next(source.frames(on_bad_frame=lambda _: None), None)
        if first is None or self.rows[-1, 0] < first.time_s:
            begins = "has no usable frame" if first is None else f"begins at {first.time_s:.6g} s"
            raise SourceError(
                f"{self.name}: {source.name} {begins} and the last sighting is at "
                f"{self.rows[-1, 0]:.6g} s; expected an overlap; check that both use one clock, or "
                "give --offset S"
            )

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """The notes of both."""
        return (*self.source.notes, *self._of_rows)

    @property
    def unused(self) -> tuple[str, ...]:  # type: ignore[override]
        """The unused data of the source, and the sightings outside its times."""
        return (*self.source.unused, *self._missed)

    @property
    def landmark_words(self) -> tuple[LandmarkWords, ...]:  # type: ignore[override]
        """The words of the source's own landmarks."""
        return self.source.landmark_words

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        before, begin_s, self._missed = -np.inf, -np.inf, ()
        for frame in self.source.frames(max(start - 1, 0), stop, on_bad_frame):
            landmarks = sightings_between(self.rows, before, frame.time_s)
            if np.isinf(before) and landmarks is not None:  # not all that was seen before it
                period_s = 1.0 / self.frame_rate_hz if self.frame_rate_hz else 0.0
                landmarks = sightings_between(self.rows, frame.time_s - period_s, frame.time_s)
            begin_s = frame.time_s if np.isinf(before) else begin_s
            before = frame.time_s
            if frame.index >= start:
                yield frame._replace(landmarks=landmarks)
        if stop is None or (self.n_frames is not None and stop >= self.n_frames):
            self._missed = self._outside(begin_s, before)

    def _outside(self, begin_s: float, end_s: float) -> tuple[str, ...]:
        times = self.rows[:, 0]
        n = int((times > end_s + 1e-9).sum())
        if not n or not np.isfinite(end_s):
            return ()
        which = "all" if n == len(times) else f"{n} of"
        return (
            f"{self.name}: {which} {counted(len(times), 'sighting')} are after the last frame: the "
            f"frames span {time_text(begin_s)} to {time_text(end_s)}, the sightings "
            f"{time_text(float(times[0]))} to {time_text(float(times[-1]))}",
        )


def is_sightings(header: list[str]) -> bool:
    """Return whether the header of a table is that of landmark sightings.

    Example:
        >>> is_sightings(["time_s", "number", "distance_m", "bearing_deg"])
        True
    """
    names = {name.strip().lstrip("#").strip().lower() for name in header}
    return {"number", "distance_m"} <= names and bool({"bearing_rad", "bearing_deg"} & names)


def parse_sightings(text: str, name: str) -> SightingsSource:
    r"""Read a table of landmark sightings; the module's docstring describes its format.

    Raises:
        SourceError: If a column is missing or a line is invalid.

    Example:
        >>> table = "time_s,number,distance_m,bearing_deg\n0.5,7,2.0,90\n"
        >>> parse_sightings(table, "posts.csv").frame(0).landmarks.round(3).tolist()
        [[7.0, 2.0, 1.571]]
    """
    header = header_and_rows(text, name)[0]
    degrees = any("bearing_deg" in field.lower() for field in header)
    bearing = "bearing_deg" if degrees else "bearing_rad"
    table = parse_table(text, name, (*_NEEDED, bearing), _EXPECTED)
    columns = table.columns
    number = np.where(np.isfinite(columns["number"]), columns["number"], -1.0)
    angle = np.radians(columns[bearing]) if degrees else columns[bearing]
    rows = np.column_stack([columns["time_s"], number, columns["distance_m"], angle])
    wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1) | (rows[:, 2] < 0.0))
    if len(wrong):
        raise SourceError(
            f"{name}: {table.rows[wrong[0]]} has time {rows[wrong[0], 0]} s, distance "
            f"{rows[wrong[0], 2]} m, bearing {rows[wrong[0], 3]} rad; expected finite numbers, and "
            "a distance of at least 0"
        )
    odd = np.flatnonzero(
        (rows[:, 1] != np.rint(rows[:, 1])) | (rows[:, 1] < -1.0) | (rows[:, 1] >= _MOST_NUMBER)
    )
    if len(odd):
        raise SourceError(
            f"{name}: {table.rows[odd[0]]} has number {rows[odd[0], 1]:g}; expected a whole number "
            "of a landmark, or none"
        )
    require_sightings(name, rows[:, 2], rows[:, 3])
    return SightingsSource(name, rows[np.argsort(rows[:, 0], kind="stable")], table.notes)
