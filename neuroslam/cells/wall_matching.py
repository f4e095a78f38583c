"""Alignment of two maps without views by the walls that both sessions remember."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from torch import Tensor

from neuroslam.config import BrainConfig
from neuroslam.errors import counted
from neuroslam.geometry import TWO_PI, rotation_matrix, wrap_angle, wrap_angles
from neuroslam.state.match import Match, Pairs
from neuroslam.types import Pose

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_LEAST_WALLS = 6
_LEAST_SHARE = 0.6  # of the walls of the smaller map that must match
_CLEARLY = 0.85  # largest share of those that any other alignment may match
_BEARING_RAD = math.radians(15.0)
_OFF_SIGMAS = 2.5  # standard deviations within which two walls match
_RMS_SIGMAS = 0.85, 1.2  # largest RMS residual, in sd, up to this share, and where all match
_MOST = 0.85  # share of the walls that match from which on maps may be bent
_LEAST_SPREAD = 0.08  # of normals: parallel walls leave the alignment open along them
_TURNS = 12
_CANDIDATES = 20_000
_ROUNDS = 12
_QUERIES = 50_000  # feet looked up at once: bounds the memory


class Outline(NamedTuple):
    """Feet of the perpendiculars on remembered walls, ``(n, 2)`` m, and their bearings, rad."""

    feet_m: np.ndarray
    bearing_rad: np.ndarray

    def moved(self, turn_rad: float, move_m: np.ndarray) -> "Outline":
        """Turn about the origin, then move."""
        turn = rotation_matrix(turn_rad)
        return Outline(self.feet_m @ turn.T + move_m, wrap_angles(self.bearing_rad + turn_rad))


class OutlineAlignment(NamedTuple):
    """Alignment of one outline with another.

    Attributes:
        turn_rad: Rotation about the origin.
        move_m: Translation after that, ``(2,)``.
        n_same: Number of walls that match.
        off_m: RMS residual of those, metres.
        runner_up: Largest number of walls that match in another alignment.
        spread: Smaller eigenvalue of the covariance of normals, 0 (parallel walls) to 0.5.
    """

    turn_rad: float
    move_m: np.ndarray
    n_same: int
    off_m: float
    runner_up: int
    spread: float


def align_outlines(
    loaded: Outline, partial: Outline, turns_rad: list[float], reach_m: float, off_m: float
) -> OutlineAlignment:
    r"""Find the rigid alignment of one outline with another: grid search, then refinement.

    A wall matches a foot of the other outline with the same bearing within ``reach_m`` along the
    wall and ``off_m`` across it. The refinement solves

    .. math:: \min_{\phi, t} \sum_k \big((R(\phi) f_k + t - g_k) \cdot \mathbf n_k\big)^2

    over the walls that match (point-to-line ICP).

    Args:
        loaded: Outline that stays; not empty.
        partial: Outline that moves; not empty.
        turns_rad: Rotations to try.
        reach_m: Extent of a wall segment.
        off_m: Largest distance between two walls that match.
    """
    from scipy.spatial import KDTree  # slow to import, not always needed

    tree = KDTree(loaded.feet_m)
    tried: list[tuple[int, float, np.ndarray]] = []
    for turn in turns_rad:
        turned = partial.moved(turn, np.zeros(2))
        low = loaded.feet_m.min(0) - turned.feet_m.max(0)
        high = loaded.feet_m.max(0) - turned.feet_m.min(0)
        step = max(reach_m / 2.0, math.sqrt(np.prod(high - low + reach_m) / _CANDIDATES))
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        moves = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        scores = _scores(tree, loaded, turned, moves, reach_m)
        for k in np.argsort(-scores, kind="stable")[:_ROUNDS]:
            tried.append((int(scores[k]), turn, moves[k]))
    tried.sort(key=lambda row: -row[0])
    found = [
        _refine(tree, loaded, partial, *row[1:], reach_m, off_m) for row in tried[: _ROUNDS * 2]
    ]
    best = max(found, key=lambda each: (each.n_same, -each.off_m))
    away = [
        each.n_same
        for each in found
        if np.hypot(*(each.move_m - best.move_m)) > reach_m
        or abs(wrap_angle(each.turn_rad - best.turn_rad)) > _BEARING_RAD
    ]
    return best._replace(runner_up=max(away, default=0))


def _scores(
    tree: "KDTree", loaded: Outline, turned: Outline, moves: np.ndarray, reach_m: float
) -> np.ndarray:
    """Count the walls that match after each displacement, shape ``(moves,)``."""
    scores = []
    at_once = max(1, _QUERIES // len(turned.feet_m))
    for k in range(0, len(moves), at_once):
        feet = turned.feet_m + moves[k : k + at_once, None]
        away, nearest = tree.query(feet, distance_upper_bound=reach_m)
        met = np.isfinite(away)  # where nothing is near, the index is one past the last
        bearings = loaded.bearing_rad[np.where(met, nearest, 0)]
        alike = np.abs(wrap_angles(turned.bearing_rad - bearings)) < _BEARING_RAD
        scores.append((met & alike).sum(1))
    return np.concatenate(scores)


def _refine(
    tree: "KDTree",
    loaded: Outline,
    partial: Outline,
    turn: float,
    move: np.ndarray,
    reach_m: float,
    off_m: float,
) -> OutlineAlignment:
    width, n_same, residual, spread = reach_m, 0, math.inf, 0.0
    for _ in range(_ROUNDS):
        moved = partial.moved(turn, move)
        near = tree.query_ball_point(moved.feet_m, 1.5 * reach_m)
        rows = []  # for each wall the foot nearest across it
        for k, candidates in enumerate(near):
            if not candidates:
                continue
            c = np.array(candidates)
            half = wrap_angles(loaded.bearing_rad[c] - moved.bearing_rad[k]) / 2.0
            gamma = moved.bearing_rad[k] + half
            normal = np.column_stack([np.cos(gamma), np.sin(gamma)])
            across = ((moved.feet_m[k] - loaded.feet_m[c]) * normal).sum(1)
            across[np.abs(half) > _BEARING_RAD / 2.0] = math.inf
            b = int(np.argmin(np.abs(across)))
            if abs(across[b]) < width:
                rows.append((*moved.feet_m[k], *normal[b], across[b]))
        if len(rows) < _LEAST_WALLS:
            return OutlineAlignment(turn, move, len(rows), math.inf, 0, 0.0)
        table = np.array(rows)
        feet, normals, across = table[:, :2], table[:, 2:4], table[:, 4]
        centre = feet.mean(0)
        lever = (feet - centre)[:, 0] * normals[:, 1] - (feet - centre)[:, 1] * normals[:, 0]
        # A prior fixes what walls leave open, such as the rotation of a circle.
        system = np.column_stack([normals, lever])
        prior = np.diag([1e-6, 1e-6, 1.0])
        step = np.linalg.solve(system.T @ system + prior, -system.T @ across)
        move = rotation_matrix(step[2]) @ (move - centre) + centre + step[:2]
        turn = wrap_angle(turn + float(step[2]))
        n_same = int((np.abs(across) < off_m).sum())
        same = np.abs(across) < off_m
        residual = float(np.sqrt(np.mean(np.square(across[same])))) if same.any() else math.inf
        spread = float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])
        width = max(off_m, width / 2.0)
    return OutlineAlignment(turn, move, n_same, residual, 0, spread)


def match_walls(
    outlines: tuple[Outline, Outline],
    maps: tuple[np.ndarray, np.ndarray],
    config: BrainConfig,
    *,
    compass: bool,
) -> tuple[Match | None, str]:
    """Find the alignment of two maps by the walls that both sessions remember.

    Args:
        outlines: Of the loaded session and of the partial one.
        maps: Poses of their experiences, ``(n, 3)`` each.
        config: Of both.
        compass: Whether both had a compass, so that no rotation is needed.

    Returns:
        The match, or ``None``; and a sentence on how it was found, or why not.
    """
    counts = [len(outline.feet_m) for outline in outlines]
    needed = max(_LEAST_WALLS, math.ceil(_LEAST_SHARE * min(counts)))
    if min(counts) < _LEAST_WALLS:
        return None, (
            f"the maps remember {counts[0]} and {counts[1]} wall segments; both need "
            f"{_LEAST_WALLS} to be aligned"
        )
    memory = config.wall_memory
    turns = [0.0] if compass else [TWO_PI * k / _TURNS for k in range(_TURNS)]
    off_m = _OFF_SIGMAS * memory.sigma_m
    best = align_outlines(*outlines, turns, memory.spread_m, off_m)
    aligned = (
        f"{best.n_same} of {counts[1]} wall segments align with the other map's, "
        f"residual {best.off_m:.3f} m"
    )
    if best.n_same < needed:
        return None, f"at most {aligned}; at least {needed} must"
    most_m = largest_residual(best.n_same / min(counts), memory.sigma_m)
    if best.off_m > most_m:
        return None, (
            f"{aligned}; where so many align, walls of one place leave at most {most_m:.3f} m; "
            "longer sessions remember their walls more exactly"
        )
    if best.spread < _LEAST_SPREAD:
        return (
            None,
            f"{aligned}, but they are all parallel, which leaves the position along them open",
        )
    if best.runner_up > _CLEARLY * best.n_same:
        return None, f"{aligned}, but {best.runner_up} do in another alignment too"
    match = _same_experiences(maps, best, config.place_cells.threshold_m)
    if match is None:
        return None, f"{aligned}, but no experience of one is near an experience of the other"
    n = len(match.pairs.partial)
    return match, f"{aligned}; {counted(n, 'experience is', 'experiences are')} the same"


def largest_residual(share: float, sigma_m: float) -> float:
    r"""Return the largest RMS residual with which two maps can be of one place, metres.

    .. math:: \sigma\,\Bigl(0.85 + (1.2 - 0.85)\,\frac{[p - 0.85]_+}{1 - 0.85}\Bigr)

    Drift bends the maps of short sessions by some centimetres, but nearly all walls of one place
    match; those of another that is alike do not.

    Args:
        share: :math:`p`, walls that match over those of the smaller map; above 1 as 1.
        sigma_m: :math:`\sigma`, standard deviation of a remembered wall.

    Example:
        >>> [round(largest_residual(share, 0.02), 4) for share in (0.6, 0.925, 1.2)]
        [0.017, 0.0205, 0.024]
    """
    least, most = _RMS_SIGMAS
    part = max(min(share, 1.0) - _MOST, 0.0) / (1.0 - _MOST)
    return sigma_m * (least + (most - least) * part)


def outline_of(x: Tensor, y: Tensor, bearing_rad: Tensor, distance_m: Tensor) -> Outline:
    """Return the outline of walls: anchors, bearings and distances, ``(n,)`` each."""
    columns = (x, y, bearing_rad, distance_m)
    at_x, at_y, bearing, distance = (column.numpy(force=True) for column in columns)
    feet = np.column_stack([at_x + distance * np.cos(bearing), at_y + distance * np.sin(bearing)])
    return Outline(feet, bearing)


def _same_experiences(
    maps: tuple[np.ndarray, np.ndarray], alignment: OutlineAlignment, threshold_m: float
) -> Match | None:
    """Pair experiences that are nearer than the smallest distance of two place cells."""
    from scipy.spatial import KDTree

    loaded, partial = maps
    moved = Outline(partial[:, :2], partial[:, 2]).moved(alignment.turn_rad, alignment.move_m)
    away, nearest = map(np.asarray, KDTree(loaded[:, :2]).query(moved.feet_m))
    same = np.flatnonzero(away < threshold_m)
    if not len(same):
        return None
    turns = wrap_angles(moved.bearing_rad[same] - loaded[nearest[same], 2])
    pairs = Pairs(same, nearest[same], turns, away[same])
    best = int(np.argmin(away[same]))
    z = same[best]
    x_m, y_m = moved.feet_m[z]
    return Match(
        int(nearest[z]),
        int(z),
        float(turns[best]),
        others=pairs,
        onto=Pose(float(x_m), float(y_m), float(moved.bearing_rad[z])),
    )
