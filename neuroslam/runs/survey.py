"""What a run would read: kind, size, times and rate of a source, found without a run."""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from neuroslam.config import BrainConfig
from neuroslam.errors import RunError, counted
from neuroslam.runs.reading import unit_of
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.open import pair_of, split_offset
from neuroslam.sensors.rosbag import BagCamera, BagMotion, is_bag
from neuroslam.sensors.sightings import WithSightings
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.streams import Shifted, Streams
from neuroslam.sensors.tracks import time_text
from neuroslam.types import Frame

EXAMINED = 50
"""Frames at the beginning of a source that are read: they show size, content and rate."""

_KINDS = {
    "VideoSource": "video",
    "ImageSource": "images",
    "TubSource": "donkeycar tub",
    "TrackSource": "track of motion",
    "CameraSource": "live camera",
    "WorldSource": "rendered world",
    "ArenaSource": "track of an animal",
    "CarmenSource": "CARMEN log",
    "MrclamSource": "MRCLAM log",
    "SightingsSource": "sightings of landmarks",
    "BagCamera": "images of a ROS bag",
    "BagMotion": "odometry of a ROS bag",
}
"""Class of a source -> what it is."""

_CONTENT = {
    "image": "images",
    "velocity": "motion",
    "walls": "walls",
    "ranges": "ranges",
    "landmarks": "landmarks",
    "heading_rad": "compass heading",
    "truth": "true poses",
}
"""Field of a frame -> what it holds."""


