"""Difference of two maps whose points are not paired: iterative closest points in the plane."""

import math
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from neuroslam.errors import MapError
from neuroslam.evaluation.trajectory import Alignment, align
from neuroslam.geometry import rotation_matrix

IcpMode = Literal["rigid", "similarity"]

# A source shrunk onto one target point has error 0: an unbounded scale goes towards 0, and short
# of it a shrunken map fits better than one of the right size. So the scale stays within this
# factor of the initial scale, or in map_rmse of the ratio of the two maps' RMS radii. For fixed
# pairs the error is a parabola in the scale and the best rotation does not depend on it, so the
# scale clipped to the bound is the best one within it: the error still falls with every step.
SCALE_FACTOR = 1.5
"""Largest ratio of the scale of an alignment and the initial one."""

_N_ROTATIONS = 24  # 15 degrees apart: no start is more than 7.5 degrees off
_N_COARSE_POINTS = 300
_N_COARSE_ITERATIONS = 20
_N_REFINED = 3

_Scales = tuple[float, float]


class IcpResult(NamedTuple):
    """The best alignment of a source map to a target map.

    Attributes:
        alignment: Maps source points onto the target.
        rmse: In metres of the target, over all source points, each to its nearest target point.
        n_iterations: Steps of the optimisation.
        converged: Whether the last step lowered the RMSE by no more than the tolerance.
        pairs: Index of the target point nearest to every source point, ``(n,)``.
    """

    alignment: Alignment
    rmse: float
    n_iterations: int
    converged: bool
    pairs: np.ndarray


def icp(
    source_xy: np.ndarray,
    target_xy: np.ndarray,
    mode: IcpMode = "rigid",
    initial: Alignment | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-10,
) -> IcpResult:
    r"""Align a map to another by pairing nearest points and aligning the pairs, in turn.

    .. math:: \mathrm{RMSE}^2 = \min_{c, R, t} \frac1n \sum_i \min_j
              \lVert y_j - (c R x_i + t) \rVert^2

    Point to point, by P. J. Besl and N. D. McKay, "A method for registration of 3-D shapes", IEEE
    PAMI 14(2), 1992. No pair is rejected, whatever its distance. The result is the local minimum
    nearest to the start; :func:`map_rmse` tries many starts.

    Args:
        source_xy: Points :math:`x_i`, ``(n, 2)``, metres (of any size in mode ``similarity``).
        target_xy: Points :math:`y_j`, ``(m, 2)``, metres.
        mode: ``rigid`` keeps :math:`c = 1`; ``similarity`` finds it within a factor of
            :data:`SCALE_FACTOR` of the initial scale, so that the source cannot shrink to a point.
        initial: Alignment to start from; ``None`` is the identity.
        max_iterations: Steps at most; 0 only measures the start.
        tolerance: Stop after a step that lowers the RMSE by no more than this, in metres.

    Raises:
        MapError: If a shape is not ``(n, 2)``, a number is not finite, a map has fewer than two
            distinct points, or the initial alignment does not fit the mode.

    Example:
        >>> corner = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
        >>> found = icp(corner + [0.5, -0.25], corner)
        >>> found.converged, found.alignment.translation.round(9).tolist()
        (True, [-0.5, 0.25])
    """
    source, target = _as_map("source", source_xy), _as_map("target", target_xy)
    _check_mode(mode)
    if initial is None:
        initial = Alignment(np.eye(2), np.zeros(2), 1.0)
    _check_initial(initial, mode)
    scales = _scales_about(initial.scale)
    return _descend(
        source, target, KDTree(target), mode, initial, scales, max_iterations, tolerance
    )


def map_rmse(source_xy: np.ndarray, target_xy: np.ndarray, mode: IcpMode = "rigid") -> IcpResult:
    """Compare two maps of unknown relative pose: the best :func:`icp` of many starts.

    The starts align the centres and principal axes and turn from there in steps of 15 degrees.
    Each makes some steps with a subset of the source; the best of them, and the identity, converge
    with all of it. The maps should cover the same area: a map that covers a part of the other
    needs :func:`icp` from a start near the solution. Along a single path of sparse points the
    search may stop a fraction of their spacing away from the best.

    Args:
        source_xy: Points ``(n, 2)``, metres (of any size in mode ``similarity``).
        target_xy: Points ``(m, 2)``, metres.
        mode: As in :func:`icp`, but the scale stays within a factor of :data:`SCALE_FACTOR` of the
            ratio of the RMS radii. If 1 is within it, the RMSE is not above that of ``rigid``.

    Raises:
        MapError: As :func:`icp`.

    Example:
        >>> hook = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [4.0, 1.0]])
        >>> upside_down_and_small = [9.0, 5.0] - 0.1 * hook
        >>> found = map_rmse(upside_down_and_small, hook, "similarity")
        >>> round(found.rmse, 9), round(found.alignment.scale, 9)
        (0.0, 10.0)
    """
    source, target = _as_map("source", source_xy), _as_map("target", target_xy)
    _check_mode(mode)
    tree = KDTree(target)
    ratio = _rms_radius(target) / _rms_radius(source) if mode == "similarity" else 1.0
    scales = _scales_about(ratio)

    every = np.linspace(0, len(source) - 1, min(len(source), _N_COARSE_POINTS)).round()
    part = source[every.astype(np.int64)]
    coarse = [
        _descend(part, target, tree, mode, start, scales, _N_COARSE_ITERATIONS, 0.0)
        for start in _turned_starts(source, target, ratio)
    ]
    starts = [result.alignment for result in _best_distinct(coarse)]
    if mode == "rigid":
        starts.append(Alignment(np.eye(2), np.zeros(2), 1.0))
    elif scales[0] <= 1.0 <= scales[1]:
        starts.append(map_rmse(source, target, "rigid").alignment)
    refined = [_descend(source, target, tree, mode, start, scales) for start in starts]
    return min(refined, key=lambda result: result.rmse)


