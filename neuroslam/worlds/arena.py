"""Arenas seen from above, and their walls as sensed from positions in them.

An outline is ``(n, 2)`` vertices in metres in either sense, the first not repeated, or the three
numbers ``(x, y, radius)`` of a circle.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from neuroslam import compiled as steps
from neuroslam.compiled import compiled
from neuroslam.errors import SourceError, did_you_mean
from neuroslam.geometry import TWO_PI
from neuroslam.worlds.outlines import (
    TOUCH_M,
    bearings_of,
    checked_outline,
    checked_walls,
    cross,
    crossings,
    meet,
    to_segments,
    vertices_of,
    within,
)

_CHUNK = 25_600  # numbers in a temporary array, so that it stays in the cache of a core


class _Blockers(NamedTuple):
    """Obstacles before one face of a wall, in its frame: t along it from the middle, s off it.

    Attributes:
        segments: ``(m, 4)``: lower and upper t; s at t = 0; slope of s.
        circles: ``(m, 3)``: t and s of the centre, radius.
    """

    segments: np.ndarray
    circles: np.ndarray

    def hide(self, t: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return which positions ``(n,)`` have an obstacle between them and their foot."""
        if not len(self.segments) + len(self.circles):
            return np.zeros(len(t), dtype=bool)
        t, s = t[:, None], s[:, None]
        low, high, base, slope = self.segments.T
        at = base + slope * t
        hidden = (t >= low - TOUCH_M) & (t <= high + TOUCH_M)
        hidden &= (at > TOUCH_M) & (at < s - TOUCH_M)
        along, off, radius = self.circles.T
        depth = radius**2 - (t - along) ** 2
        at = off - np.sqrt(np.maximum(depth, 0.0))
        behind = (depth > 0.0) & (at > TOUCH_M) & (at < s - TOUCH_M)
        return np.asarray(hidden.any(axis=1) | behind.any(axis=1))


@compiled
def cast_step(
    points: np.ndarray, headings_rad: np.ndarray, beams_rad: np.ndarray, reach_m: float,
    n_sides: int, normal: np.ndarray, off: np.ndarray, along: np.ndarray, on: np.ndarray,
    circles: np.ndarray, is_round: bool, found: np.ndarray,
) -> None:  # fmt: skip
    """Do as ``Arena._cast`` for the beams of scans; write the ranges, ``(n, beams)``.

    Points and circles are relative to the origin of the frames of walls.
    """
    n_walls = off.shape[0]
    s, t, side = np.empty(n_walls), np.empty(n_walls), np.empty(n_walls)
    for p in range(points.shape[0]):
        x, y = points[p, 0], points[p, 1]
        for w in range(n_walls):
            away = x * normal[0, w] + y * normal[1, w] - off[w]
            t[w] = x * along[0, w] + y * along[1, w] - on[w]
            side[w] = -1.0 if w >= n_sides and away < 0.0 else 1.0  # free walls have two faces
            away *= side[w]
            s[w] = max(away, 0.0) if away >= -TOUCH_M else np.inf
        for b in range(beams_rad.shape[0]):
            angle = headings_rad[p] + beams_rad[b]
            ray_x, ray_y = math.cos(angle), math.sin(angle)
            first = np.inf
            for w in range(n_walls):
                closing = -(normal[0, w] * ray_x + normal[1, w] * ray_y) * side[w]
                if closing > 0.0 and s[w] < np.inf:
                    way = s[w] / closing
                    at = t[w] + way * (along[0, w] * ray_x + along[1, w] * ray_y)
                    if abs(at) <= 1.0 + TOUCH_M and way < first:
                        first = way
            for k in range(circles.shape[0]):
                out_x, out_y, radius = x - circles[k, 0], y - circles[k, 1], circles[k, 2]
                ahead = out_x * ray_x + out_y * ray_y
                q = out_x * out_x + out_y * out_y - radius**2
                if is_round and k == 0:
                    way = math.sqrt(ahead * ahead - min(q, 0.0)) - ahead
                else:
                    root = ahead * ahead - max(q, 0.0)
                    if not (root >= 0.0 and ahead < 0.0):
                        continue
                    way = -ahead - math.sqrt(root)
                if way < first:
                    first = way
            found[p, b] = first if first <= reach_m else np.inf


