"""Resamples the scan of a laser to bearings evenly over the full turn, the ranges of a frame."""

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.geometry import TWO_PI, wrap_angles

N_RANGES = 360
"""Number of bearings to which a scan is resampled, evenly over the full turn."""

_MOST_RAD = 1.1 * TWO_PI  # some lasers cover a turn and a little more
_LEAST_RAD = 1e-6  # step of a scan with six million beams


def full_turn(
    ranges: np.ndarray, first_rad: float, step_rad: float, min_m: float, max_m: float
) -> np.ndarray:
    """Resample a scan to bearings evenly over the full turn.

    Args:
        ranges: Distances in metres, ``(n,)``.
        first_rad: Bearing of the first beam, positive to the left.
        step_rad: Angle from beam to beam.
        min_m: Shorter distances are invalid.
        max_m: Longer distances are invalid.

    Returns:
        Distances at ``N_RANGES`` bearings, counter-clockwise from straight ahead: that of the beam
        nearest in bearing; ``inf`` if no beam is within one step, or its distance is invalid.

    Raises:
        BadFrame: If there are no beams, or their bearings are not numbers or exceed a turn.

    Example:
        >>> turn = full_turn(np.array([1.0, 2.0, 3.0]), -np.pi / 2, np.pi / 2, 0.1, 10.0)
        >>> turn[[270, 0, 90, 180]].tolist()
        [1.0, 2.0, 3.0, inf]
    """
    distances = np.asarray(ranges, np.float64)
    if not (len(distances) and np.isfinite(first_rad) and np.isfinite(step_rad) and step_rad):
        raise BadFrame(
            f"scan of {len(distances)} beams from {first_rad} rad in steps of {step_rad} rad; "
            "expected beams in steps other than 0"
        )
    extent = abs(step_rad) * (len(distances) - 1)
    if extent > _MOST_RAD or abs(first_rad) > _MOST_RAD or abs(step_rad) < _LEAST_RAD:
        raise BadFrame(
            f"scan of {len(distances)} beams from {first_rad:.4g} rad in steps of {step_rad:.4g} "
            "rad; expected one turn: are its angles in degrees?"
        )
    distances = np.where((distances >= min_m) & (distances <= max_m), distances, np.inf)
    bearings = np.arange(N_RANGES) * (TWO_PI / N_RANGES)
    middle = first_rad + 0.5 * step_rad * (len(distances) - 1)
    offset = wrap_angles(bearings - middle) + (middle - first_rad)
    beam = np.rint(offset / step_rad).astype(np.int64)
    covered = (beam >= 0) & (beam < len(distances))
    return np.where(covered, distances[beam.clip(0, len(distances) - 1)], np.inf)
