"""Worlds of landmarks: named points and walls that are visible from nearby."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuroslam.errors import SourceError
from neuroslam.limits import MOST_JSON_BYTES, parse_json, read_bounded

COLOURS = ("RED", "BLUE", "GREEN", "ORANGE", "PURPLE")
SHAPES = ("SQUARE", "TRIANGLE", "CIRCLE", "STAR", "DIAMOND")


class Landmark(NamedTuple):
    """A point or a wall.

    Attributes:
        name: Name in reports.
        pointer: Expression of its semantic pointer: names, ``*`` for binding, ``+`` for addition.
        boxes_m: Lower and upper corners, ``(n, 2, dimension)``; those of a point are equal.
    """

    name: str
    pointer: str
    boxes_m: np.ndarray

    @property
    def is_point(self) -> bool:
        """Whether the landmark has no extent."""
        return len(self.boxes_m) == 1 and bool((self.boxes_m[0, 0] == self.boxes_m[0, 1]).all())

    @property
    def position_m(self) -> np.ndarray:
        """Centre of the landmark, ``(dimension,)``."""
        return np.asarray(self.boxes_m.mean((0, 1)))


class LandmarkView(NamedTuple):
    """Landmarks as seen from positions; vectors start there and have the world's axes.

    Attributes:
        in_view: Whether each landmark is in view, ``(..., landmarks)`` bool.
        distance_m: Distance to the nearest point of each landmark, ``(..., landmarks)``.
        low_m: Vectors to the lower corners of all boxes, ``(..., boxes, dimension)``.
        high_m: Vectors to the upper corners.
        box_landmark: Landmark of each box, ``(boxes,)``.
    """

    in_view: np.ndarray
    distance_m: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    box_landmark: np.ndarray


class LandmarkWorld(NamedTuple):
    """Landmarks in a box, and the distance up to which they are in view.

    Attributes:
        landmarks: All landmarks; names are unique.
        bounds_m: Lower and upper bounds of positions, ``(dimension, 2)``.
        view_radius_m: Largest distance of a landmark's nearest point at which it is in view.

    Example:
        >>> world = random_world(n_landmarks=3, seed=0)
        >>> view = world.observe(world.landmarks[1].position_m)
        >>> view.in_view.tolist(), view.distance_m[1].item()
        ([False, True, False], 0.0)
    """

    landmarks: tuple[Landmark, ...]
    bounds_m: np.ndarray
    view_radius_m: float = 0.2

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the landmarks."""
        return tuple(landmark.name for landmark in self.landmarks)

    @property
    def dimension(self) -> int:
        """Dimension of the space."""
        return len(self.bounds_m)

    @property
    def boxes_m(self) -> np.ndarray:
        """Boxes of all landmarks, ``(boxes, 2, dimension)``."""
        return np.concatenate([landmark.boxes_m for landmark in self.landmarks])

    @property
    def box_landmark(self) -> np.ndarray:
        """Landmark of each box, ``(boxes,)``."""
        return np.repeat(
            np.arange(len(self.landmarks)), [len(landmark.boxes_m) for landmark in self.landmarks]
        )

    def named(self, name: str) -> Landmark:
        """Return a landmark by its name; a ``SourceError`` lists the names."""
        if name not in self.names:
            raise SourceError(f"no landmark {name!r}; expected one of {', '.join(self.names)}")
        return self.landmarks[self.names.index(name)]

    def observe(self, position_m: np.ndarray) -> LandmarkView:
        """Return the view of the landmarks from positions, ``(..., dimension)``.

        Raises:
            SourceError: If a position is NaN, outside the bounds, or of another dimension.
        """
        position = self._inside(np.asarray(position_m, dtype=np.float64))
        boxes, owner = self.boxes_m, self.box_landmark
        low = boxes[:, 0] - position[..., None, :]
        high = boxes[:, 1] - position[..., None, :]
        # Distance of the origin from the box along each axis, 0 inside.
        gap = np.maximum(np.maximum(low, -high), 0.0)
        to_box = np.linalg.norm(gap, axis=-1)
        distance = np.stack(
            [to_box[..., owner == k].min(-1) for k in range(len(self.landmarks))], axis=-1
        )
        return LandmarkView(distance <= self.view_radius_m, distance, low, high, owner)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        if position.shape[-1:] != (self.dimension,):
            raise SourceError(
                f"positions have shape {position.shape}; expected (..., {self.dimension})"
            )
        inside = (position >= self.bounds_m[:, 0]) & (position <= self.bounds_m[:, 1])
        if not inside.all():
            first = position[~inside.all(-1)][0]
            raise SourceError(
                f"position {first.tolist()} m is outside the bounds {self.bounds_m.tolist()}, or "
                "not a number; change the path, or give the world larger bounds"
            )
        return position


def point(name: str, position_m: Sequence[float], pointer: str | None = None) -> Landmark:
    """Make a point landmark, without extent."""
    at = np.asarray(position_m, dtype=np.float64)
    return Landmark(name, pointer or name, np.stack([at, at])[None])


def wall(name: str, *boxes_m: Sequence[Sequence[float]], pointer: str | None = None) -> Landmark:
    """Make a landmark of boxes, each given by its lower and upper corners."""
    return Landmark(name, pointer or name, np.asarray(boxes_m, dtype=np.float64))


