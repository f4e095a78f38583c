"""Landmark sightings as a CSV, and a source of motion that has them.

One sighting a line, ``time_s,number,distance_m,bearing_rad`` or ``bearing_deg`` in any order; the
number is empty or -1 for a landmark without a name; the time is read as in every table
(:mod:`neuroslam.sensors.times`). Lines need not be sorted. ``motion.csv+sightings.csv`` opens both:
a frame has the landmarks seen since the frame before it.
"""

from collections.abc import Iterator

import numpy as np

from neuroslam.errors import SourceError, counted
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.sensors.source import IndexedSource, OnBadFrame, Source
from neuroslam.sensors.tracks import Clock, parse_table
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

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        landmarks = self.rows[self.rows[:, 0] == time_s][:, 1:]
        return Frame(index, time_s, landmarks=landmarks)


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
    def landmark_words(self) -> tuple[LandmarkWords, ...]:  # type: ignore[override]
        """The words of the source's own landmarks."""
        return self.source.landmark_words

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        before = -np.inf
        for frame in self.source.frames(max(start - 1, 0), stop, on_bad_frame):
            landmarks = sightings_between(self.rows, before, frame.time_s)
            if np.isinf(before) and landmarks is not None:  # not all that was seen before it
                period_s = 1.0 / self.frame_rate_hz if self.frame_rate_hz else 0.0
                landmarks = sightings_between(self.rows, frame.time_s - period_s, frame.time_s)
            before = frame.time_s
            if frame.index >= start:
                yield frame._replace(landmarks=landmarks)


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
    degrees = "bearing_deg" in text.partition("\n")[0].lower()
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
    return SightingsSource(name, rows[np.argsort(rows[:, 0], kind="stable")], table.notes)