@dataclass
class Survey:
    """What a source holds.

    Attributes:
        source: Its name.
        kind: What it is.
        topics: Topics of a bag that are read.
        content: What its frames hold, of the first frames.
        image_size_px: Width and height of its images; ``None``: it has none.
        colour: Whether the images have three channels as they reach the brain.
        frames: Number of frames in the range; ``None``: unknown before it is read to its end.
        rate_hz: Frames per second; ``None``: unknown.
        first_s: Time of the first frame of the range.
        last_s: Time of the last one; ``None``: unknown before it is read to its end.
        exact: Whether the last time is that of a frame, and not computed from count and rate.
        file_bytes: Size of its file; ``None``: it is no single file.
        live: Whether it is live.
        parts: The two sources of one that is merged by time.
        notes: How it is read, where that was a choice: topics and their candidates, units.
    """

    source: str
    kind: str
    topics: list[str] = field(default_factory=list)
    content: list[str] = field(default_factory=list)
    image_size_px: tuple[int, int] | None = None
    colour: bool = False
    frames: int | None = None
    rate_hz: float | None = None
    first_s: float | None = None
    last_s: float | None = None
    exact: bool = False
    file_bytes: int | None = None
    live: bool = False
    parts: list["Survey"] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return vars(self) | {"parts": [part.to_dict() for part in self.parts]}

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield names and values for a table."""
        yield "kind", self.kind
        if self.topics:
            yield "topics", ", ".join(self.topics)
        if self.content:
            yield "content", ", ".join(self.content)
        if self.image_size_px:
            width, height = self.image_size_px
            yield "image size", f"{width} x {height} px, {'colour' if self.colour else 'grey'}"
        if self.file_bytes is not None:
            yield "file size", f"{self.file_bytes / 1e6:.1f} MB"
        for part in self.parts:
            for name, value in part.rows():
                yield f"{part.kind}: {name}", value
        unknown = "unknown, it is live" if self.live else "unknown before it is read to its end"
        yield "frames", unknown if self.frames is None else f"{self.frames:,}"
        yield "rate", "unknown" if self.rate_hz is None else f"{self.rate_hz:.4g} Hz"
        yield "first time", "unknown" if self.first_s is None else time_text(self.first_s)
        if self.last_s is None:
            yield "last time", unknown
        else:
            yield "last time", f"{'' if self.exact else 'about '}{time_text(self.last_s)}"
            if self.first_s is not None:
                yield "duration", f"{self.last_s - self.first_s:,.1f} s"


def survey(
    source: str,
    config: BrainConfig | None = None,
    *,
    start: int = 0,
    stop: int | None = None,
) -> Survey:
    """Describe what a run of a source would read; nothing is written.

    The first frames are read, and the last one where a source can be read at any index; a live
    source is opened and no frame of it is read.

    Args:
        source: Source that :func:`neuroslam.sensors.open_source` opens.
        config: Config of the run; default: the default config.
        start: First frame.
        stop: Frame to stop before; default: the end.

    Raises:
        SourceError: If the source cannot be opened.
        RunError: If the range holds no frame.

    Example:
        >>> found = survey("world:corridor?laps=1", stop=200)
        >>> found.kind, found.frames, found.image_size_px, found.content
        ('rendered world', 200, (160, 80), ['images', 'motion', 'true poses'])
    """
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    config = config or BrainConfig()
    opened = open_source(source, config.frame_rate_hz, config.view.grey)
    if opened.n_frames is not None and start >= opened.n_frames:
        raise RunError(
            f"{source}: has {counted(opened.n_frames, 'frame')}, none from --start {start} on"
        )
    found = _described(opened, start, stop)
    found.source = source
    found.file_bytes = _file_bytes(source)
    return found


def unit_and_measure(found: Survey, config: BrainConfig) -> str:
    """Return the unit of lengths on the map of a run: ``m`` if motion is measured.

    Example:
        >>> unit_and_measure(Survey("drive.avi", "video", content=["images"]), BrainConfig())
        'arbitrary unit'
    """
    if not found.content:
        return "unknown, it is live"
    measured = "motion" in found.content and config.odometry.use != "visual"
    return unit_of(measured)


def _described(source: Source, start: int, stop: int | None) -> Survey:
    if isinstance(source, Shifted):
        return _described(source.source, start, stop)
    found = Survey(source.name, _kind(source), live=source.live, notes=list(source.notes))
    if isinstance(source, Streams):
        found.parts = [_described(part, 0, None) for part in (source.camera, source.motion)]
    if isinstance(source, BagCamera | BagMotion):
        found.topics = list(source.topics)
    end = min((n for n in (stop, source.n_frames) if n is not None), default=None)
    found.frames = None if end is None or source.n_frames is None else end - start
    found.rate_hz = source.frame_rate_hz
    if source.live:
        return found
    some = list(islice(source.frames(start, end, lambda _: None), EXAMINED))
    if not some:
        raise RunError(f"{source.name}: no usable frame")
    _note_content(found, some)
    found.first_s = some[0].time_s
    if found.rate_hz is None and len(some) > 1:
        period_s = statistics.median(b.time_s - a.time_s for a, b in pairwise(some))
        found.rate_hz = 1.0 / period_s if period_s > 0.0 else None
    _note_end(found, source, some, start, end)
    found.notes = list(source.notes)  # complete once frames were read
    return found


def _note_content(found: Survey, some: list[Frame]) -> None:
    there = [name for name in _CONTENT if any(getattr(one, name) is not None for one in some)]
    found.content = [_CONTENT[name] for name in there]
    image = next((one.image for one in some if one.image is not None), None)
    if image is not None:
        found.image_size_px = image.shape[1], image.shape[0]
        found.colour = image.ndim == 3


def _note_end(
    found: Survey, source: Source, some: list[Frame], start: int, end: int | None
) -> None:
    """Note the last time: of the last frame that is usable, or by count and rate."""
    if end is not None and len(some) < EXAMINED and some[-1].index == end - 1:
        found.last_s, found.exact = some[-1].time_s, True
        return
    if isinstance(source, IndexedSource):
        final = source.n_frames if end is None else end
        for index in range(final - 1, start - 1, -1):
            last = next(source.frames(index, index + 1, lambda _: None), None)
            if last is not None:
                found.last_s, found.exact = last.time_s, True
                return
    if isinstance(source, Streams):
        ends = [part.last_s for part in found.parts]
        known = [one for one in ends if one is not None]
        if len(known) == len(ends):
            found.last_s = min(known)
        return
    if isinstance(source, BagCamera | BagMotion) and source.span_s and end == source.n_frames:
        found.last_s = source.span_s[1]
        n = source.n_frames or 0
        length_s = source.span_s[1] - source.span_s[0]
        found.rate_hz = (n - 1) / length_s if n > 1 and length_s > 0.0 else found.rate_hz
        return
    if found.frames and found.rate_hz and found.first_s is not None:
        found.last_s = found.first_s + (found.frames - 1) / found.rate_hz


def _kind(source: Source) -> str:
    if isinstance(source, WithSightings):
        return f"{_kind(source.source)}, with sightings of landmarks"
    if isinstance(source, Streams):
        return f"{_kind(source.camera)} and {_kind(source.motion)}, merged by time"
    if isinstance(source, Shifted):
        return _kind(source.source)
    names = (cls.__name__ for cls in type(source).__mro__)
    return next((_KINDS[name] for name in names if name in _KINDS), type(source).__name__)


def _file_bytes(spec: str) -> int | None:
    name = split_offset(spec)[0]
    if parts := pair_of(spec):
        sizes = [_file_bytes(part) for part in parts]
        return sum(one for one in sizes if one is not None) if any(sizes) else None
    path = Path(name)
    if not path.exists() and is_bag(Path(name.partition("?")[0])):
        path = Path(name.partition("?")[0])
    return path.stat().st_size if path.is_file() else None