def make_world(
    landmarks: Sequence[Landmark], reach_m: float = 1.0, view_radius_m: float = 0.2
) -> LandmarkWorld:
    """Make a world of landmarks in the box [-reach, reach].

    Raises:
        SourceError: If there are no landmarks, a name is not unique, a landmark is outside or NaN,
            or the dimensions differ.
    """
    if not landmarks:
        raise SourceError("a world of landmarks is empty; expected at least one landmark")
    names = [landmark.name for landmark in landmarks]
    for name in names:
        if names.count(name) > 1:
            raise SourceError(f"landmark {name!r} occurs twice; give each landmark its own name")
    dimension = landmarks[0].boxes_m.shape[-1]
    for landmark in landmarks:
        boxes = landmark.boxes_m
        if boxes.ndim != 3 or boxes.shape[1:] != (2, dimension) or not len(boxes):
            raise SourceError(
                f"landmark {landmark.name!r}: boxes have shape {boxes.shape}; expected (n, 2, "
                f"{dimension})"
            )
        if not (np.abs(boxes) <= reach_m).all() or not (boxes[:, 0] <= boxes[:, 1]).all():
            raise SourceError(
                f"landmark {landmark.name!r}: boxes are {boxes.tolist()}; expected corners within "
                f"{reach_m} m of 0, the lower one first"
            )
    bounds = np.array([[-reach_m, reach_m]] * dimension, dtype=np.float64)
    return LandmarkWorld(tuple(landmarks), bounds, view_radius_m)


def random_world(
    n_landmarks: int = 10,
    dimension: int = 2,
    seed: int = 0,
    reach_m: float = 1.0,
    view_radius_m: float = 0.2,
    attributes: bool = False,
) -> LandmarkWorld:
    """Make a world of point landmarks, uniform in the inner 90 % of the box.

    Args:
        n_landmarks: Number of landmarks.
        dimension: Dimension of the space.
        seed: Seed of the positions.
        reach_m: Half a side of the box.
        view_radius_m: Distance up to which landmarks are in view.
        attributes: Give each landmark a unique pair of a colour and a shape.
    """
    generator = np.random.default_rng(seed)
    positions = generator.uniform(-0.9 * reach_m, 0.9 * reach_m, (n_landmarks, dimension))
    names = [f"L{k}" for k in range(n_landmarks)]
    pointers = names
    if attributes:
        pairs = [(c, s) for c in COLOURS for s in SHAPES]
        if n_landmarks > len(pairs):
            raise SourceError(
                f"{n_landmarks} landmarks for {len(pairs)} pairs of a colour and a shape; expected "
                f"at most {len(pairs)}"
            )
        chosen = generator.permutation(len(pairs))[:n_landmarks]
        names = [f"{pairs[k][0]}_{pairs[k][1]}" for k in chosen]
        pointers = [f"{pairs[k][0]} * {pairs[k][1]}" for k in chosen]
    made = [point(n, x, p) for n, x, p in zip(names, positions, pointers, strict=True)]
    return make_world(made, reach_m, view_radius_m)


def paper_world() -> LandmarkWorld:
    """Make the world of the paper's Fig. 4: three points with attributes, and walls in a corner.

    The positions are those of SSP-SLAM, Eqs. 21 to 24. The wall is one L in the upper left corner,
    two boxes of ``[x_min, x_max] x [y_min, y_max]``: ``[-1.1, -0.95] x [0.5, 1.1]`` and
    ``[-1.0, -0.4] x [0.95, 1.1]``, which overlap where they meet.

    Example:
        >>> world = paper_world()
        >>> world.named("BLUE_SQUARE").position_m.tolist()
        [0.6, 0.2]
        >>> world.observe([-0.7, 0.8]).in_view.tolist()
        [False, False, False, True]
    """
    return make_world(
        [
            point("BLUE_SQUARE", (0.6, 0.2), "BLUE * SQUARE"),
            point("BLUE_TRIANGLE", (0.0, -0.6), "BLUE * TRIANGLE"),
            point("ORANGE_TRIANGLE", (-0.2, 0.2), "ORANGE * TRIANGLE"),
            wall("WALL", ((-1.1, 0.5), (-0.95, 1.1)), ((-1.0, 0.95), (-0.4, 1.1))),
        ],
        reach_m=1.2,
        view_radius_m=0.3,
    )


def read_world(path: str | Path) -> LandmarkWorld:
    """Read a world from a JSON file.

    ``{"reach_m": 1, "view_radius_m": 0.2, "landmarks": [{"name": "DOOR", "position_m": [0, 1]},
    {"name": "WALL", "boxes_m": [[[0, 0], [1, 0.1]]], "pointer": "GREY * WALL"}]}``.

    Raises:
        SourceError: If the file cannot be read, or describes no world.
    """
    path = Path(path)
    try:
        world = parse_json(read_bounded(path, MOST_JSON_BYTES))
        landmarks = [
            wall(entry["name"], *entry["boxes_m"], pointer=entry.get("pointer"))
            if "boxes_m" in entry
            else point(entry["name"], entry["position_m"], entry.get("pointer"))
            for entry in world["landmarks"]
        ]
        return make_world(
            landmarks, float(world.get("reach_m", 1)), float(world.get("view_radius_m", 0.2))
        )
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, SourceError):
            raise SourceError(f"{path}: {error}") from None
        raise SourceError(
            f"{path}: is no world of landmarks ({type(error).__name__}: {error}); expected "
            "landmarks, each with a name and a position_m or boxes_m"
        ) from None
