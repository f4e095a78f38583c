"""What a rendered world is made of: walls, pillars, figures, surfaces, and the routes in it."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from neuroslam.geometry import TWO_PI, wrap_angles
from neuroslam.worlds.atlas import Atlas, halvings


class Surface(NamedTuple):
    """A horizontal image of the ground or the ceiling, seen as on a map: x to the right, y up.

    Attributes:
        image: ``uint8 (h, w, 3)``; its lower left corner lies at ``(x_m, y_m)``.
        px_per_m: Pixels per metre.
        height_m: Height above the floor; 0 for the ground.
    """

    image: np.ndarray
    px_per_m: float
    x_m: float
    y_m: float
    height_m: float


class Billboard(NamedTuple):
    """An upright cut-out that always faces the camera: a plant, a tree, a person.

    Attributes:
        x_m: Where it stands.
        y_m: Where it stands.
        width_m: Width of its image.
        height_m: Height of its image; it stands on the floor.
        cutout: Which of the world's cut-outs it shows.
    """

    x_m: float
    y_m: float
    width_m: float
    height_m: float
    cutout: int


class Route:
    """A closed path: a dense table of places, driven at constant speed.

    Args:
        points_m: Places along the path, shape ``(m, 2)``, the first not repeated at the end.
        headings_rad: Direction of travel at each of them, shape ``(m,)``.

    Example:
        >>> lap = ellipse_route(2.0, 1.0)
        >>> lap.poses(4).round(3).tolist()[0]
        [2.0, 0.0, 1.571]
    """

    def __init__(self, points_m: np.ndarray, headings_rad: np.ndarray) -> None:
        closed = np.vstack([points_m, points_m[:1]])
        steps = np.hypot(*np.diff(closed, axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        turning = np.unwrap(np.append(headings_rad, headings_rad[0]))
        self._table = np.column_stack([closed, turning])

    @property
    def length_m(self) -> float:
        """Length of one lap in metres."""
        return float(self._along[-1])

    def at(self, distance_m: np.ndarray | float) -> np.ndarray:
        """Return the poses at these distances from the start, ``(n, 3)``, headings in [-pi, pi)."""
        along = np.atleast_1d(np.asarray(distance_m, dtype=float)) % self.length_m
        poses = np.column_stack([np.interp(along, self._along, column) for column in self._table.T])
        poses[:, 2] = wrap_angles(poses[:, 2])
        return poses

    def poses(self, n: int) -> np.ndarray:
        """Return ``n`` poses at equal distances around one lap, shape ``(n, 3)``."""
        return self.at(np.arange(n) * (self.length_m / n))


def ellipse_route(
    semi_x_m: float, semi_y_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
) -> Route:
    """Return an ellipse driven counter-clockwise from its rightmost point."""
    t = np.arange(20_000) * (TWO_PI / 20_000)
    points = np.column_stack([semi_x_m * np.cos(t), semi_y_m * np.sin(t)]) + centre_m
    return Route(points, np.arctan2(semi_y_m * np.cos(t), -semi_x_m * np.sin(t)))


def rounded_route(corners_m: list[tuple[float, float]], radius_m: float) -> Route:
    """Return a closed polygon whose corners are arcs; it starts half-way along its first side.

    Args:
        corners_m: The polygon, in the order of travel.
        radius_m: Radius of the arcs; made smaller where two corners are too close for it.
    """
    corners = np.asarray(corners_m, dtype=float)
    n = len(corners)
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*sides.T)
    headings = np.arctan2(sides[:, 1], sides[:, 0])
    at = (corners[0] + corners[1]) / 2.0
    points, angles = [], []
    for i in range(n):  # along side i to its end, then around the corner there
        j = (i + 1) % n
        turn = (headings[j] - headings[i] + math.pi) % TWO_PI - math.pi
        half = abs(math.tan(turn / 2.0))
        room = 0.5 * min(lengths[i], lengths[j])
        cut = min(radius_m * half, room)
        u, w = sides[i] / lengths[i], sides[j] / lengths[j]
        _add_line(points, angles, at, corners[j] - cut * u, headings[i])
        if half > 1e-9:
            radius = cut / half
            bow = np.linspace(0.0, turn, max(3, math.ceil(abs(turn) * radius / 0.005)) + 1)[:-1]
            side = math.copysign(1.0, turn)
            centre = corners[j] - cut * u + side * radius * np.array([-u[1], u[0]])
            phi = headings[i] + bow - side * math.pi / 2.0
            points.append(centre + radius * np.column_stack([np.cos(phi), np.sin(phi)]))
            angles.append(headings[i] + bow)
        at = corners[j] + cut * w
    _add_line(points, angles, at, (corners[0] + corners[1]) / 2.0, headings[0])
    return Route(np.vstack(points), np.concatenate(angles))


def _add_line(
    points: list[np.ndarray], angles: list[np.ndarray], a: np.ndarray, b: np.ndarray, heading: float
) -> None:
    if np.hypot(*(b - a)) > 1e-9:
        points.append(a[None])  # a straight needs its ends only; its end is the next piece's start
        points.append((a + (b - a) * (1.0 - 1e-9))[None])
        angles.append(np.full(2, heading))


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """Geometry and looks of a place; nothing in it moves.

    A wall runs from ``(x0, y0)`` to ``(x1, y1)`` and is seen from its right-hand side; solids are
    walked counter-clockwise, rooms clockwise, so that an image on it is never mirrored.

    Attributes:
        name: Its name in the catalogue.
        description: One line.
        walls: ``float64 (n, 4)``: x0, y0, x1, y1 in metres.
        wall_strips: ``int (n,)``: which of ``strips`` each wall shows.
        wall_offsets_m: ``(n,)``: where on its strip the wall starts.
        strips: Images of walls, ``uint8 (h, w, 3)``, and each one's pixels per metre.
        pillars: ``(m, 3)``: x, y, radius in metres.
        pillar_strips: ``int (m,)``: which of ``strips`` goes around each pillar.
        billboards: Figures that stand still.
        cutouts: Images of figures, ``uint8 (h, w, 4)``, the fourth channel is opacity.
        people: For each kind of passer-by, the cut-outs of one walking cycle.
        ground: Image of the floor.
        ceiling: Image of the ceiling, or ``None`` under the open sky.
        sky: ``uint8 (h, w, 3)`` all around; its lower edge is the horizon. Needed if no ceiling.
        haze: Colour that distant things fade to.
        sight_m: Distance at which 63 % of a thing's colour has faded.
        routes: Closed paths, the first is the default.
        lanes_m: How far to the left of a route passers-by walk.
        sense: Default camera and motion, see :class:`Sense`.
    """

    name: str
    description: str
    walls: np.ndarray
    wall_strips: np.ndarray
    wall_offsets_m: np.ndarray
    strips: list[tuple[np.ndarray, float]]
    ground: Surface
    routes: list[Route]
    sense: "Sense"
    pillars: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    pillar_strips: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    billboards: tuple[Billboard, ...] = ()
    cutouts: tuple[np.ndarray, ...] = ()
    people: tuple[tuple[int, ...], ...] = ()
    lanes_m: tuple[float, ...] = (0.55, -0.55)
    ceiling: Surface | None = None
    sky: np.ndarray | None = None
    haze: tuple[int, int, int] = (90, 88, 84)
    sight_m: float = 18.0

    @cached_property
    def atlas(self) -> Atlas:
        """All surfaces in one image, at several resolutions; made once."""
        return Atlas(self.strips, self.ground.image, self.ceiling and self.ceiling.image, self.sky)

    @cached_property
    def figure_levels(self) -> list[list[np.ndarray]]:
        """Each cut-out at halving resolutions, colours times opacity."""
        return [halvings(image) for image in self.cutouts]

    @cached_property
    def strip_heights_m(self) -> np.ndarray:
        """Height of each strip in metres, shape ``(n_strips,)``."""
        return np.array([image.shape[0] / scale for image, scale in self.strips])

    @property
    def wall_heights_m(self) -> np.ndarray:
        """Height of each wall in metres, shape ``(n,)``."""
        return self.strip_heights_m[self.wall_strips]

    @property
    def segments(self) -> np.ndarray:
        """The walls as line segments ``(n, 2, 2)``, as matplotlib's ``LineCollection`` takes."""
        return self.walls.reshape(-1, 2, 2)


class Sense(NamedTuple):
    """How a world is seen and driven unless the user says otherwise.

    Attributes:
        frames_per_lap: Frames in one lap of the first route; other routes keep the speed.
        laps: Laps.
        panoramic: Whether the camera sees all around.
        horizon: Where the horizon is in the image, from its top, as a share of the height.
        camera_height_m: Height of the camera.
        odometry: Whether the robot has wheel odometry.
    """

    frames_per_lap: int = 350
    laps: float = 2.0
    panoramic: bool = False
    horizon: float = 0.5
    camera_height_m: float = 1.1
    odometry: bool = True
