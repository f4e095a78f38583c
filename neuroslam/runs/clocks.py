"""Joint initialisation of a camera, a source of motion and a compass: clocks and scales.

Their turn rates show the offsets of their clocks, and how visual odometry must be scaled.
"""

import math
from typing import NamedTuple

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame, RunError, SourceError, counted
from neuroslam.odometry import visual_odometry
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.open import pair_of, with_offset
from neuroslam.sensors.tracks import time_text

_LEAST_CORRELATION = 0.3
"""Below it the turn rates do not agree."""

_LEAST_DEVIATIONS = 4.0
"""Of the correlation by chance, see :func:`_chance`: all offsets are tried, the best is taken."""

_LEAST_OVERLAP = 0.5
"""Of the shorter recording, at the offsets that are tried."""

_SECOND_BEST = 0.95
"""Another offset whose score is above this share of the best makes the offset ambiguous."""

_MOST_SAMPLES = 2_000_000
"""More than a day at 20 Hz: a longer span is a wrong time."""

_APART_S = 1.0
"""Offsets nearer than this to each other are one."""


_FIRST_S = 600.0
"""Of the camera's recording, which takes long to read: offset and scales do not change."""

_WINDOW_S = 1.0
"""Motion is compared over windows of this duration, which average single measurements."""


class Turns(NamedTuple):
    """Motion of a recording: ``turned_rad[k]`` from ``times_s[k]`` to ``times_s[k + 1]``.

    ``moved_m`` is the distance in the same intervals; empty where it is not measured.
    """

    times_s: np.ndarray
    turned_rad: np.ndarray
    moved_m: np.ndarray = np.zeros(0)


class Offset(NamedTuple):
    """Offset of the clocks.

    Attributes:
        offset_s: Seconds to add to the times of the motion.
        correlation: Correlation of the two turn rates there.
        overlap_s: Duration that both recordings cover then.
    """

    offset_s: float
    correlation: float
    overlap_s: float


class JointStart(NamedTuple):
    """What the first minutes show about a camera, a source of motion and a compass.

    Attributes:
        offset: Of the clock of the motion to that of the camera.
        turn_scale: Turning by visual odometry over the measured turning; NaN if nothing turned.
        speed_scale: Distance by visual odometry over the measured distance; NaN if unknown.
        compass: Offset of the compass to the motion; ``None`` without one, or if it is not found.
    """

    offset: Offset
    turn_scale: float
    speed_scale: float
    compass: Offset | None


def resolve_offset(
    spec: str, offset: str | float | None, config: BrainConfig
) -> tuple[str, tuple[str, ...]]:
    """Return the name of two sources with an offset of their clocks, and how it was found.

    Args:
        spec: Camera and motion, as ``drive.mp4+motion.csv``.
        offset: Seconds to add to the times of the motion, ``auto`` to find them by the turn rates,
            or ``None`` for the name as it is.
        config: Config of the brain: visual odometry measures the turn rates of the camera.

    Raises:
        SourceError: If there are no two sources, or ``offset`` is no number of seconds.
        RunError: If no offset is found.
    """
    if offset is None:
        return spec, ()
    if offset != "auto":
        try:
            offset_s = float(offset)
        except ValueError:
            offset_s = math.nan
        if not math.isfinite(offset_s):
            raise SourceError(f"--offset {offset}: expected a number of seconds, or auto")
        return with_offset(spec, repr(offset_s)), ()
    with_offset(spec, 0.0)  # two sources, without an offset
    start = find_joint_start(spec, config)
    found, fov_deg = start.offset, config.odometry.fov_deg
    note = (
        f"offset {time_text(found.offset_s)}: added to the times of the motion; the turn rates "
        f"correlate by {found.correlation:.2f} over {time_text(round(found.overlap_s, 2))}"
    )
    notes = [note]
    if start.turn_scale > 0.0:
        notes.append(
            f"scale: visual odometry turns by {start.turn_scale:.2f} of the measured turns; with "
            f"odometry.fov_deg {fov_deg / start.turn_scale:.1f} in place of {fov_deg:g} by as much"
        )
    if start.speed_scale > 0.0:
        notes.append(
            f"scale: visual odometry measures {start.speed_scale:.3g} m per metre; with "
            "odometry.speed_scaling_m_s "
            f"{config.odometry.speed_scaling_m_s / start.speed_scale:.3g} it measures metres"
        )
    if start.compass is not None:
        notes.append(
            f"compass: {time_text(round(start.compass.offset_s, 3))} to add to its times; its "
            f"turns correlate with those of the motion by {start.compass.correlation:.2f}"
        )
    return with_offset(spec, repr(round(found.offset_s, 6))), tuple(notes)