def fraction_of_diagonal(rmse: float, target_xy: np.ndarray) -> float:
    """Express an RMSE in metres as a fraction of the diagonal of the target's bounding box.

    Raises:
        MapError: If the target is not a valid map, as :func:`icp`.

    Example:
        >>> fraction_of_diagonal(0.5, np.array([[0.0, 0.0], [3.0, 4.0]]))
        0.1
    """
    return rmse / float(np.linalg.norm(np.ptp(_as_map("target", target_xy), axis=0)))


def _descend(
    source: np.ndarray,
    target: np.ndarray,
    tree: KDTree,
    mode: IcpMode,
    alignment: Alignment,
    scales: _Scales,
    max_iterations: int = 200,
    tolerance: float = 1e-10,
) -> IcpResult:
    pairs, rmse = _pair(tree, alignment.apply(source))
    n_iterations, converged = 0, False
    while n_iterations < max_iterations and not converged:
        alignment = _align_pairs(source, target[pairs], mode, alignment, scales)
        before, last_pairs = rmse, pairs
        pairs, rmse = _pair(tree, alignment.apply(source))
        n_iterations += 1
        # The alignment follows from the pairs: the same pairs again are a fixed point.
        converged = before - rmse <= tolerance or np.array_equal(pairs, last_pairs)
    return IcpResult(alignment, rmse, n_iterations, converged, pairs)


def _pair(tree: KDTree, moved: np.ndarray) -> tuple[np.ndarray, float]:
    distances, pairs = map(np.asarray, tree.query(moved))
    return pairs, math.sqrt(float(np.mean(np.square(distances))))


def _align_pairs(
    source: np.ndarray, paired: np.ndarray, mode: IcpMode, last: Alignment, scales: _Scales
) -> Alignment:
    try:
        rotation, _, scale = align(source, paired, mode)
    except MapError:  # all nearest to one point: any rotation fits equally, the last one stays
        rotation, _, scale = last
    if mode == "similarity":
        scale = min(max(scale, scales[0]), scales[1])
    mean_x, mean_y = source.mean(axis=0), paired.mean(axis=0)
    return Alignment(rotation, mean_y - scale * rotation @ mean_x, scale)  # Umeyama, Eq. 41


def _turned_starts(source: np.ndarray, target: np.ndarray, scale: float) -> list[Alignment]:
    # The principal axes have no direction, so the starts cover the full turn.
    first = _principal_angle(target) - _principal_angle(source)
    starts = []
    for angle in first + np.arange(_N_ROTATIONS) * (2.0 * math.pi / _N_ROTATIONS):
        rotation = rotation_matrix(angle)
        shift = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
        starts.append(Alignment(rotation, shift, scale))
    return starts


def _best_distinct(results: list[IcpResult]) -> list[IcpResult]:
    # Many starts converge to the same minimum; only the lowest of them is refined.
    kept: list[IcpResult] = []
    same = math.cos(math.pi / _N_ROTATIONS)  # closer than half a step of the grid
    for result in sorted(results, key=lambda result: result.rmse):
        # Half the trace of R'S is the cosine of the angle between two plane rotations.
        turns = [np.sum(result.alignment.rotation * k.alignment.rotation) / 2.0 for k in kept]
        if all(turn < same for turn in turns):
            kept.append(result)
        if len(kept) == _N_REFINED:
            break
    return kept


def _principal_angle(points: np.ndarray) -> float:
    x, y = (points - points.mean(axis=0)).T
    return 0.5 * math.atan2(2.0 * float(x @ y), float(x @ x - y @ y))


def _rms_radius(points: np.ndarray) -> float:
    return math.sqrt(float(np.square(points - points.mean(axis=0)).sum(axis=1).mean()))


def _scales_about(scale: float) -> _Scales:
    return scale / SCALE_FACTOR, scale * SCALE_FACTOR


def _as_map(name: str, points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise MapError(f"icp: the {name} has shape {points.shape}, expected (n, 2) positions")
    if not np.isfinite(points).all():
        at = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise MapError(f"icp: point {at} of the {name} is not finite; leave it out")
    # Relative to the coordinates, as in align: smaller differences are rounding.
    if not len(points) or np.ptp(points, axis=0).max() <= 1e-12 * np.abs(points).max():
        raise MapError(
            f"icp: the {name} has {len(points)} point(s), all equal; expected at least 2 distinct "
            "points, which fix a rotation"
        )
    return points


def _check_mode(mode: str) -> None:
    if mode not in ("rigid", "similarity"):
        raise MapError(f"icp: mode is {mode!r}, expected 'rigid' or 'similarity'")


def _check_initial(initial: Alignment, mode: IcpMode) -> None:
    rotation, translation = np.asarray(initial.rotation), np.asarray(initial.translation)
    if rotation.shape != (2, 2) or translation.shape != (2,):
        raise MapError(
            f"icp: the initial alignment has shapes {rotation.shape} and {translation.shape}, "
            "expected (2, 2) and (2,)"
        )
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise MapError("icp: the initial alignment is not finite; give None to start unmoved")
    if not 0.0 < initial.scale < math.inf:
        raise MapError(f"icp: the initial scale is {initial.scale:g}, expected above 0")
    if mode == "rigid" and initial.scale != 1.0:
        raise MapError(
            f"icp: the initial scale is {initial.scale:g}, but mode 'rigid' keeps 1; "
            "use mode 'similarity'"
        )
