"""Worlds of landmarks: points and walls with names, seen from nearby."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuroslam.errors import SourceError

COLOURS = ("RED", "BLUE", "GREEN", "ORANGE", "PURPLE")
SHAPES = ("SQUARE", "TRIANGLE", "CIRCLE", "STAR", "DIAMOND")


class Landmark(NamedTuple):
    """A point or a wall.

    Attributes:
        name: For people.
        pointer: What it is, in words: names, ``*`` to bind, ``+`` to add.
        boxes_m: Lower and upper corners, ``(n, 2, dimension)``; a point has both alike.
    """

    name: str
    pointer: str
    boxes_m: np.ndarray

    @property
    def is_point(self) -> bool:
        """Whether it has no extent."""
        return len(self.boxes_m) == 1 and bool((self.boxes_m[0, 0] == self.boxes_m[0, 1]).all())

    @property
    def position_m(self) -> np.ndarray:
        """Its centre, ``(dimension,)``."""
        return self.boxes_m.mean((0, 1))


class LandmarkView(NamedTuple):
    """What is seen from positions; vectors are from there, in the world's directions.

    Attributes:
        in_view: ``(..., landmarks)``, booleans.
        distance_m: To the nearest point of each, ``(..., landmarks)``.
        low_m: Lower corners of all boxes, ``(..., boxes, dimension)``.
        high_m: Upper corners.
        box_landmark: Whose box each is, ``(boxes,)``.
    """

    in_view: np.ndarray
    distance_m: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    box_landmark: np.ndarray


class LandmarkWorld(NamedTuple):
    """Landmarks, and from how far they are seen.

    Attributes:
        landmarks: All of them, no name twice.
        bounds_m: Where animals can be, ``(dimension, 2)``.
        view_radius_m: A landmark is in view if its nearest point is not farther than this.

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
        """Of the landmarks."""
        return tuple(landmark.name for landmark in self.landmarks)

    @property
    def dimension(self) -> int:
        """Of the space."""
        return len(self.bounds_m)

    @property
    def boxes_m(self) -> np.ndarray:
        """Boxes of all landmarks, ``(boxes, 2, dimension)``."""
        return np.concatenate([landmark.boxes_m for landmark in self.landmarks])

    @property
    def box_landmark(self) -> np.ndarray:
        """Whose box each is, ``(boxes,)``."""
        return np.repeat(
            np.arange(len(self.landmarks)), [len(landmark.boxes_m) for landmark in self.landmarks]
        )

    def named(self, name: str) -> Landmark:
        """Return a landmark by its name, or raise a ``SourceError`` that lists the names."""
        if name not in self.names:
            raise SourceError(f"no landmark {name!r}; there is {', '.join(self.names)}")
        return self.landmarks[self.names.index(name)]

    def observe(self, position_m: np.ndarray) -> LandmarkView:
        """Return what is seen from positions, ``(..., dimension)``.

        Raises:
            SourceError: If a position is not a number, outside the bounds, or does not fit.
        """
        position = self._inside(np.asarray(position_m, dtype=np.float64))
        boxes, owner = self.boxes_m, self.box_landmark
        low = boxes[:, 0] - position[..., None, :]
        high = boxes[:, 1] - position[..., None, :]
        # How far the origin is outside of a box, along each axis.
        gap = np.maximum(np.maximum(low, -high), 0.0)
        to_box = np.linalg.norm(gap, axis=-1)
        distance = np.stack(
            [to_box[..., owner == k].min(-1) for k in range(len(self.landmarks))], axis=-1
        )
        return LandmarkView(distance <= self.view_radius_m, distance, low, high, owner)

    def _inside(self, position: np.ndarray) -> np.ndarray:
        if position.shape[-1:] != (self.dimension,):
            raise SourceError(
                f"positions of shape {position.shape}, expected (..., {self.dimension})"
            )
        ok = (position >= self.bounds_m[:, 0]) & (position <= self.bounds_m[:, 1])
        if not ok.all():
            first = position[~ok.all(-1)][0]
            raise SourceError(
                f"position {first.tolist()} m is outside the bounds {self.bounds_m.tolist()}, or "
                "not a number; mend the path or give the world larger bounds"
            )
        return position


def point(name: str, position_m: Sequence[float], pointer: str | None = None) -> Landmark:
    """Make a landmark without extent."""
    at = np.asarray(position_m, dtype=np.float64)
    return Landmark(name, pointer or name, np.stack([at, at])[None])


