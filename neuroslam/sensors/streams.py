"""Sensors that run at rates of their own, merged by their times."""

import math
from collections.abc import Callable, Iterator

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.source import IndexedSource, OnBadFrame, Source
from neuroslam.types import Frame

SAME_TIME_S = 1e-6
"""Times nearer than this are one: rounding, not two instants."""

_SENSED = ("ranges", "walls", "heading_rad", "landmarks", "truth")


class Streams(Source):
    """A camera and a source of motion as one: a frame at every time of either.

    A measured motion holds over the interval that ends at its time, so each frame has the motion
    since the frame before it, and distance and turn are those of the motion source, whatever the
    two rates are. Pictures come at the times of the camera. Ranges, walls, heading, landmarks and
    truth are those of the motion source's nearest sample, or else of the camera's, if one is
    within half of its period. Frames are delivered from the first to the last time that both
    have, and ``unused`` says how many pictures are not among them; no more than three samples of
    each are held.

    Args:
        camera: The source with pictures; its motion is not used. If it has none and ``motion``
            has, they change places.
        motion: The source with motion.

    Raises:
        SourceError: If there are no pictures or no motion, or the two do not overlap in time, as
            far as can be told without reading on; else reading says so.

    Example:
        >>> from neuroslam.worlds.world import open_world
        >>> camera = open_world("world:corridor?laps=0.01&rate=10")
        >>> wheels = open_world("world:corridor?laps=0.01&rate=20&odometry=true")
        >>> frames = list(Streams(camera, wheels))
        >>> [(f.time_s, f.image is not None) for f in frames[:3]]
        [(0.0, True), (0.05, False), (0.1, True)]
    """

    def __init__(self, camera: Source, motion: Source) -> None:
        first, second = _first_frame(camera), _first_frame(motion)
        if first.image is None and second.image is not None:
            camera, motion, first, second = motion, camera, second, first
        self.name = f"{camera.name}+{motion.name}"
        if first.image is None:
            raise SourceError(f"{self.name}: neither has pictures; expected a camera and motion")
        if second.velocity is None:
            raise SourceError(
                f"{self.name}: {motion.name} has no motion; expected one with speed and turn rate"
            )
        self.camera, self.motion = camera, motion
        self.n_frames = None
        self.frame_rate_hz = None
        self.live = camera.live or motion.live
        spans = [_span(camera, first), _span(motion, second)]
        if max(span[0] for span in spans) > min(span[1] for span in spans) + SAME_TIME_S:
            raise self._apart(*spans)

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`.

        The ones before ``start`` are read and dropped, and their faults with them.
        """
        index = 0

        def report(fault: BadFrame) -> None:
            if index < start:
                return
            if on_bad_frame is None:
                raise fault
            on_bad_frame(fault)

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
            raise SourceError(f"{self.name}: {empty.name} has no frame that can be used")
        begin_s = max(camera.next.time_s, motion.next.time_s)
        starts = camera.next.time_s, motion.next.time_s
        passed = 0
        for cursor in (camera, motion):
            while cursor.next is not None and cursor.next.time_s < begin_s - SAME_TIME_S:
                cursor.advance()
                passed += cursor is camera
        if camera.next is None or motion.next is None:
            for cursor in (camera, motion):
                while cursor.next is not None:
                    cursor.advance()
            raise self._apart((starts[0], camera.last.time_s), (starts[1], motion.last.time_s))
        self.unused = _left_out("begins", begin_s, passed, "before") if passed else ()
        while camera.next is not None and motion.next is not None:
            time_s = min(camera.next.time_s, motion.next.time_s)
            moved = motion.next.time_s <= time_s + SAME_TIME_S
            seen = camera.next.time_s <= time_s + SAME_TIME_S
            # The motion's own time where they are one, so that its intervals stay what they are.
            time_s = motion.next.time_s if moved else time_s
            near = [frame for frame in (motion.near(time_s), camera.near(time_s)) if frame]
            sensed = {
                field: next((v for v in (getattr(f, field) for f in near) if v is not None), None)
                for field in _SENSED
            }
            yield Frame(
                0,
                time_s,
                image=camera.next.image if seen else None,
                velocity=motion.next.velocity,
                **sensed,
            )
            if moved:
                motion.advance()
            if seen:
                camera.advance()
        if camera.next is not None:
            n = None if camera.n_frames is None else camera.n_frames - camera.next.index
            self.unused += _left_out("ends", motion.last.time_s, n, "after")

    def _apart(self, *spans: tuple[float, float]) -> SourceError:
        said = (
            f"{source.name} runs from {low:g} to {high:g} s"
            for source, (low, high) in zip((self.camera, self.motion), spans, strict=True)
        )
        return SourceError(f"{' and '.join(said)}; expected an overlap: are their clocks the same?")


class _Cursor:
    """A source read one frame ahead: the ``last`` frame passed, and the ``next``."""

    def __init__(self, source: Source, report: Callable[[BadFrame], None]) -> None:
        self.name, self.n_frames = source.name, source.n_frames
        self.half_period_s = 0.5 / source.frame_rate_hz if source.frame_rate_hz else math.inf
        self.report = report
        self.frames = source.frames(on_bad_frame=report)
        self.last: Frame | None = None
        self.next = next(self.frames, None)

    def advance(self) -> None:
        """Go to the next frame whose time is later."""
        self.last = self.next
        for frame in self.frames:
            if frame.time_s > self.last.time_s:
                self.next = frame
                return
            self.report(
                BadFrame(
                    f"{self.name}: frame {frame.index}: its time {frame.time_s:g} s is not after "
                    f"{self.last.time_s:g} s; times must rise"
                )
            )
        self.next = None

    def near(self, time_s: float) -> Frame | None:
        """Return the nearest frame, if it is within half a period."""
        gaps = [
            (abs(frame.time_s - time_s), frame.time_s, frame)
            for frame in (self.next, self.last)
            if frame is not None
        ]
        gap_s, _, frame = min(gaps, key=lambda gap: gap[:2])
        return frame if gap_s <= self.half_period_s + SAME_TIME_S else None


def _left_out(what: str, time_s: float, n: int | None, where: str) -> tuple[str]:
    pictures = (
        f"the pictures {where} it were"
        if n is None
        else (counted(n, f"picture {where} it was", f"pictures {where} it were"))
    )
    return (f"motion {what} at {round(time_s, 2):.12g} s; {pictures} not used",)


def _first_frame(source: Source) -> Frame:
    first = next(source.frames(on_bad_frame=lambda _: None), None)
    if first is None:
        raise SourceError(f"{source.name}: has no frame that can be used")
    return first


def _span(source: Source, first: Frame) -> tuple[float, float]:
    """Return the first time of a source and the last, or a bound where only reading would tell."""
    if isinstance(source, IndexedSource):
        for index in range(source.n_frames - 1, first.index, -1):
            last = next(source.frames(index, index + 1, lambda _: None), None)
            if last is not None:
                return first.time_s, last.time_s
        return first.time_s, first.time_s
    if source.n_frames is None or not source.frame_rate_hz:
        return first.time_s, math.inf
    return first.time_s, first.time_s + source.n_frames / source.frame_rate_hz
