"""What the semantic cells of a brain are told in a frame, and what they say."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.sensors.frames import checked_array

NAMED, VIEW, NAMELESS = 0, 1, 2
"""Kinds of landmarks: with a number of its own, a known view, told apart by place alone."""

_LARGEST_NUMBER = 2.0**53  # from there on not every whole number is a float64

LEAST_SEEN = 3
"""Times that a landmark was seen, before it counts: outliers are seen once."""


class Sightings(NamedTuple):
    """Landmarks in sight at one instant, ``(n,)`` each.

    Attributes:
        kind: ``NAMED``, ``VIEW`` or ``NAMELESS``.
        number: Its own number; of nameless ones it does not count.
        distance_m: From the robot.
        bearing_rad: Relative to the heading.
    """

    kind: np.ndarray
    number: np.ndarray
    distance_m: np.ndarray
    bearing_rad: np.ndarray

    @classmethod
    def of(cls, *tables: np.ndarray) -> "Sightings":
        """Take number, distance and bearing of landmarks, ``(n, 3)`` of each sensor.

        One with a name that several tell is taken from the first of them.

        Raises:
            BadFrame: If the rows cannot be that.

        Example:
            >>> Sightings.of(np.array([[7.0, 2.0, 0.1]])).with_view(3).kind.tolist()
            [0, 1]
        """
        rows = np.concatenate((np.empty((0, 3)), *map(checked_landmarks, tables)))
        first = np.unique(rows[:, 0], return_index=True)[1]
        once = rows[:, 0] < 0  # nameless ones are told apart by their places
        once[first] = True
        rows = rows[once]
        kind = np.where(rows[:, 0] < 0, NAMELESS, NAMED)
        return cls(kind, rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 2])

    def with_view(self, view: int) -> "Sightings":
        """Add a known view: a landmark at which the robot stands when it sees it."""
        row = (VIEW, view, 0.0, 0.0)
        return Sightings(*(np.append(column, x) for column, x in zip(self, row, strict=True)))


def checked_landmarks(landmarks: object) -> np.ndarray:
    """Return the landmarks of a frame, if a sensor can have seen them.

    Args:
        landmarks: Number (below 0: it has no name), distance (m) and bearing (rad) of each,
            ``(n, 3)``.

    Returns:
        The same, ``float64``.

    Raises:
        BadFrame: If they have another shape or type, a distance is negative, a number is not
            whole, or something is not finite.

    Example:
        >>> checked_landmarks([[1.5, 2.0, 0.1]])  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: a landmark has the number 1.5; expected a whole number below ...
    """
    rows = checked_array(landmarks, "landmarks", (None, 3), "number, distance, bearing")
    if not np.isfinite(rows).all() or (rows[:, 1] < 0).any():
        raise BadFrame("a landmark's distance or bearing is negative or not a number; drop it")
    number = rows[:, 0]
    wrong = np.flatnonzero((number != np.floor(number)) | (np.abs(number) >= _LARGEST_NUMBER))
    if len(wrong):
        raise BadFrame(
            f"a landmark has the number {number[wrong[0]]:g}; expected a whole number below 2**53"
        )
    return rows


class LandmarkUpdate(NamedTuple):
    """What the semantic cells say after a frame.

    Attributes:
        correction_m: By how much landmarks corrected the position just now.
        turn_rad: And the heading.
        place_m: Where a known landmark puts the robot; ``None``: no other than a moment ago.
        variance_m2: How sure the robot was of its place when it learnt that landmark.
        landmark: Row of the landmark that is attended to, or -1.
        is_new: It is seen for the first time.
        lost: A known landmark contradicts for long; the robot is where ``place_m`` says.
    """

    correction_m: tuple[float, float]
    turn_rad: float
    place_m: tuple[float, float] | None
    variance_m2: float
    landmark: int
    is_new: bool
    lost: bool
