"""Elements of a rendered world: walls, pillars, figures, surfaces and routes."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.worlds.atlas import Atlas, halvings


class Surface(NamedTuple):
    """Texture of the ground or the ceiling, oriented as a map: x to the right, y up.

    Attributes:
        image: ``uint8 (h, w, 3)``; its lower left corner is at ``(x_m, y_m)``.
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
        x_m: Position.
        y_m: Position.
        width_m: Width of the cut-out.
        height_m: Height of the cut-out, which stands on the floor.
        cutout: Index of the world's cut-out.
    """

    x_m: float
    y_m: float
    width_m: float
    height_m: float
    cutout: int


class Ramp(NamedTuple):
    """An inclined floor along x, over a rectangle.

    Attributes:
        x0_m: Where it begins, at the height of its storey.
        x1_m: Where it ends.
        y0_m: Its sides.
        y1_m: The other.
        rise_m: Height of its end above its begin; negative: it leads down.
    """

    x0_m: float
    x1_m: float
    y0_m: float
    y1_m: float
    rise_m: float

    def height(self, x_m: float) -> float:
        """Return the height above the begin."""
        return self.rise_m * (x_m - self.x0_m) / (self.x1_m - self.x0_m)

    def covers(self, x_m: float, y_m: float) -> bool:
        """Return whether a point of the plan is on the ramp."""
        return self.x0_m < x_m < self.x1_m and self.y0_m < y_m < self.y1_m


class Route:
    """A closed path, a dense table of positions, driven at constant speed.

    Args:
        points_m: Positions along the path, shape ``(m, 2)``, the first not repeated at the end.
        headings_rad: Heading at each position, shape ``(m,)``.
        heights_m: Height at each position, ``(m,)``; ``None``: the path is level. Lengths and
            speeds are horizontal ones.

    Example:
        >>> lap = ellipse_route(2.0, 1.0)
        >>> lap.poses(4).round(3).tolist()[0]
        [2.0, 0.0, 1.571]
    """

    def __init__(
        self,
        points_m: np.ndarray,
        headings_rad: np.ndarray,
        heights_m: np.ndarray | None = None,
    ) -> None:
        closed = np.vstack([points_m, points_m[:1]])
        steps = np.hypot(*np.diff(closed, axis=0).T)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        headings = np.unwrap(np.append(headings_rad, headings_rad[0]))
        self._table = np.column_stack([closed, headings])
        self._heights = None if heights_m is None else np.append(heights_m, heights_m[0])

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

    @property
    def climbs(self) -> bool:
        """Whether the path changes its height."""
        return self._heights is not None

    def heights(self, n: int) -> np.ndarray:
        """Return the height at ``n`` equidistant poses of one lap, in metres, ``(n,)``."""
        if self._heights is None:
            return np.zeros(n)
        return np.interp(np.arange(n) * (self.length_m / n), self._along, self._heights)

    def pitches(self, n: int, wheelbase_m: float) -> np.ndarray:
        r"""Return the pitch of a vehicle at the same poses, radians upwards, ``(n,)``.

        .. math:: \tan p = \bigl(z(s + \tfrac{l}{2}) - z(s - \tfrac{l}{2})\bigr) / l

        Args:
            n: Number of poses.
            wheelbase_m: Distance :math:`l` of its axles.
        """
        if self._heights is None:
            return np.zeros(n)
        s, half = np.arange(n) * (self.length_m / n), 0.5 * wheelbase_m
        front, rear = (
            np.interp((s + by) % self.length_m, self._along, self._heights) for by in (half, -half)
        )
        return np.asarray(np.arctan2(front - rear, wheelbase_m))

    def poses(self, n: int) -> np.ndarray:
        """Return ``n`` equidistant poses of one lap, shape ``(n, 3)``."""
        return self.at(np.arange(n) * (self.length_m / n))


def ellipse_route(
    semi_x_m: float, semi_y_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
) -> Route:
    """Return a counter-clockwise ellipse that starts at its rightmost point."""
    t = np.arange(20_000) * (TWO_PI / 20_000)
    points = np.column_stack([semi_x_m * np.cos(t), semi_y_m * np.sin(t)]) + centre_m
    return Route(points, np.arctan2(semi_y_m * np.cos(t), -semi_x_m * np.sin(t)))


def rounded_route(
    corners_m: list[tuple[float, float]],
    radius_m: float,
    heights_m: list[float] | None = None,
    level_arcs: bool = False,
) -> Route:
    """Return a closed polygon with rounded corners; it starts in the middle of its first side.

    Args:
        corners_m: Corners of the polygon, in the order of travel.
        radius_m: Radius of the arcs; smaller where a side is too short for it.
        heights_m: Height at the middle of each arc, between which the path rises evenly; ``None``:
            it is level.
        level_arcs: The arcs are level, and the path rises between them.
    """
    corners = np.asarray(corners_m, dtype=float)
    n = len(corners)
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*sides.T)
    headings = np.arctan2(sides[:, 1], sides[:, 0])
    at = (corners[0] + corners[1]) / 2.0
    # Numbers of the first, middle and last point of each arc, from the second corner on.
    arcs: list[tuple[int, int, int]] = []
    points: list[np.ndarray] = []
    angles: list[np.ndarray] = []
    for i in range(n):  # along side i to its end, then around the corner there
        j = (i + 1) % n
        turn = wrap_angle(headings[j] - headings[i])
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
        last, size = sum(map(len, points)) - 1, len(points[-1]) if half > 1e-9 else 1
        arcs.append((last - size + 1, last - size // 2 if size > 1 else last, last))
        at = corners[j] + cut * w
    _add_line(points, angles, at, (corners[0] + corners[1]) / 2.0, headings[0])
    path = np.vstack(points)
    if heights_m is None:
        return Route(path, np.concatenate(angles))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    knots = np.array([*heights_m[1:], heights_m[0]])
    end = (heights_m[0] + heights_m[1]) / 2.0  # the path begins in the middle of the first side
    first, middle, last = np.array(arcs).T
    at_m = along[np.column_stack([first, last]).ravel() if level_arcs else middle]
    z_m = np.repeat(knots, 2) if level_arcs else knots
    z = np.interp(along, [0.0, *at_m, along[-1]], [end, *z_m, end])
    return Route(path, np.concatenate(angles), z)


def _add_line(
    points: list[np.ndarray], angles: list[np.ndarray], a: np.ndarray, b: np.ndarray, heading: float
) -> None:
    if np.hypot(*(b - a)) > 1e-9:
        points.append(a[None])  # the two ends suffice; the end is the start of the next piece
        points.append((a + (b - a) * (1.0 - 1e-9))[None])
        angles.append(np.full(2, heading))


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """Geometry and textures of a static world.

    A wall runs from ``(x0, y0)`` to ``(x1, y1)`` and is visible from its right-hand side: the walls
    of a solid run counter-clockwise, those of a room clockwise. So no texture is mirrored.

    Attributes:
        name: Name in the catalogue.
        description: Description in one line.
        walls: x0, y0, x1, y1 in metres, ``float64 (n, 4)``.
        wall_strips: Index of the strip on each wall, ``int (n,)``.
        wall_offsets_m: Position on the strip at which the wall starts, ``(n,)``.
        strips: Textures of walls, ``uint8 (h, w, 3)``, with their pixels per metre.
        pillars: x, y, radius in metres, ``(m, 3)``.
        pillar_strips: Index of the strip around each pillar, ``int (m,)``.
        billboards: Static figures.
        cutouts: Textures of figures, ``uint8 (h, w, 4)``; the fourth channel is opacity.
        people: Cut-outs of the walking cycle of each kind of pedestrian.
        ground: Texture of the floor.
        ceiling: Texture of the ceiling; ``None`` under the open sky.
        sky: Panorama, ``uint8 (h, w, 3)``, whose lower edge is the horizon; required without a
            ceiling.
        haze: Colour to which distant surfaces fade.
        sight_m: Distance at which 63 % of a surface's colour has faded.
        routes: Closed paths; the first is the default.
        lanes_m: Offsets to the left of the route at which pedestrians walk.
        sense: Default camera and motion, see :class:`Sense`.
        flown: Whether heights of a route are above the one floor of the world, as of a drone;
            else it has as many storeys that look alike as its routes climb to.
        ramps: Inclined floors between its storeys.
        storey_m: From floor to floor.
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
    flown: bool = False
    ramps: tuple[Ramp, ...] = ()
    storey_m: float = 3.0

    @cached_property
    def atlas(self) -> Atlas:
        """All surfaces in one image at several resolutions."""
        return Atlas(self.strips, self.ground.image, self.ceiling and self.ceiling.image, self.sky)

    @cached_property
    def figure_levels(self) -> list[list[np.ndarray]]:
        """Each cut-out at halving resolutions, with colours premultiplied by opacity."""
        return [halvings(image) for image in self.cutouts]

    @cached_property
    def strip_heights_m(self) -> np.ndarray:
        """Height of each strip in metres, shape ``(n_strips,)``."""
        return np.array([image.shape[0] / scale for image, scale in self.strips])

    @property
    def wall_heights_m(self) -> np.ndarray:
        """Height of each wall in metres, shape ``(n,)``."""
        return np.asarray(self.strip_heights_m[self.wall_strips])

    @property
    def segments(self) -> np.ndarray:
        """The walls as line segments, ``(n, 2, 2)``, for matplotlib's ``LineCollection``."""
        return self.walls.reshape(-1, 2, 2)


class Sense(NamedTuple):
    """Default camera and motion in a world.

    Attributes:
        frames_per_lap: Frames in one lap of the first route; other routes have the same speed.
        laps: Number of laps.
        panoramic: Whether the camera is panoramic.
        horizon: Row of the horizon as a fraction of the height, from the top.
        camera_height_m: Height of the camera.
        odometry: Whether the robot has wheel odometry.
    """

    frames_per_lap: int = 350
    laps: float = 2.0
    panoramic: bool = False
    horizon: float = 0.5
    camera_height_m: float = 1.1
    odometry: bool = True