def find_joint_start(spec: str, config: BrainConfig) -> JointStart:
    """Find the offset between the clocks of a camera and of a source of motion, and the scales.

    See :func:`joint_start`.

    Raises:
        SourceError: If a source cannot be opened.
        RunError: If one is live, or the turn rates do not agree at any offset, or as well at
            another.
    """
    parts = pair_of(spec)
    if parts is None:
        raise SourceError(f"{spec}: is one source; expected a camera and motion")
    camera, motion = (open_source(part, config.frame_rate_hz, config.view.grey) for part in parts)
    if camera.live or motion.live:
        raise RunError(f"{spec}: is live; --offset auto reads its sources twice; give seconds")
    try:
        return joint_start(camera, motion, config)
    except SourceError:
        raise
    except ValueError as error:
        raise RunError(f"{spec}: {error}; give --offset S in seconds") from None


def joint_start(camera: Source, motion: Source, config: BrainConfig) -> JointStart:
    """Find offsets of clocks and scales of a camera, a source of motion and its compass.

    Visual odometry measures the motion of the camera in its first ten minutes; see
    :func:`best_offset` and :func:`scale_of`. A compass whose turns agree with those of the motion
    has an offset too, as by the lag of a filter.

    Args:
        camera: A source of images; if it has none, the two are exchanged.
        motion: A source of motion, with or without a compass.
        config: Visual odometry, frames per second.

    Raises:
        ValueError: If the turn rates do not agree at any offset, or as well at another.
    """
    first = next(camera.frames(on_bad_frame=lambda _: None), None)
    if first is not None and first.image is None:
        camera, motion = motion, camera
    seen = _seen(camera, config)
    measured = _measured(motion)
    for source, turns in ((camera, seen), (motion, measured)):
        if len(turns.turned_rad) < 10:
            raise ValueError(
                f"{source.name}: {counted(len(turns.turned_rad), 'turn rate')}; expected at least "
                "10 to find the offset"
            )
    offset = best_offset(seen, measured)
    turn_scale = scale_of(seen, measured, offset.offset_s)
    speed_scale = scale_of(seen, measured, offset.offset_s, "moved_m")
    return JointStart(offset, turn_scale, speed_scale, _compass_offset(motion, measured))


def scale_of(seen: Turns, measured: Turns, offset_s: float, of: str = "turned_rad") -> float:
    r"""Return the motion that a camera sees as a multiple of the measured motion.

    .. math:: k = \frac{\sum_i c_i m_i}{\sum_i m_i^2}

    over windows of a second, so that noise of visual odometry does not bias it.

    Args:
        seen: Motion seen by the camera.
        measured: Motion by its source.
        offset_s: Seconds to add to the times of the motion.
        of: ``turned_rad`` or ``moved_m``.

    Returns:
        The scale; NaN without common windows, or without motion in them.

    Example:
        >>> t = np.arange(0.0, 30.0, 0.1)
        >>> turned = np.random.default_rng(0).normal(0.0, 0.1, len(t) - 1)
        >>> round(scale_of(Turns(t, 0.8 * turned), Turns(t, turned), 0.0), 6)
        0.8
    """
    totals = []
    for turns, late_s in ((seen, 0.0), (measured, offset_s)):
        values = getattr(turns, of)
        if len(values) != len(turns.times_s) - 1:
            return math.nan
        totals.append((turns.times_s + late_s, np.concatenate([[0.0], np.cumsum(values)])))
    first_s, last_s = (max(t[0] for t, _ in totals), min(t[-1] for t, _ in totals))
    windows = np.arange(first_s, last_s + 1e-9, _WINDOW_S)
    if len(windows) < 2:
        return math.nan
    c, m = (np.diff(np.interp(windows, *total)) for total in totals)
    moved = float(m @ m)
    return float(c @ m) / moved if moved > 0.0 else math.nan