def wall(name: str, *boxes_m: Sequence[Sequence[float]], pointer: str | None = None) -> Landmark:
    """Make a landmark of boxes, each a lower and an upper corner."""
    return Landmark(name, pointer or name, np.asarray(boxes_m, dtype=np.float64))


def make_world(
    landmarks: Sequence[Landmark], reach_m: float = 1.0, view_radius_m: float = 0.2
) -> LandmarkWorld:
    """Put landmarks into the box [-reach, reach].

    Raises:
        SourceError: If there is none, a name is there twice, one lies outside or is not a number,
            or they have not the same dimension.
    """
    if not landmarks:
        raise SourceError("a world of landmarks needs at least one")
    names = [landmark.name for landmark in landmarks]
    for name in names:
        if names.count(name) > 1:
            raise SourceError(f"landmark {name!r} is there twice; give each a name of its own")
    dimension = landmarks[0].boxes_m.shape[-1]
    for landmark in landmarks:
        boxes = landmark.boxes_m
        if boxes.ndim != 3 or boxes.shape[1:] != (2, dimension) or not len(boxes):
            raise SourceError(
                f"landmark {landmark.name!r}: boxes of shape {boxes.shape}, expected (n, 2, "
                f"{dimension})"
            )
        if not (np.abs(boxes) <= reach_m).all() or not (boxes[:, 0] <= boxes[:, 1]).all():
            raise SourceError(
                f"landmark {landmark.name!r}: boxes {boxes.tolist()} must lie within {reach_m} m "
                "and go from a lower to an upper corner"
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
    """Make a world of points, uniform in the inner 90 % of the box.

    Args:
        n_landmarks: How many.
        dimension: Of the space.
        seed: Of the places.
        reach_m: Half a side of the box.
        view_radius_m: From how far they are seen.
        attributes: Give each a colour and a shape, no pair of them twice.
    """
    draw = np.random.default_rng(seed)
    at = draw.uniform(-0.9 * reach_m, 0.9 * reach_m, (n_landmarks, dimension))
    names = [f"L{k}" for k in range(n_landmarks)]
    pointers = names
    if attributes:
        pairs = [(c, s) for c in COLOURS for s in SHAPES]
        if n_landmarks > len(pairs):
            raise SourceError(f"{n_landmarks} landmarks, but only {len(pairs)} colours and shapes")
        chosen = draw.permutation(len(pairs))[:n_landmarks]
        names = [f"{pairs[k][0]}_{pairs[k][1]}" for k in chosen]
        pointers = [f"{pairs[k][0]} * {pairs[k][1]}" for k in chosen]
    made = [point(n, x, p) for n, x, p in zip(names, at, pointers, strict=True)]
    return make_world(made, reach_m, view_radius_m)


def paper_world() -> LandmarkWorld:
    """Make the world of the paper's Fig. 4: three points with attributes, and an L of walls."""
    return make_world(
        [
            point("BLUE_SQUARE", (0.6, -0.2), "BLUE * SQUARE"),
            point("BLUE_TRIANGLE", (0.0, -0.6), "BLUE * TRIANGLE"),
            point("ORANGE_TRIANGLE", (-0.2, 0.2), "ORANGE * TRIANGLE"),
            wall("WALL", ((-1.1, 0.95), (0.5, 1.1)), ((0.95, 0.4), (1.1, 1.1))),
        ],
        reach_m=1.2,
        view_radius_m=0.3,
    )


def read_world(path: str | Path) -> LandmarkWorld:
    """Read a world from a JSON file.

    ``{"reach_m": 1, "view_radius_m": 0.2, "landmarks": [{"name": "DOOR", "position_m": [0, 1]},
    {"name": "WALL", "boxes_m": [[[0, 0], [1, 0.1]]], "pointer": "GREY * WALL"}]}``.

    Raises:
        SourceError: If it cannot be read, or is no such world.
    """
    path = Path(path)
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        made = [
            wall(one["name"], *one["boxes_m"], pointer=one.get("pointer"))
            if "boxes_m" in one
            else point(one["name"], one["position_m"], one.get("pointer"))
            for one in told["landmarks"]
        ]
        return make_world(
            made, float(told.get("reach_m", 1)), float(told.get("view_radius_m", 0.2))
        )
    except OSError:
        raise SourceError(f"{path}: cannot be read") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, SourceError):
            raise SourceError(f"{path}: {error}") from None
        raise SourceError(
            f"{path}: not a world of landmarks ({type(error).__name__}: {error}); it needs "
            "landmarks with a name and a position_m or boxes_m each"
        ) from None
