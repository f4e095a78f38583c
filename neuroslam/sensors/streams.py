"""Merges a camera and a source of motion of different rates by their times."""

import math
from collections.abc import Callable, Iterator
from typing import Any

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.source import IndexedSource, OnBadFrame, Source
from neuroslam.sensors.tracks import time_text
from neuroslam.types import Frame

SAME_TIME_S = 1e-6
"""Times that differ by less are equal up to rounding."""

_SAMPLED = ("ranges", "walls", "heading_rad", "landmarks", "truth")


class Streams(Source):
    """A camera and a source of motion as one source, with a frame at every time of either.

    A measured motion holds over the interval that ends at its time, so each frame has the motion
    since the frame before it: total distance and turn are those of the motion source, whatever the
    two rates are. Images have the times of the camera. Ranges, walls, heading, landmarks and truth
    are those of the motion source's nearest sample, or else of the camera's nearest, if it is
    within half a period. Frames begin when both sources have begun and end with the first that
    ends; ``unused`` counts the images outside this interval. At most three samples of each source
    are in memory.

    Args:
        camera: Source of images; its motion is not used. If it has no images and ``motion`` has,
            the two are exchanged.
        motion: Source of motion.
        offset_s: Seconds to add to the times of the motion, where the two clocks differ.

    Raises:
        SourceError: If there are no images or no motion, or the two do not overlap in time. An
            overlap that is only known after reading is checked during reading.

    Example:
        >>> from neuroslam.worlds.world import open_world
        >>> camera = open_world("world:corridor?laps=0.01&rate=10")
        >>> wheels = open_world("world:corridor?laps=0.01&rate=20&odometry=true")
        >>> frames = list(Streams(camera, wheels))
        >>> [(f.time_s, f.image is not None) for f in frames[:3]]
        [(0.0, True), (0.05, False), (0.1, True)]
    """

    def __init__(self, camera: Source, motion: Source, offset_s: float = 0.0) -> None:
        first, second = _first_frame(camera), _first_frame(motion)
        if first.image is None and second.image is not None:
            camera, motion, first, second = motion, camera, second, first
        self.name = f"{camera.name}+{motion.name}"
        if first.image is None:
            raise SourceError(
                f"{self.name}: neither source has images; expected a camera and a source of motion"
            )
        if second.velocity is None:
            raise SourceError(
                f"{self.name}: {motion.name} has no motion; expected speed and turn rate"
            )
        if offset_s:
            motion, second = (
                Shifted(motion, offset_s),
                second._replace(time_s=second.time_s + offset_s),
            )
        self.camera, self.motion = camera, motion
        self.n_frames = None
        self.frame_rate_hz = None
        self.live = camera.live or motion.live
        self.landmark_words = motion.landmark_words or camera.landmark_words
        spans = [_span(camera, first), _span(motion, second)]
        if max(span[0] for span in spans) > min(span[1] for span in spans) + SAME_TIME_S:
            raise self._no_overlap(*spans)

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """The notes of both sources."""
        return (*self.motion.notes, *self.camera.notes)

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`.

        The frames before ``start`` are read and dropped, together with their errors.
        """
        index = 0

        def report(error: BadFrame) -> None:
            if index < start:
                return
            if on_bad_frame is None:
                raise error
            on_bad_frame(error)

        if stop is not None and stop <= max(start, 0):
            return
        for frame in self._merged(report):
            if index >= start:
                yield frame._replace(index=index)
            index += 1
            if stop is not None and index >= stop:
                return

    def _merged(self, report: Callable[[BadFrame], None]) -> Iterator[Frame]:
        camera, motion = _Cursor(self.camera, report), _Cursor(self.motion, report)
        if camera.next is None or motion.next is None:
            empty = self.camera if camera.next is None else self.motion
            raise SourceError(
                f"{self.name}: {empty.name} has no usable frame; expected at least one"
            )
        starts = camera.next.time_s, motion.next.time_s
        begin_s = max(starts)
        skipped = 0
        for cursor in (camera, motion):
            while cursor.next is not None and cursor.next.time_s < begin_s - SAME_TIME_S:
                cursor.advance()
                skipped += cursor is camera
        if camera.next is None or motion.next is None:
            for cursor in (camera, motion):
                while cursor.next is not None:
                    cursor.advance()
            raise self._no_overlap((starts[0], camera.last_s), (starts[1], motion.last_s))
        self.unused = _unused("begins", begin_s, skipped, "before") if skipped else ()
        while camera.next is not None and motion.next is not None:
            time_s = min(camera.next.time_s, motion.next.time_s)
            has_motion = motion.next.time_s <= time_s + SAME_TIME_S
            has_image = camera.next.time_s <= time_s + SAME_TIME_S
            # Of two equal times that of the motion, so that its intervals keep their lengths.
            time_s = motion.next.time_s if has_motion else time_s
            near = [frame for frame in (motion.near(time_s), camera.near(time_s)) if frame]
            samples: dict[str, Any] = {
                field: next((v for v in (getattr(f, field) for f in near) if v is not None), None)
                for field in _SAMPLED
            }
            yield Frame(
                0,
                time_s,
                image=camera.next.image if has_image else None,
                velocity=motion.next.velocity,
                turn_rate_rad_s=motion.next.turn_rate_rad_s,
                v_z_m_s=motion.next.v_z_m_s,
                **samples,
            )
            if has_motion:
                motion.advance()
            if has_image:
                camera.advance()
        if camera.next is not None:
            n = None if camera.n_frames is None else camera.n_frames - camera.next.index
            self.unused += _unused("ends", motion.last_s, n, "after")

    def _no_overlap(self, *spans: tuple[float, float]) -> SourceError:
        runs = (
            f"{source.name} runs from {time_text(low)} to {time_text(high)}"
            for source, (low, high) in zip((self.camera, self.motion), spans, strict=True)
        )
        return SourceError(
            f"{' and '.join(runs)}; expected an overlap; check that both use one clock, or give "
            "--offset S, the seconds to add to the times of the motion, or --offset auto"
        )


class Shifted(Source):
    """A source whose times are all later by a constant.

    Args:
        source: The source.
        offset_s: Seconds to add to its times.
    """

    def __init__(self, source: Source, offset_s: float) -> None:
        self.source, self.offset_s = source, offset_s
        self.name, self.n_frames = source.name, source.n_frames
        self.frame_rate_hz, self.live = source.frame_rate_hz, source.live
        self.landmark_words = source.landmark_words

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """The notes of the source, and the offset."""
        added = f"{self.name}: {time_text(self.offset_s)} are added to its times"
        return (*self.source.notes, added)

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        for frame in self.source.frames(start, stop, on_bad_frame):
            yield frame._replace(time_s=frame.time_s + self.offset_s)


class _Cursor:
    """Reads a source one frame ahead: ``last`` is the present frame, ``next`` the one after it."""

    def __init__(self, source: Source, report: Callable[[BadFrame], None]) -> None:
        self.name, self.n_frames = source.name, source.n_frames
        self.half_period_s = 0.5 / source.frame_rate_hz if source.frame_rate_hz else math.inf
        self.report = report
        self.frames = source.frames(on_bad_frame=report)
        self.last: Frame | None = None
        self.next = next(self.frames, None)

    @property
    def last_s(self) -> float:
        """Time of the last frame; -inf before the first."""
        return -math.inf if self.last is None else self.last.time_s

    def advance(self) -> None:
        """Go to the next frame with a later time."""
        self.last = self.next
        for frame in self.frames:
            if frame.time_s > self.last_s:
                self.next = frame
                return
            self.report(
                BadFrame(
                    f"{self.name}: frame {frame.index}: its time {time_text(frame.time_s)} is not "
                    f"after {time_text(self.last_s)}; times must rise"
                )
            )
        self.next = None

    def near(self, time_s: float) -> Frame | None:
        """Return the frame nearest in time, if it is within half a period."""
        gaps = [
            (abs(frame.time_s - time_s), frame.time_s, frame)
            for frame in (self.next, self.last)
            if frame is not None
        ]
        gap_s, _, frame = min(gaps, key=lambda gap: gap[:2])
        return frame if gap_s <= self.half_period_s + SAME_TIME_S else None


def _unused(event: str, time_s: float, n: int | None, side: str) -> tuple[str]:
    images = (
        f"the images {side} it were"
        if n is None
        else counted(n, f"image {side} it was", f"images {side} it were")
    )
    return (f"motion {event} at {time_text(time_s)}; {images} not used",)


def _first_frame(source: Source) -> Frame:
    first = next(source.frames(on_bad_frame=lambda _: None), None)
    if first is None:
        raise SourceError(f"{source.name}: has no usable frame; expected at least one")
    return first


def _span(source: Source, first: Frame) -> tuple[float, float]:
    """Return the first and last time of a source; the last is a bound if it is not yet known."""
    if isinstance(source, Shifted):
        first = first._replace(time_s=first.time_s - source.offset_s)
        low, high = _span(source.source, first)
        return low + source.offset_s, high + source.offset_s
    if isinstance(source, IndexedSource):
        for index in range(source.n_frames - 1, first.index, -1):
            last = next(source.frames(index, index + 1, lambda _: None), None)
            if last is not None:
                return first.time_s, last.time_s
        return first.time_s, first.time_s
    if source.n_frames is None or not source.frame_rate_hz:
        return first.time_s, math.inf
    return first.time_s, first.time_s + source.n_frames / source.frame_rate_hz