class Arena:
    """An environment: one outer boundary, holes in it, and free-standing walls.

    The walls are numbered: sides of the boundary, sides of the holes, free-standing walls, then the
    circles, the boundary first. Corners are no walls. Positions should be inside, see
    :meth:`check_inside`; from a position of NaN no wall is visible.

    Args:
        vertices: The boundary, an outline.
        holes: Outlines of areas that cannot be entered; a circular one is a pillar.
        walls: Two ends ``(2, 2)`` of each free-standing wall, which is visible from both sides.
            They may touch the boundary and each other.
        name: Name for messages.

    Raises:
        SourceError: If an outline has fewer than three vertices, a side of length 0, crosses
            itself, or contains NaN; if a radius is not positive; if a hole or a wall crosses the
            boundary or another one, or lies outside.

    Example:
        >>> square = Arena([(0, 0), (1, 0), (1, 1), (0, 1)])
        >>> distance_m, bearing_rad = square.walls_near([(0.9, 0.2)], reach_m=0.3)
        >>> distance_m.round(6).tolist(), np.degrees(bearing_rad).tolist()
        ([[0.2, 0.1, inf, inf]], [[-90.0, 0.0, 0.0, 0.0]])
    """

    def __init__(
        self,
        vertices: ArrayLike,
        holes: Sequence[ArrayLike] = (),
        walls: Sequence[ArrayLike] = (),
        name: str = "arena",
    ) -> None:
        self.name = name
        self.boundary = checked_outline(vertices, f"{name}: the boundary")
        self.holes = [checked_outline(hole, f"{name}: hole {k}") for k, hole in enumerate(holes)]
        self.walls = checked_walls(walls, name)
        # The free side is on the left of every side: boundaries run ccw, holes clockwise.
        around = [] if self.boundary.ndim == 1 else [self.boundary]
        around += [hole[::-1] for hole in self.holes if hole.ndim == 2]
        self._n_sides = sum(len(outline) for outline in around)
        starts = np.concatenate([*around, self.walls[:, 0]]).reshape(-1, 2)
        ends = np.concatenate([*(np.roll(o, -1, 0) for o in around), self.walls[:, 1]])
        self._starts, self._ends = starts, ends.reshape(-1, 2)
        self._middle = (starts + self._ends) / 2
        span = self._ends - starts
        self._half = np.hypot(*span.T) / 2
        self._along = span / (2 * self._half[:, None])
        self._normal = np.column_stack([-self._along[:, 1], self._along[:, 0]])
        self._bearing = bearings_of(-self._normal)
        self._round = self.boundary.ndim == 1
        circles = [outline for outline in (self.boundary, *self.holes) if outline.ndim == 1]
        self._circles = np.array(circles).reshape(-1, 3)
        self._origin = self._circles[0, :2] if self._round else self.boundary.mean(axis=0)
        # One matrix product gives s, the distance off each wall; one t, in half lengths along it.
        at = self._middle - self._origin
        self._off = self._normal.T.copy(), np.sum(at * self._normal, axis=1)
        unit = self._along / self._half[:, None]
        self._on = unit.T.copy(), np.sum(at * unit, axis=1)
        self._check_holes()
        self._check_walls()

    @classmethod
    def circle(
        cls, radius_m: float, centre: tuple[float, float] = (0.0, 0.0), name: str = "circle"
    ) -> Self:
        """Make a circular arena, which has one wall."""
        return cls((*centre, radius_m), name=name)

    @classmethod
    def regular(cls, n_sides: int, radius_m: float, name: str = "polygon") -> Self:
        """Make a regular polygon around the origin; its first corner is at +y.

        Example:
            >>> Arena.regular(4, 1.0).boundary.round(6).tolist()
            [[0.0, 1.0], [-1.0, 0.0], [-0.0, -1.0], [1.0, -0.0]]
        """
        angle = np.pi / 2 + TWO_PI * np.arange(n_sides) / max(n_sides, 1)
        return cls(radius_m * np.column_stack([np.cos(angle), np.sin(angle)]), name=name)

    @classmethod
    def rooms(
        cls,
        n_rooms: int = 2,
        width_m: float = 1.0,
        depth_m: float = 1.0,
        door_m: float = 0.3,
        name: str = "rooms",
    ) -> Self:
        """Make a row of rooms along x, around the origin, with a door in the middle of each wall.

        Raises:
            SourceError: If there is no room, or the door is not narrower than the wall.

        Example:
            >>> Arena.rooms(3).bounds
            (-1.5, 1.5, -0.5, 0.5)
        """
        if n_rooms < 1 or not 0 < door_m < depth_m:
            raise SourceError(
                f"{name}: {n_rooms} rooms {depth_m} m deep with doors of {door_m} m; expected at "
                "least 1 room, and doors wider than 0 and narrower than the rooms are deep"
            )
        x, y = n_rooms * width_m / 2, depth_m / 2
        between = -x + width_m * np.arange(1, n_rooms)
        walls = [[(at, side * y), (at, side * door_m / 2)] for at in between for side in (-1, 1)]
        return cls(_box(2 * x, 2 * y), walls=walls, name=name)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], name: str = "arena") -> Self:
        """Make an arena from the arrays of :meth:`to_arrays`, or of a recording.

        A recording has ``vertices`` or ``arena_radius``; other arrays are ignored.

        Raises:
            SourceError: If there is neither, or they describe no arena.

        Example:
            >>> Arena.from_arrays({"arena_radius": np.array(0.5)}).bounds
            (-0.5, 0.5, -0.5, 0.5)
        """
        if "vertices" in arrays:
            boundary = arrays["vertices"]
        elif "arena_radius" in arrays:
            centre = np.ravel(arrays["arena_centre"]) if "arena_centre" in arrays else (0.0, 0.0)
            boundary = np.append(centre, arrays["arena_radius"])
        else:
            raise SourceError(
                f"{name}: has the arrays {(', '.join(arrays) or 'none')[:100]}; expected vertices "
                "(n, 2) or arena_radius (), in metres"
            )
        holes: list[np.ndarray] = []
        if "hole_vertices" in arrays:
            ends = np.cumsum(np.ravel(arrays["hole_sizes"]))[:-1]
            holes += np.split(np.asarray(arrays["hole_vertices"]), ends)
        holes += list(arrays["pillars"]) if "pillars" in arrays else []
        return cls(boundary, holes, list(arrays["walls"]) if "walls" in arrays else (), name)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return arrays for an ``.npz``, the input of :meth:`from_arrays`.

        Always ``vertices``, or ``arena_radius`` and ``arena_centre``; if there are any,
        ``hole_vertices`` of all holes with ``hole_sizes``, ``pillars`` ``(m, 3)`` and ``walls``
        ``(m, 2, 2)``.
        """
        polygons = [hole for hole in self.holes if hole.ndim == 2]
        pillars = [hole for hole in self.holes if hole.ndim == 1]
        if self._round:
            arrays = {"arena_centre": self.boundary[:2], "arena_radius": self.boundary[2]}
        else:
            arrays = {"vertices": self.boundary}
        if polygons:
            arrays["hole_vertices"] = np.concatenate(polygons)
            arrays["hole_sizes"] = np.array([len(hole) for hole in polygons])
        if pillars:
            arrays["pillars"] = np.array(pillars)
        if len(self.walls):
            arrays["walls"] = self.walls
        return {key: np.array(value) for key, value in arrays.items()}

    @property
    def n_walls(self) -> int:
        """Number of walls, W."""
        return len(self._half) + len(self._circles)

    @cached_property
    def is_convex(self) -> bool:
        """Whether each wall is visible from everywhere: a convex boundary without obstacles."""
        if self.holes or len(self.walls):
            return False
        turn = cross(self._along, np.roll(self._along, -1, 0))
        return self._round or bool(np.all(turn > -1e-12))

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """``(x_min, x_max, y_min, y_max)`` in metres."""
        if self._round:
            x, y, r = self.boundary.tolist()
            return x - r, x + r, y - r, y + r
        (x_min, y_min), (x_max, y_max) = self.boundary.min(axis=0), self.boundary.max(axis=0)
        return float(x_min), float(x_max), float(y_min), float(y_max)

    @property
    def outlines(self) -> list[np.ndarray]:
        """Polylines to draw, ``(n, 2)``: closed boundary and holes, then walls."""
        closed = [vertices_of(outline) for outline in (self.boundary, *self.holes)]
        return [np.vstack([line, line[:1]]) for line in closed] + list(self.walls)

    def contains(self, positions: ArrayLike) -> np.ndarray:
        """Return which positions ``(n, 2)`` are inside or at a wall, ``(n,)`` bool."""
        points = self._points(positions)
        inside = np.empty(len(points), dtype=bool)
        for rows in self._chunks(len(points)):
            inside[rows] = within(points[rows], self.boundary)
            for hole in self.holes:
                inside[rows] &= ~within(points[rows], hole)
        outside = np.flatnonzero(~inside)
        inside[outside] = self._clearance(points[outside], self._n_sides) <= TOUCH_M
        return inside

    def check_inside(self, positions: ArrayLike) -> None:
        """Check that all positions are inside.

        Raises:
            SourceError: If one is outside; the message gives the first.
        """
        outside = np.flatnonzero(~self.contains(positions))
        if len(outside):
            x, y = np.asarray(positions, dtype=np.float64)[outside[0]]
            raise SourceError(
                f"{self.name}: position {outside[0]} is ({x:g}, {y:g}) m, outside the arena, as "
                f"are {len(outside)} of {np.shape(positions)[0]}; expected all to be inside"
            )

    def clearance(self, positions: ArrayLike) -> np.ndarray:
        """Return the distance of positions ``(n, 2)`` to the nearest wall in metres, ``(n,)``."""
        return self._clearance(self._points(positions), len(self._half))

    def _clearance(self, points: np.ndarray, n_straight: int) -> np.ndarray:
        nearest = np.empty(len(points))
        for rows in self._chunks(len(points)):
            s, t = (value[:, :n_straight] for value in self._frames(points[rows]))
            past = np.maximum(np.abs(t) - 1.0, 0.0) * self._half[:n_straight]
            gaps = [np.hypot(s, past), np.abs(self._beyond_circles(points[rows]))]
            nearest[rows] = np.concatenate(gaps, axis=1).min(axis=1)
        return nearest

    def walls_near(self, positions: ArrayLike, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Find the foot of the perpendicular on every wall that is in reach and visible.

        A wall is not visible if the foot lies beyond its ends, from behind (free-standing walls
        have two faces), or if another wall hides the foot. A circle is one wall, at its nearest
        point.

        Args:
            positions: In metres, ``(n, 2)``.
            reach_m: Largest distance of a wall; may be ``inf``.

        Returns:
            Distance in metres, ``(n, W)``, ``inf`` if the wall is not visible, and bearing in the
            world in (-pi, pi], 0 if it is not visible.

        Raises:
            SourceError: If the shapes are wrong or the reach is not positive.

        Example:
            >>> distance_m, bearing_rad = Arena.circle(1.0).walls_near([(0.0, 0.75)], 0.3)
            >>> distance_m.tolist(), np.degrees(bearing_rad).tolist()
            ([[0.25]], [[90.0]])
        """
        points, reach = self._points(positions), self._reach(reach_m)
        distance = np.full((len(points), self.n_walls), np.inf)
        bearing = np.zeros((len(points), self.n_walls))
        n_straight = len(self._half)
        for rows in self._chunks(len(points)):
            s, t = self._frames(points[rows])
            np.abs(s[:, self._n_sides :], out=s[:, self._n_sides :])
            np.abs(t, out=t)
            visible = t <= 1.0
            visible &= s <= reach
            visible &= s >= -TOUCH_M
            # Views of the results, which are written in place.
            near, towards = distance[rows, :n_straight], bearing[rows, :n_straight]
            np.copyto(near, s, where=visible)
            np.maximum(near, 0.0, out=near)
            np.copyto(towards, self._bearing, where=visible)
        for k in range(len(self._circles)):
            self._add_circle(points, reach, k, distance, bearing)
        if not self.is_convex:
            self._remove_hidden(points, distance, bearing)
        return distance, bearing

    def nearest_walls(
        self, positions: ArrayLike, reach_m: float, k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the ``k`` nearest walls of :meth:`walls_near`, nearest first.

        Returns:
            Distance in metres and bearing, ``(n, k)``; ``inf`` and 0 where there are fewer walls.

        Example:
            >>> named_arena("square").nearest_walls([(0.9, -0.8)], 0.3, k=3)[0].round(6).tolist()
            [[0.1, 0.2, inf]]
        """
        distance, bearing = self.walls_near(positions, reach_m)
        if k > self.n_walls:
            wider = ((0, 0), (0, k - self.n_walls))
            distance = np.pad(distance, wider, constant_values=np.inf)
            bearing = np.pad(bearing, wider)
        order = np.argsort(distance, axis=1, kind="stable")[:, :k]
        return np.take_along_axis(distance, order, 1), np.take_along_axis(bearing, order, 1)

    def ranges(
        self, positions: ArrayLike, headings_rad: ArrayLike, n_beams: int, reach_m: float
    ) -> np.ndarray:
        """Return the ranges of a lidar: the distance to the first wall along each beam.

        Args:
            positions: In metres, ``(n, 2)``.
            headings_rad: Headings, ``(n,)``.
            n_beams: Number of beams, evenly over the full turn, counter-clockwise from ahead.
            reach_m: Largest range; may be ``inf``.

        Returns:
            Metres, ``(n, n_beams)``, ``inf`` where nothing is in range.

        Raises:
            SourceError: If the shapes are wrong or the reach is not positive.

        Example:
            >>> named_arena("square").ranges([(0.5, 0.0)], [0.0], 4, reach_m=1.2).tolist()
            [[0.5, 1.0, inf, 1.0]]
        """
        points, reach = self._points(positions), self._reach(reach_m)
        headings = np.asarray(headings_rad, dtype=np.float64)
        if headings.shape != (len(points),) or n_beams < 1:
            raise SourceError(
                f"{self.name}: {len(points)} positions, headings of shape {headings.shape}, "
                f"{n_beams} beams; expected one heading per position and at least 1 beam"
            )
        beams = TWO_PI * np.arange(n_beams) / n_beams
        found = np.empty((len(points), n_beams))
        if steps.ENABLED:
            circles = self._circles - (*self._origin, 0.0)
            cast_step(
                points - self._origin, np.ascontiguousarray(headings), beams, reach,
                self._n_sides, *self._off, *self._on, circles, self._round, found,
            )  # fmt: skip
            return found
        for rows in self._chunks(len(points), n_beams):
            angle = (headings[rows, None] + beams).ravel()
            ray = np.column_stack([np.cos(angle), np.sin(angle)])
            found[rows] = self._cast(points[rows], ray).reshape(-1, n_beams)
        return np.where(found <= reach, found, np.inf)

    def _cast(self, points: np.ndarray, ray: np.ndarray) -> np.ndarray:
        """Return the distance to a wall along rays ``(n * b, 2)``, ``b`` from each point."""
        repeat = len(ray) // max(len(points), 1)
        s, t = self._frames(points)
        side = np.where(s < 0.0, -1.0, 1.0)
        side[:, : self._n_sides] = 1.0  # free-standing walls have two faces
        s = s * side
        s = np.where(s >= -TOUCH_M, np.maximum(s, 0.0), np.inf)
        # Walls first, rays last: the reduction over walls is then over contiguous rows.
        s, t, side = (np.repeat(a.T, repeat, axis=1) for a in (s, t, side))
        closing = -(self._off[0].T @ ray.T) * side
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            along = s / closing
            t += along * (self._on[0].T @ ray.T)
            hit = (closing > 0.0) & (np.abs(t) <= 1.0 + TOUCH_M)
        first = np.where(hit, along, np.inf).min(axis=0, initial=np.inf)
        for k, (x, y, radius) in enumerate(self._circles.tolist()):
            from_centre = np.repeat(points - (x, y), repeat, axis=0)
            b = np.sum(from_centre * ray, axis=1)
            q = np.sum(from_centre**2, axis=1) - radius**2
            if self._round and k == 0:
                along = np.sqrt(b * b - np.minimum(q, 0.0)) - b
            else:
                root = b * b - np.maximum(q, 0.0)
                along = -b - np.sqrt(np.maximum(root, 0.0))
                along = np.where((root >= 0.0) & (b < 0.0), along, np.inf)
            first = np.fmin(first, along)
        return np.asarray(first)

    def _add_circle(
        self, points: np.ndarray, reach: float, k: int, distance: np.ndarray, bearing: np.ndarray
    ) -> None:
        """Write distance and bearing of a circle into their column."""
        around = self._round and k == 0
        out = points - self._circles[k, :2]
        gap = np.hypot(*out.T) - self._circles[k, 2]
        gap, out = (-gap, out) if around else (gap, -out)
        rows = np.flatnonzero((gap >= -TOUCH_M) & (gap <= reach))
        if not len(rows):
            return
        gap, towards = np.maximum(gap[rows], 0.0), bearings_of(out[rows])
        if not self.is_convex:
            unit = np.column_stack([np.cos(towards), np.sin(towards)])
            free = ~self._between(points[rows], points[rows] + gap[:, None] * unit, k)
            rows, gap, towards = rows[free], gap[free], towards[free]
        distance[rows, len(self._half) + k] = gap
        bearing[rows, len(self._half) + k] = towards

    def _between(self, here: np.ndarray, there: np.ndarray, circle: int) -> np.ndarray:
        """Return whether a wall separates points ``(n, 2)``, except one circle and the boundary."""
        hidden = np.zeros(len(here), dtype=bool)
        for rows in self._chunks(len(here)):
            (s0, t0), (s1, t1) = self._frames(here[rows]), self._frames(there[rows])
            apart = np.where(s0 == s1, 1.0, s0 - s1)
            on = np.abs(t0 + (t1 - t0) * s0 / apart) <= 1.0 + TOUCH_M
            across = (np.minimum(s0, s1) < -TOUCH_M) & (np.maximum(s0, s1) > TOUCH_M)
            hidden[rows] = (on & across).any(axis=1)
        for k in range(int(self._round), len(self._circles)):
            if k != circle:
                gap = to_segments(self._circles[k : k + 1, :2], here, there)[0]
                hidden |= gap < self._circles[k, 2] - TOUCH_M
        return hidden

    def _remove_hidden(self, points: np.ndarray, distance: np.ndarray, bearing: np.ndarray) -> None:
        """Remove hidden straight walls; reverse the bearing of walls seen from their right side."""
        rows, walls = np.nonzero(distance[:, : len(self._half)] < np.inf)
        order = np.argsort(walls, kind="stable")
        visible, first = np.unique(walls[order], return_index=True)
        for wall, at in zip(visible.tolist(), np.split(rows[order], first[1:]), strict=False):
            gap = points[at] - self._middle[wall]
            t, s = gap @ self._along[wall], gap @ self._normal[wall]
            left, *right = self._blockers[wall]
            hidden = left.hide(t, s)
            if right:
                reverse = s < 0.0
                bearing[at[reverse], wall] = bearings_of(self._normal[wall : wall + 1])
                hidden = np.where(reverse, right[0].hide(t, -s), hidden)
            distance[at[hidden], wall], bearing[at[hidden], wall] = np.inf, 0.0

    @cached_property
    def _blockers(self) -> list[tuple[_Blockers, ...]]:
        """Obstacles of the left face of each straight wall, and of a free one's right face."""
        found: list[tuple[_Blockers, ...]] = []
        pillars = self._circles[int(self._round) :]
        for i, half in enumerate(self._half):
            frame = np.column_stack([self._along[i], self._normal[i]])
            (t0, s0), (t1, s1) = (
                ((ends - self._middle[i]) @ frame).T for ends in (self._starts, self._ends)
            )
            low, high, run = np.minimum(t0, t1), np.maximum(t0, t1), t1 - t0
            # A wall perpendicular to this one is parallel to the line of sight, and hides nothing.
            over = (low < half) & (high > -half) & (np.abs(run) > TOUCH_M)
            over[i] = False
            slope = (s1 - s0) / np.where(over, run, 1.0)
            t, s = ((pillars[:, :2] - self._middle[i]) @ frame).T
            faces = []
            for side in (1.0, -1.0) if i >= self._n_sides else (1.0,):
                use = over & (np.maximum(side * s0, side * s1) > TOUCH_M)
                lines = np.column_stack([low, high, side * (s0 - t0 * slope), side * slope])
                use_pillar = (np.abs(t) < half + pillars[:, 2]) & (side * s > -pillars[:, 2])
                circles = np.column_stack([t, side * s, pillars[:, 2]])
                faces.append(_Blockers(lines[use], circles[use_pillar]))
            found.append(tuple(faces))
        return found

    def _frames(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances off the straight walls ``(n, W)``, left positive; -1 to 1 along them."""
        local = points - self._origin
        s, t = local @ self._off[0], local @ self._on[0]
        s -= self._off[1]
        t -= self._on[1]
        return s, t

    def _beyond_circles(self, points: np.ndarray) -> np.ndarray:
        """Return the distance outside each circle, ``(n, c)``."""
        gap = points[:, None] - self._circles[:, :2]
        return np.asarray(np.hypot(gap[..., 0], gap[..., 1]) - self._circles[:, 2])

    def _chunks(self, n: int, each: int = 1) -> Iterator[slice]:
        """Return slices of the positions whose temporary arrays fit into the cache."""
        rows = max(1, _CHUNK // (each * max(self.n_walls, 1)))
        return (slice(start, start + rows) for start in range(0, n, rows))

    def _points(self, positions: ArrayLike) -> np.ndarray:
        points = np.asarray(positions, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise SourceError(
                f"{self.name}: positions of shape {points.shape}; expected (n, 2) in metres"
            )
        return points

    def _reach(self, reach_m: float) -> float:
        if not reach_m > 0:
            raise SourceError(f"{self.name}: reach_m is {reach_m}; expected more than 0, or inf")
        return float(reach_m)

    def _check_holes(self) -> None:
        for k, hole in enumerate(self.holes):
            this = f"{self.name}: hole {k}"
            if meet(hole, self.boundary):
                raise SourceError(f"{this} crosses or touches the boundary; expected it inside")
            if not within(vertices_of(hole)[:1], self.boundary)[0]:
                raise SourceError(f"{this} lies outside the boundary; expected it inside")
            for other, outline in enumerate(self.holes[:k]):
                inside = within(vertices_of(hole)[:1], outline) | within(
                    vertices_of(outline)[:1], hole
                )
                if inside[0] or meet(hole, outline):
                    raise SourceError(
                        f"{this} and hole {other} touch or overlap; separate or join them"
                    )

    def _check_walls(self) -> None:
        for k, ends in enumerate(self.walls):
            this = f"{self.name}: wall {k} from {tuple(ends[0].tolist())} to "
            this += f"{tuple(ends[1].tolist())} m"
            n = self._n_sides
            crossed = crossings(ends[:1], ends[1:], self._starts[:n], self._ends[:n]).any()
            for pillar in self._circles[int(self._round) :]:
                gap = to_segments(pillar[None, :2], ends[:1], ends[1:])
                crossed |= bool(gap[0, 0] < pillar[2] - TOUCH_M)
            if crossed:
                raise SourceError(f"{this} crosses the boundary or a hole; end it there")
            if not self.contains([ends[0], ends.mean(axis=0), ends[1]]).all():
                raise SourceError(f"{this} lies outside the arena; expected it inside")


def named_arena(name: str) -> Arena:
    """Make an arena by its name, around the origin.

    ``triangle``, ``pentagon`` and ``nonagon`` are those of the simulated tracks, ``circle2m`` and
    ``circle1m`` (by diameter) those of the recorded tracks; ``square`` is 2 m wide, ``rectangle``
    2.5 x 3.5 m; ``two_rooms`` are 1 x 1 m each with a door of 0.3 m; ``pillar`` is the square with
    a pillar of radius 0.25 m in its middle.

    Raises:
        SourceError: If there is no arena of that name.

    Example:
        >>> named_arena("pentagon").n_walls
        5
        >>> named_arena("hexagon")
        Traceback (most recent call last):
        neuroslam.errors.SourceError: no arena is named 'hexagon'; expected one of circle1m,
        circle2m, nonagon, pentagon, pillar, rectangle, square, triangle, two_rooms; did you mean
        'pentagon'?
    """
    if name not in _NAMED:
        raise SourceError(
            f"no arena is named {name!r}; expected one of {', '.join(sorted(_NAMED))}"
            f"{did_you_mean(name, _NAMED)}"
        )
    return _NAMED[name](name)


def _box(width_m: float, depth_m: float) -> list[tuple[float, float]]:
    x, y = width_m / 2, depth_m / 2
    return [(-x, -y), (x, -y), (x, y), (-x, y)]


_NAMED: dict[str, Callable[[str], Arena]] = {
    "triangle": lambda name: Arena.regular(3, 1.2, name),
    "square": lambda name: Arena(_box(2.0, 2.0), name=name),
    "pentagon": lambda name: Arena.regular(5, 1.0, name),
    "nonagon": lambda name: Arena.regular(9, 1.0, name),
    "circle1m": lambda name: Arena.circle(0.5, name=name),
    "circle2m": lambda name: Arena.circle(1.0, name=name),
    "rectangle": lambda name: Arena(_box(2.5, 3.5), name=name),
    "two_rooms": lambda name: Arena.rooms(name=name),
    "pillar": lambda name: Arena(_box(2.0, 2.0), holes=[(0.0, 0.0, 0.25)], name=name),
}
