"""Input and output of the semantic cells: landmarks in sight, and corrections by them."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.sensors.frames import checked_array

NAMED, VIEW, NAMELESS = 0, 1, 2
"""Kinds of landmarks: with a number; a view; without a number, identified by position."""

_LARGEST_NUMBER = 2.0**53  # from there on not every whole number is a float64

LEAST_SEEN = 3
"""Number of sightings that confirm a landmark: outliers are seen once."""


class Sightings(NamedTuple):
    """Landmarks in sight at one instant, ``(n,)`` each.

    Attributes:
        kind: ``NAMED``, ``VIEW`` or ``NAMELESS``.
        number: Number of the landmark; ignored for nameless ones.
        distance_m: Distance from the robot.
        bearing_rad: Relative to the heading.
    """

    kind: np.ndarray
    number: np.ndarray
    distance_m: np.ndarray
    bearing_rad: np.ndarray

    @classmethod
    def of(cls, *tables: np.ndarray) -> "Sightings":
        """Make sightings of number, distance and bearing of landmarks, ``(n, 3)`` for each sensor.

        A numbered landmark seen by several sensors is taken from the first.

        Raises:
            BadFrame: If a row is invalid.

        Example:
            >>> Sightings.of(np.array([[7.0, 2.0, 0.1]])).with_view(3).kind.tolist()
            [0, 1]
        """
        rows = np.concatenate((np.empty((0, 3)), *map(checked_landmarks, tables)))
        first = np.unique(rows[:, 0], return_index=True)[1]
        once = rows[:, 0] < 0  # nameless ones are all kept
        once[first] = True
        rows = rows[once]
        kind = np.where(rows[:, 0] < 0, NAMELESS, NAMED)
        return cls(kind, rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 2])

    def with_view(self, view: int) -> "Sightings":
        """Add a view: a landmark at the robot's own position."""
        row = (VIEW, view, 0.0, 0.0)
        return Sightings(*(np.append(column, x) for column, x in zip(self, row, strict=True)))


def checked_landmarks(landmarks: object) -> np.ndarray:
    """Return the landmarks of a frame as ``float64``, after checking them.

    Args:
        landmarks: Number (below 0: it has no name), distance (m) and bearing (rad) of each,
            ``(n, 3)``.

    Returns:
        Array of shape ``(n, 3)``.

    Raises:
        BadFrame: If they have another shape or type, a distance is negative, a number is not
            whole, or a value is not finite.

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
            f"a landmark has the number {number[wrong[0]]}; expected a whole number below 2**53"
        )
    return rows


class LandmarkUpdate(NamedTuple):
    """Correction by landmarks in a frame.

    Attributes:
        correction_m: Correction of the position.
        turn_rad: Correction of the heading.
        place_m: Position of the robot implied by a known landmark; ``None``: no new one.
        variance_m2: Variance of the robot's position when it learnt that landmark.
        landmark: Row of the attended landmark, or -1.
        is_new: Whether it is seen for the first time.
        lost: Known landmarks contradicted for long: the robot relocalises at ``place_m``.
    """

    correction_m: tuple[float, float]
    turn_rad: float
    place_m: tuple[float, float] | None
    variance_m2: float
    landmark: int
    is_new: bool
    lost: bool
