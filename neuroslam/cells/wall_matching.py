"""Where do two maps meet that have no views? Their remembered walls are laid on each other."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from neuroslam.merging.merge import Match
from neuroslam.errors import counted
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.mapping.overlap import Pairs
from neuroslam.types import Pose

if TYPE_CHECKING:
    from neuroslam.brain.brain import NavigationBrain

_LEAST_WALLS = 6
_LEAST_SHARE = 0.6  # of the smaller memory's walls must find their like
_CLEARLY = 0.85  # any other way to lay the maps may explain so many of those at most
_BEARING_RAD = math.radians(15.0)
_OFF_SIGMAS = 2.5  # of a wall's distance: farther off is another wall
_RMS_SIGMAS = 0.85  # by which all together may be off
_LEAST_SPREAD = 0.08  # of normals: else the maps slide along parallel walls
_TURNS = 12
_CANDIDATES = 20_000
_ROUNDS = 12


class Outline(NamedTuple):
    """Feet of the perpendiculars on remembered walls, ``(n, 2)`` m, and their bearings, rad."""

    feet_m: np.ndarray
    bearing_rad: np.ndarray

    def moved(self, turn_rad: float, move_m: np.ndarray) -> "Outline":
        """Turn about the origin, then move."""
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        turn = np.array([[c, -s], [s, c]])
        return Outline(self.feet_m @ turn.T + move_m, wrap_angles(self.bearing_rad + turn_rad))


class Laid(NamedTuple):
    """How one outline lies in another.

    Attributes:
        turn_rad: By how much it is turned about its origin.
        move_m: And then moved, ``(2,)``.
        n_same: Walls that find their like then.
        off_m: By how much those are off, root mean square.
        runner_up: Most walls that any other way to lay it explains.
        spread: How well the walls' normals fix both directions, 0 to 0.5.
    """

    turn_rad: float
    move_m: np.ndarray
    n_same: int
    off_m: float
    runner_up: int
    spread: float


def lay_walls(
    loaded: Outline, partial: Outline, turns_rad: list[float], reach_m: float, off_m: float
) -> Laid:
    r"""Find the motion that lays one outline on another, by trying all and refining the best.

    A wall finds its like where a foot of the other outline with that bearing is within ``reach_m``
    along the wall and ``off_m`` across it. The refinement solves

    .. math:: \min_{\phi, t} \sum_k \big((R(\phi) f_k + t - g_k) \cdot \mathbf n_k\big)^2

    over the walls that have (point-to-line ICP).

    Args:
        loaded: Outline that stays.
        partial: Outline that is moved; not empty, as the other.
        turns_rad: Turns to try.
        reach_m: Stretch of a wall that is one memory.
        off_m: Largest distance of two walls that are the same.
    """
    tree = cKDTree(loaded.feet_m)
    tried: list[tuple[int, float, np.ndarray]] = []
    for turn in turns_rad:
        turned = partial.moved(turn, np.zeros(2))
        low = loaded.feet_m.min(0) - turned.feet_m.max(0)
        high = loaded.feet_m.max(0) - turned.feet_m.min(0)
        step = max(reach_m / 2.0, math.sqrt(np.prod(high - low + reach_m) / _CANDIDATES))
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        moves = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        scores = np.array([_score(tree, loaded, turned, move, reach_m) for move in moves])
        for k in np.argsort(-scores, kind="stable")[:_ROUNDS]:
            tried.append((int(scores[k]), turn, moves[k]))
    tried.sort(key=lambda row: -row[0])
    found = [
        _refine(tree, loaded, partial, *row[1:], reach_m, off_m) for row in tried[: _ROUNDS * 2]
    ]
    best = max(found, key=lambda laid: (laid.n_same, -laid.off_m))
    away = [
        laid.n_same
        for laid in found
        if np.hypot(*(laid.move_m - best.move_m)) > reach_m
        or abs(wrap_angle(laid.turn_rad - best.turn_rad)) > _BEARING_RAD
    ]
    return best._replace(runner_up=max(away, default=0))


def _score(
    tree: cKDTree, loaded: Outline, turned: Outline, move: np.ndarray, reach_m: float
) -> int:
    away, nearest = tree.query(turned.feet_m + move, distance_upper_bound=reach_m)
    met = np.isfinite(away)
    bearings = loaded.bearing_rad[nearest[met]]
    return int((np.abs(wrap_angles(turned.bearing_rad[met] - bearings)) < _BEARING_RAD).sum())


def _refine(
    tree: cKDTree,
    loaded: Outline,
    partial: Outline,
    turn: float,
    move: np.ndarray,
    reach_m: float,
    off_m: float,
) -> Laid:
    width, n_same, residual, spread = reach_m, 0, math.inf, 0.0
    for _ in range(_ROUNDS):
        moved = partial.moved(turn, move)
        near = tree.query_ball_point(moved.feet_m, 1.5 * reach_m)
        rows = []  # of each wall the foot that is the least across it
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
            return Laid(turn, move, len(rows), math.inf, 0, 0.0)
        table = np.array(rows)
        feet, normals, across = table[:, :2], table[:, 2:4], table[:, 4]
        centre = feet.mean(0)
        lever = (feet - centre)[:, 0] * normals[:, 1] - (feet - centre)[:, 1] * normals[:, 0]
        # A prior keeps what the walls do not fix, as the turn of a circle, where it was.
        system = np.column_stack([normals, lever])
        prior = np.diag([1e-6, 1e-6, 1.0])
        step = np.linalg.solve(system.T @ system + prior, -system.T @ across)
        c, s = math.cos(step[2]), math.sin(step[2])
        turning = np.array([[c, -s], [s, c]])
        move = turning @ (move - centre) + centre + step[:2]
        turn = wrap_angle(turn + float(step[2]))
        n_same = int((np.abs(across) < off_m).sum())
        same = np.abs(across) < off_m
        residual = float(np.sqrt(np.mean(np.square(across[same])))) if same.any() else math.inf
        spread = float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])
        width = max(off_m, width / 2.0)
    return Laid(turn, move, n_same, residual, 0, spread)


def match_walls(loaded: "NavigationBrain", partial: "NavigationBrain") -> tuple[Match | None, str]:
    """Look for how the walls that two animals remember lie on each other.

    Args:
        loaded: One brain with place cells; it is not altered.
        partial: The other; it is not altered.

    Returns:
        Where the maps meet, or ``None``; and how that was found, or why not, for a reader.
    """
    outlines = [outline_of(brain) for brain in (loaded, partial)]
    counts = [len(outline.feet_m) for outline in outlines]
    needed = max(_LEAST_WALLS, math.ceil(_LEAST_SHARE * min(counts)))
    if min(counts) < _LEAST_WALLS:
        return None, (
            f"the maps remember {counts[0]} and {counts[1]} stretches of wall; both need "
            f"{_LEAST_WALLS} to be laid on each other"
        )
    config = partial.config.wall_memory
    compass = all(brain.navigation.now.compass for brain in (loaded, partial))
    turns = [0.0] if compass else [TWO_PI * k / _TURNS for k in range(_TURNS)]
    off_m = _OFF_SIGMAS * config.sigma_m
    laid = lay_walls(*outlines, turns, config.spread_m, off_m)
    said = (
        f"{laid.n_same} of {counts[1]} stretches of wall lie on those of the other map, off by "
        f"{laid.off_m:.3f} m"
    )
    if laid.n_same < needed:
        return None, f"at most {said}; {needed} must"
    if laid.off_m > _RMS_SIGMAS * config.sigma_m:
        return None, f"{said}; walls of one place would be by {_RMS_SIGMAS * config.sigma_m:.3f} m"
    if laid.spread < _LEAST_SPREAD:
        return None, f"{said}, but they are all parallel: the maps could slide along them"
    if laid.runner_up > _CLEARLY * laid.n_same:
        return None, f"{said}, but {laid.runner_up} do when the map is laid quite otherwise too"
    match = _places(loaded, partial, laid)
    if match is None:
        return None, f"{said}, but no place of one is near a place of the other"
    return match, f"{said}; {counted(len(match.pairs.partial), 'place is', 'places are')} the same"


def outline_of(brain: "NavigationBrain") -> Outline:
    """Return the feet of the walls that a brain remembers."""
    walls = brain.navigation.walls.remembered()[0]
    x, y, bearing, distance = (column.numpy(force=True) for column in walls[:4])
    feet = np.column_stack([x + distance * np.cos(bearing), y + distance * np.sin(bearing)])
    return Outline(feet, bearing)


def _places(loaded: "NavigationBrain", partial: "NavigationBrain", laid: Laid) -> Match | None:
    """Pair the places that are nearer than two place cells of one map may be."""
    poses = partial.map.poses
    moved = Outline(poses[:, :2], poses[:, 2]).moved(laid.turn_rad, laid.move_m)
    away, nearest = cKDTree(loaded.map.poses[:, :2]).query(moved.feet_m)
    same = np.flatnonzero(away < partial.config.place_cells.threshold_m)
    if not len(same):
        return None
    turns = wrap_angles(moved.bearing_rad[same] - loaded.map.poses[nearest[same], 2])
    pairs = Pairs(same, nearest[same], turns, away[same])
    best = int(np.argmin(away[same]))
    z = same[best]
    return Match(
        int(nearest[z]),
        int(z),
        float(turns[best]),
        others=pairs,
        onto=Pose(*moved.feet_m[z].tolist(), float(moved.bearing_rad[z])),
    )