def _compass_offset(motion: Source, measured: Turns) -> Offset | None:
    """Return the offset of a source's compass, if its turns agree with the motion."""
    times, headings = [], []
    for frame in motion.frames(on_bad_frame=lambda _: None):
        if frame.heading_rad is not None and not (times and frame.time_s <= times[-1]):
            times.append(frame.time_s)
            headings.append(frame.heading_rad)
    if len(times) < 10:
        return None
    try:
        return best_offset(measured, Turns(np.array(times), np.diff(np.unwrap(headings))))
    except ValueError:
        return None


def best_offset(seen: Turns, measured: Turns) -> Offset:
    r"""Find the time offset at which two turnings correlate best.

    .. math:: \hat\tau = \arg\max_\tau \; r(\tau) \sqrt{n(\tau)}, \quad
              r(\tau) = \mathrm{corr}\bigl(\omega_c(t), \, \omega_m(t - \tau)\bigr)

    with :math:`n` the number of common samples. All offsets are tried on a grid of the camera's
    period by the fast Fourier transform, then those within a period in steps of a twentieth.

    Args:
        seen: Turning seen by the camera.
        measured: Turning by the source of motion.

    Raises:
        ValueError: If the best correlation is below 0.3 or within what chance gives, has the wrong
            sign, or another offset is nearly as good.

    Example:
        >>> t = np.arange(0.0, 30.0, 0.1)
        >>> turned = np.random.default_rng(0).normal(0.0, 0.1, len(t) - 1)
        >>> round(best_offset(Turns(t, turned), Turns(t + 1700000000.25, turned)).offset_s, 6)
        -1700000000.25
    """
    step_s = float(np.clip(np.median(np.diff(seen.times_s)), 0.02, 0.2))
    rates, starts = [], []
    for turns in (seen, measured):
        span_s = turns.times_s[-1] - turns.times_s[0]
        if span_s > _MOST_SAMPLES * step_s:
            raise ValueError(
                f"the times of one of the two span {time_text(float(span_s))}, expected at most "
                f"{time_text(_MOST_SAMPLES * step_s)}"
            )
        grid = np.arange(turns.times_s[0], turns.times_s[-1], step_s)
        heading = np.concatenate([[0.0], np.cumsum(turns.turned_rad)])
        rates.append(np.diff(np.interp(grid, turns.times_s, heading)))
        starts.append(turns.times_s[0])
    if min(map(len, rates)) < 4 or min(np.ptp(rate) for rate in rates) == 0.0:
        raise ValueError("one of the two does not turn, so their turn rates cannot be compared")
    lags, correlation, common = _correlations(*rates)
    enough = common >= _LEAST_OVERLAP * min(map(len, rates))
    score = np.where(enough, correlation * np.sqrt(common), -np.inf)
    best = int(np.argmax(score))
    apart_s = float(starts[0] - starts[1])
    coarse_s = apart_s + float(lags[best]) * step_s
    chance = _chance(rates[0], rates[1], int(common[best]))
    reversed_at = int(np.argmin(np.where(enough, correlation * np.sqrt(common), np.inf)))
    if -correlation[reversed_at] > max(1.2 * correlation[best], _LEAST_DEVIATIONS * chance):
        raise ValueError(
            f"the turn rates of camera and motion correlate by {correlation[reversed_at]:.2f}, so "
            "one has the wrong sign; expected positive turn rates to the left"
        )
    least = max(_LEAST_CORRELATION, _LEAST_DEVIATIONS * chance)
    if least > 1.0:
        raise ValueError(
            "the two turn too evenly, or for too short a time, to tell an offset from chance"
        )
    if correlation[best] < least:
        raise ValueError(
            "the turn rates of camera and motion do not agree at any offset: they correlate by "
            f"{correlation[best]:.2f} at best, expected {least:.2f} or more for so short a time"
        )
    others = np.where(np.abs(lags - lags[best]) * step_s > _APART_S, score, -np.inf)
    second = int(np.argmax(others))
    if others[second] > _SECOND_BEST * score[best]:
        other_s = apart_s + float(lags[second]) * step_s
        raise ValueError(
            f"the turn rates agree at more than one offset, {time_text(coarse_s)} and "
            f"{time_text(other_s)}"
        )
    fine = np.arange(-20, 21) * (step_s / 20.0)
    found = [_correlation_at(seen, measured, coarse_s + shift) for shift in fine]
    at = int(np.argmax(found))
    return Offset(coarse_s + float(fine[at]), found[at], float(common[best]) * step_s)


