"""What the semantic cells of a brain are told in a frame, and what they say."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import BadFrame

NAMED, VIEW, NAMELESS = 0, 1, 2
"""Kinds of landmarks: with a number of its own, a known view, told apart by place alone."""

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
        tables = tuple(np.asarray(rows, dtype=np.float64) for rows in tables)
        for rows in tables:
            if rows.ndim != 2 or rows.shape[1] != 3:
                raise BadFrame(
                    f"landmarks have shape {rows.shape}; expected (n, 3): number, distance, bearing"
                )
        rows = np.concatenate((np.empty((0, 3)), *tables))
        if not np.isfinite(rows).all() or (rows[:, 1] < 0).any():
            raise BadFrame("a landmark's distance or bearing is negative or not a number; drop it")
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
