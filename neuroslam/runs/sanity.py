"""Warnings about the units of a run: speeds that no robot or animal has, jumps, centimetres."""

from collections.abc import Mapping

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.errors import counted
from neuroslam.sensors.tracks import time_text
from neuroslam.state.registry import leading_class

FASTEST_ROBOT_M_S = 50.0
FASTEST_ANIMAL_M_S = 3.0

_FASTEST_TURN_RAD_S = 10.0
_SHORTEST_STEP_S = 1e-4  # ten thousand frames a second
_FEW = 0.01  # share of the frames that are single jumps, not a unit
_JUMP = 10.0  # times the usual speed
_LEAST_M_S = 1.0  # speed of a jump below the limit
_WRONG_UNITS = ((30.0, 300.0, "centimetres"), (300.0, 3000.0, "millimetres"))


def is_animal(source: str, config: BrainConfig) -> bool:
    """Return whether a run is that of an animal: of a track of positions, or led by place cells.

    Example:
        >>> is_animal("rat.npz", BrainConfig()), is_animal("drive.avi", BrainConfig())
        (True, False)
    """
    name = source.lower().partition("?")[0]
    return (
        name.endswith((".npz", ".npy"))
        or name.startswith("arena:")
        or leading_class(config).kind == "place"
    )


def unit_warnings(trace: Mapping[str, np.ndarray], animal: bool) -> list[str]:
    """Return what is impossible in the measured motion of a run, a line each.

    Args:
        trace: ``time_s``, ``dt_s``, ``v_m_s``, ``w_rad_s`` of each frame, ``(n,)``, and the true
            pose, ``truth_x_m`` and ``truth_y_m``, NaN where it is unknown.
        animal: Whether the limit of speed is that of an animal, 3 m/s, or that of a vehicle,
            50 m/s.

    Example:
        >>> n, known = np.ones(100), np.full(100, np.nan)
        >>> unit_warnings({"time_s": n.cumsum(), "dt_s": n, "v_m_s": 20 * n, "w_rad_s": 0 * n,
        ...     "truth_x_m": known, "truth_y_m": known}, animal=True)[0][:49]
        'speeds of 20 m/s (median 20 m/s), above 3 m/s in '
    """
    speed, dt = np.abs(trace["v_m_s"]), trace["dt_s"]
    if not len(speed):
        return []
    warnings = _speeds(trace, speed, dt, animal)
    step_s = float(np.median(dt[1:])) if len(dt) > 1 else _SHORTEST_STEP_S
    if 0.0 < step_s < _SHORTEST_STEP_S:
        warnings.append(
            f"times advance by {step_s:.3g} s a frame; expected at least {_SHORTEST_STEP_S:g} s: "
            "are they in days, hours or minutes?"
        )
    turn = float(np.quantile(np.abs(trace["w_rad_s"]), 0.95))
    if turn > _FASTEST_TURN_RAD_S and not animal:  # the heading of a tracked animal is noisy
        warnings.append(
            f"turn rates of {turn:.3g} rad/s; expected at most {_FASTEST_TURN_RAD_S:g} rad/s: are "
            "they in degrees?"
        )
    return warnings + _scale(trace, speed * dt)


def _speeds(
    trace: Mapping[str, np.ndarray], speed: np.ndarray, dt: np.ndarray, animal: bool
) -> list[str]:
    limit = FASTEST_ANIMAL_M_S if animal else FASTEST_ROBOT_M_S
    moving = speed[speed > 0.0]
    if not len(moving):
        return []
    usual, most = float(np.median(moving)), max(1, int(_FEW * len(speed)))
    jumps = speed > np.maximum(_LEAST_M_S, _JUMP * np.quantile(moving, 1.0 - 2.0 * _FEW))
    jumps |= (speed > limit) & (speed > _JUMP * usual)
    n_jumps, fast = int(jumps.sum()), speed > limit
    if 0 < n_jumps <= most and not (fast & ~jumps).any():
        at = int(np.argmax(np.where(jumps, speed * dt, 0.0)))
        when = time_text(float(trace["time_s"][at]))
        return [
            f"{counted(n_jumps, 'jump')} in the motion, the largest {speed[at] * dt[at]:.3g} m "
            f"within {dt[at]:.3g} s ({speed[at]:.3g} m/s) at {when}; "
            f"the median speed is {usual:.3g} m/s"
        ]
    if not fast.any():
        return []
    who = "an animal" if animal else "a robot or car"
    return [
        f"speeds of {speed.max():.3g} m/s (median {usual:.3g} m/s), above {limit:g} m/s in "
        f"{counted(int(fast.sum()), 'frame')}; expected at most {limit:g} m/s of {who}: are they "
        f"in {'centimetres' if animal else 'centimetres, millimetres or km/h'}?"
    ]


def _scale(trace: Mapping[str, np.ndarray], steps_m: np.ndarray) -> list[str]:
    """Compare the lengths of the measured and the true path."""
    true = np.hypot(np.diff(trace["truth_x_m"]), np.diff(trace["truth_y_m"]))
    known = np.isfinite(true)
    true_m, measured_m = float(true[known].sum()), float(steps_m[1:][known].sum())
    if known.sum() < 10 or not (true_m > 0.0 and measured_m > 0.0):
        return []
    for low, high, unit in _WRONG_UNITS:
        for ratio, what in ((measured_m / true_m, "motion"), (true_m / measured_m, "truth")):
            if low <= ratio < high:
                return [
                    f"the motion covers {measured_m:.4g} m, the truth {true_m:.4g} m: is the "
                    f"{what} in {unit}?"
                ]
    return []
