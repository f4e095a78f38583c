"""Merges images and odometry that arrive one by one, as :mod:`neuroslam.sensors.streams` does."""

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.sensors.streams import SAME_TIME_S
from neuroslam.types import Pose, Velocity


class Instant(NamedTuple):
    """What the sensors say at one time.

    Attributes:
        time_s: The time.
        image: Picture of this time.
        velocity: Motion over the interval that ends then.
        ranges: Of the nearest sample of odometry.
        odometry: Pose in the frame of odometry, if it is of this time.
    """

    time_s: float
    image: np.ndarray | None = None
    velocity: Velocity | None = None
    ranges: np.ndarray | None = None
    odometry: Pose | None = None


class MessageStreams:
    """Orders images and odometry by time, and yields an instant for every time of either.

    An instant of a picture waits for the odometry of the interval in which it was taken, that of
    odometry for the next picture, so that none comes later. A recording gives the same instants as
    the frames of :class:`~neuroslam.sensors.streams.Streams`. If one sensor lags behind the other
    by more than ``lag_s`` of their times, the other goes on without it.

    Args:
        images: Whether there is a camera.
        odometry: Whether there is odometry.
        lag_s: Seconds of the longest wait.

    Example:
        >>> streams = MessageStreams()
        >>> streams.add_image(0.0, np.zeros((2, 2), np.uint8))
        >>> streams.add_odometry(0.0, Velocity(1.0, 0.0))
        >>> streams.add_odometry(0.1, Velocity(1.0, 0.0))
        >>> [instant.time_s for instant in streams.ready()]
        [0.0]
        >>> streams.add_image(0.2, np.zeros((2, 2), np.uint8))
        >>> [instant.time_s for instant in streams.ready()]
        [0.1]
    """

    def __init__(self, images: bool = True, odometry: bool = True, lag_s: float = 0.5) -> None:
        self.images, self.odometry, self.lag_s = images, odometry, lag_s
        self._images: deque[Instant] = deque()
        self._motion: deque[Instant] = deque()
        self._begun: dict[str, float] = {}  # time of the first message of each
        self._newest: dict[str, float] = {}
        self._before: Instant | None = None  # last odometry that was used
        self._last_s = -np.inf  # time of the last instant

    def add_image(self, time_s: float, image: np.ndarray) -> None:
        """Add a picture.

        Raises:
            BadFrame: If its time does not rise, or instants after it are out already.
        """
        self._add("image", self._images, Instant(time_s, image=image))

    def add_odometry(
        self,
        time_s: float,
        velocity: Velocity,
        ranges: np.ndarray | None = None,
        pose: Pose | None = None,
    ) -> None:
        """Add a sample of odometry, with the latest scan.

        Raises:
            BadFrame: As :meth:`add_image`.
        """
        self._add("odometry", self._motion, Instant(time_s, None, velocity, ranges, pose))

    def _add(self, kind: str, queue: deque[Instant], instant: Instant) -> None:
        if not np.isfinite(instant.time_s):
            raise BadFrame(f"{kind}: its time is {instant.time_s} s; expected a finite number")
        last_s = max(self._newest.get(kind, -np.inf), self._last_s)
        if not instant.time_s > last_s:
            raise BadFrame(
                f"{kind}: its time {instant.time_s:.6f} s is not after {last_s:.6f} s; it came too "
                "late, or times do not rise"
            )
        self._newest[kind] = instant.time_s
        self._begun.setdefault(kind, instant.time_s)
        queue.append(instant)
        while not self._all_begun and instant.time_s - queue[0].time_s > self.lag_s:
            queue.popleft()  # of no use before the other sensor begins

    @property
    def _all_begun(self) -> bool:
        return len(self._begun) == self.images + self.odometry

    @property
    def missing(self) -> tuple[str, ...]:
        """The sensors of which nothing has come yet."""
        wanted = [("image", self.images), ("odometry", self.odometry)]
        return tuple(kind for kind, used in wanted if used and kind not in self._begun)

    def ready(self) -> Iterator[Instant]:
        """Yield the instants before which nothing else can come."""
        if not self._all_begun:
            return
        begin_s = max(self._begun.values()) - SAME_TIME_S
        for queue in (self._images, self._motion):
            while queue and queue[0].time_s < begin_s:
                dropped = queue.popleft()
                self._before = dropped if queue is self._motion else self._before
        while (instant := self._next()) is not None:
            self._last_s = instant.time_s
            yield instant

    def _next(self) -> Instant | None:
        images, motion = self._images, self._motion
        if images and motion:
            return self._merged(images[0], motion[0])
        alone = images or motion
        other = self.odometry if alone is images else self.images
        if not alone or (other and alone[-1].time_s - alone[0].time_s <= self.lag_s):
            return None
        instant = alone.popleft()
        self._before = instant if alone is motion else self._before
        return instant

    def _merged(self, image: Instant, motion: Instant) -> Instant:
        first_s = min(image.time_s, motion.time_s)
        has_motion = motion.time_s <= first_s + SAME_TIME_S
        has_image = image.time_s <= first_s + SAME_TIME_S
        time_s = motion.time_s if has_motion else first_s
        nearest = motion
        if self._before is not None and time_s - self._before.time_s <= motion.time_s - time_s:
            nearest = self._before
        if has_motion:
            self._before = self._motion.popleft()
        if has_image:
            self._images.popleft()
        return Instant(
            time_s,
            image.image if has_image else None,
            motion.velocity,
            nearest.ranges,
            motion.odometry if has_motion else None,
        )
