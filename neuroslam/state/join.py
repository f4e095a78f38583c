"""How ids and coordinates of one session become those of another when their maps merge."""

from typing import NamedTuple, Self

import numpy as np

from neuroslam.geometry import move_points, wrap_angle, wrap_angles
from neuroslam.types import Pose


class MovedCells(NamedTuple):
    """How a partial session moves on the torus of the pose cells.

    Attributes:
        shift: In cells along x, y and theta, ``(3,)``.
        views: Where partial views are bound then, x, y, theta in cells, ``(n_views, 3)``.
        experiences: The same of the partial experiences, ``(n_experiences, 3)``.
    """

    shift: np.ndarray
    views: np.ndarray
    experiences: np.ndarray


class Join(NamedTuple):
    """How ids and coordinates of a partial map become those of the map it is merged into.

    Attributes:
        views: Partial view id -> merged view id, ``(n_views,)``.
        experiences: Partial experience id -> merged experience id, ``(n_experiences,)``.
        view_turns_rad: Heading with which a partial view was learnt, minus that of the merged
            view, ``(n_views,)``; 0 where the view is kept.
        turns_rad: The same of the partial experiences' headings, ``(n_experiences,)``.
        n_views: Views of the loaded map: kept partial views follow them.
        n_experiences: Experiences of the loaded map.
        torus: ``(n_x, n_y, n_theta)`` of the pose cells.
        cell_shift: By how many cells the activity moves along x, y and theta.
        view_cells: Where partial views are bound then, x, y, theta in cells, ``(n_views, 3)``.
        experience_cells: The same of the partial experiences, ``(n_experiences, 3)``.
        pivot: Pose of the matched experience in the partial map.
        onto: Pose that it takes in the merged map.
        cells: The same two poses in the frames of cells that keep positions themselves, where
            those are not the maps'.
    """

    views: np.ndarray
    experiences: np.ndarray
    view_turns_rad: np.ndarray
    turns_rad: np.ndarray
    n_views: int
    n_experiences: int
    torus: tuple[int, int, int]
    cell_shift: tuple[float, float, float]
    view_cells: np.ndarray
    experience_cells: np.ndarray
    pivot: Pose
    onto: Pose
    cells: tuple[Pose, Pose] | None = None

    @classmethod
    def nothing(cls) -> Self:
        """Return the join of two sessions without views or experiences, in one frame."""
        ids, here = np.empty(0, dtype=np.int64), Pose(0.0, 0.0, 0.0)
        none, cells = np.empty(0), np.empty((0, 3))
        return cls(ids, ids, none, none, 0, 0, (1, 1, 1), (0.0, 0.0, 0.0), cells, cells, here, here)

    @property
    def rotation_rad(self) -> float:
        """By how much the partial map turns."""
        return wrap_angle(self.onto.theta_rad - self.pivot.theta_rad)

    @property
    def kept_views(self) -> np.ndarray:
        """Ids of the partial views that are new in the merged map, in order."""
        return np.flatnonzero(self.views >= self.n_views)

    @property
    def kept_experiences(self) -> np.ndarray:
        """Ids of the partial experiences that are new in the merged map, in order."""
        return np.flatnonzero(self.experiences >= self.n_experiences)

    def place(self, poses: np.ndarray) -> np.ndarray:
        r"""Move partial poses into the loaded map; the pivot comes to lie exactly ``onto``.

        .. math:: x' = R(\Delta\theta)\,(x - x_z) + x_u, \quad
                  \theta' = (\theta - \theta_z) + \theta_u

        (Multisession RatSLAM, Eqs. 13 and 14; Eq. 14 is misprinted there, this is what its
        program does.)

        Args:
            poses: x, y in metres and heading in radians, ``(n, 3)``.

        Example:
            >>> none, torus = np.empty(0, dtype=np.int64), (9, 9, 9)
            >>> pivot, onto = Pose(1.0, 0.0, 0.0), Pose(5.0, 5.0, np.pi / 2)
            >>> join = Join(*[none] * 4, 0, 0, torus, (0, 0, 0), *[none] * 2, pivot, onto)
            >>> join.place(np.array([[2.0, 0.0, 0.0]])).round(9).tolist()
            [[5.0, 6.0, 1.570796327]]
        """
        turned = wrap_angles(poses[:, 2] - self.pivot.theta_rad + self.onto.theta_rad)
        return np.column_stack([move_points(poses[:, :2], self.pivot, self.onto), turned])

    @property
    def cells_turn_rad(self) -> float:
        """By how much positions turn that partial cells keep."""
        pivot, onto = self.cells or (self.pivot, self.onto)
        return wrap_angle(onto.theta_rad - pivot.theta_rad)

    def place_cells(self, points_m: np.ndarray) -> np.ndarray:
        """Move positions that partial cells keep, ``(n, 2)``, into the loaded cells' frame."""
        return move_points(points_m, *(self.cells or (self.pivot, self.onto)))