def _convolved(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Convolve two series by their Fourier transforms; ``scipy.signal`` loads for half a second."""
    n = len(x) + len(y) - 1
    padded = 1 << (n - 1).bit_length()
    return np.fft.irfft(np.fft.rfft(x, padded) * np.fft.rfft(y, padded), padded)[:n]


def _correlations(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlate ``a[i + lag]`` with ``b[i]`` at all lags: lags, correlations, common samples."""
    a, b = a - a.mean(), b - b.mean()
    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))

    def summed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return _convolved(x, y[::-1])

    n = np.maximum(np.round(summed(ones_a, ones_b)), 1.0)
    sum_a, sum_b = summed(a, ones_b), summed(ones_a, b)
    var_a = summed(a * a, ones_b) - sum_a**2 / n
    var_b = summed(ones_a, b * b) - sum_b**2 / n
    scale = np.sqrt(np.maximum(var_a, 0.0) * np.maximum(var_b, 0.0))
    least = 1e-9 * math.sqrt(float((a * a).sum() * (b * b).sum()))
    together = summed(a, b) - sum_a * sum_b / n
    correlation = np.where(scale > least, together / np.maximum(scale, least), 0.0)
    return np.arange(len(n)) - (len(b) - 1), correlation, n


def _chance(a: np.ndarray, b: np.ndarray, n: int) -> float:
    r"""Return the standard deviation of the correlation of two unrelated series, by their memory.

    .. math:: \sigma^2 = \frac1n \sum_k \rho_a(k) \rho_b(k)

    M. S. Bartlett, "Some aspects of the time-correlation problem", J. Royal Stat. Soc. 98, 1935.
    """
    memory = []
    for x in (a - a.mean(), b - b.mean()):
        full = _convolved(x, x[::-1])[len(x) - 1 :]
        memory.append(full / full[0])
    length = min(len(a), len(b)) // 4
    both = memory[0][:length] * memory[1][:length]
    return math.sqrt(max(1.0, 2.0 * float(both.sum()) - 1.0) / n)


def _correlation_at(seen: Turns, measured: Turns, offset_s: float) -> float:
    """Correlate the turns between images with those of the motion over the same intervals."""
    times_s = measured.times_s + offset_s
    inside = (seen.times_s[:-1] >= times_s[0]) & (seen.times_s[1:] <= times_s[-1])
    heading = np.concatenate([[0.0], np.cumsum(measured.turned_rad)])
    turned = np.diff(np.interp(seen.times_s, times_s, heading))[inside]
    if len(turned) < 3 or np.ptp(turned) == 0.0:
        return -1.0
    return float(np.corrcoef(seen.turned_rad[inside], turned)[0, 1])


def _seen(camera: Source, config: BrainConfig) -> Turns:
    odometry = visual_odometry(config.odometry, config.view.grey)
    times, turned, moved = [], [], []
    for frame in camera.frames(on_bad_frame=lambda _: None):
        if frame.image is None or (times and not frame.time_s > times[-1]):
            continue
        if times and frame.time_s > times[0] + _FIRST_S:
            break
        dt_s = frame.time_s - times[-1] if times else 1.0 / config.frame_rate_hz
        try:
            velocity = odometry(frame.image, dt_s)
        except BadFrame:
            continue
        if times:
            gap = dt_s > config.max_gap_s  # images of two places do not measure motion
            turned.append(0.0 if gap else velocity.w_rad_s * dt_s)
            moved.append(0.0 if gap else velocity.v_m_s * dt_s)
        times.append(frame.time_s)
    return Turns(np.array(times), np.array(turned), np.array(moved))


def _measured(motion: Source) -> Turns:
    times, turned, moved = [], [], []
    for frame in motion.frames(on_bad_frame=lambda _: None):
        if frame.velocity is None or (times and not frame.time_s > times[-1]):
            continue
        if times:
            turned.append(frame.velocity.w_rad_s * (frame.time_s - times[-1]))
            moved.append(frame.velocity.v_m_s * (frame.time_s - times[-1]))
        times.append(frame.time_s)
    return Turns(np.array(times), np.array(turned), np.array(moved))
