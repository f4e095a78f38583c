"""Head-direction and speed cells compared with recordings of rats, and with theory.

Tuning, persistence, gain, drift with a noisy turn rate with and without cues, near and far cues,
and the linear code of speed.
"""

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from neuroslam.cells.head_direction import (
    CompassReading,
    HeadDirectionCells,
    HeadDirectionConfig,
    bump_at,
)
from neuroslam.cells.speed import SpeedCellConfig, SpeedCells, speed_score
from neuroslam.evaluation.tuning import tuning_width
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.heading import (
    Bump,
    Drift,
    plot_bumps,
    plot_drifts,
    plot_persistence,
    plot_speed_cells,
    plot_tuning,
)
from neuroslam.figures.style import save
from neuroslam.geometry import wrap_angle, wrap_angles
from neuroslam.types import Motion, ViewMatch

DT_S = 0.05
GYRO_DEG_S = 10.0
"""White noise of the turn rate, at every sample."""
COMPASS_DEG = 10.0
"""White noise of the compass, at every sample."""
VIEW_DEG = 10.0
"""Range of headings in which a view is matched."""

_WITH_VIEWS = 8
_TURNS_DEG_S, _TURNS_S = 80.0, 0.5  # turn rates of an animal: sd, and correlation time


def head_direction(
    data_folder: Path | None, out_folder: Path, minutes: float = 10.0, n_animals: int = 48
) -> dict[str, Any]:
    """Measure head-direction cells and speed cells.

    Args:
        data_folder: Not used.
        out_folder: ``results.json`` and ``tuning.png``, ``turning.png``, ``cues.png``,
            ``drift.png``, ``persistence.png``, ``speed_cells.png`` are written there.
        minutes: Duration of the tests of persistence and drift.
        n_animals: Number of animals in the test of drift, which differ in turns and noise; the
            first eight of them with views.

    Returns:
        The content of ``results.json``: ``rows``, one for each quantity.
    """
    out = Path(out_folder)
    rows = [
        *tuning(out),
        *turning(out),
        *cues(out),
        *drift(out, minutes, n_animals),
        *persistence(out, minutes),
        *running(out, minutes),
    ]
    return write_results(
        out,
        {
            "experiment": "head-direction",
            "time_step_s": DT_S,
            "minutes": minutes,
            "animals": n_animals,
            "gyro_noise_deg_s": GYRO_DEG_S,
            "compass_noise_deg": COMPASS_DEG,
            "rows": rows,
        },
    )


def row(quantity: str, value: float, expected: str) -> dict[str, Any]:
    """Return a row: a quantity, its value, and the expected value with its source."""
    return {"quantity": quantity, "value": float(value), "expected": expected}


def tuning(out: Path) -> list[dict[str, Any]]:
    """Measure tuning curves over a full turn, and draw those of some cells."""
    cells = HeadDirectionCells()
    at = np.arange(1440) * math.pi / 720.0
    rates = (bump_at(cells.ring, torch.from_numpy(at)) / cells.ring.peak).numpy()
    shown = {f"{k * 3}°": rates[:, k] for k in (10, 30, 50, 70, 90)}
    curve = rates[:, 90]
    half, base = tuning_width(curve), tuning_width(curve, 0.02)
    widths = {f"{half:.0f}° at half height": half, f"{base:.0f}° at 2 %": base}
    save(plot_tuning(np.degrees(at), shown, widths), out / "tuning.png")
    return [
        row("tuning_width_at_half_height_deg", half, "45 to 50: half of a triangle's base"),
        row("tuning_width_at_2_percent_deg", base, "about 90 to 100 (Taube et al. 1990)"),
    ]


def turns(seconds: float, animals: int, seed: int) -> np.ndarray:
    """Return random turn rates with the statistics of an animal (rad/s), ``(t, animals)``."""
    rng = np.random.default_rng(seed)
    kept = math.exp(-DT_S / _TURNS_S)
    rates = np.zeros((round(seconds / DT_S), animals))
    rate = np.zeros(animals)
    for k in range(len(rates)):
        rate = kept * rate + math.sqrt(1 - kept**2) * rng.normal(size=animals)
        rates[k] = math.radians(_TURNS_DEG_S) * rate
    return rates


def turning(out: Path) -> list[dict[str, Any]]:
    """Follow an animal that turns freely, and one that spins at 500 degrees per second."""
    bumps, worst = [], 0.0
    free = turns(20.0, 1, seed=4)[:, 0]
    spin = np.where(np.arange(120) < 80, math.radians(500.0), -math.radians(500.0))
    for title, rates in (("Turning freely", free), ("Spinning at 500 °/s", spin)):
        cells, activity, decoded = HeadDirectionCells(), [], []
        for rate in rates:
            decoded.append(cells(Motion(0.0, rate, DT_S)))
            activity.append(cells.rates)
        true = np.cumsum(rates) * DT_S
        worst = max(worst, np.abs(wrap_angles(np.array(decoded) - true)).max())
        time = (1 + np.arange(len(rates))) * DT_S
        bumps.append(
            Bump(
                title,
                time,
                np.array(activity),
                np.degrees(decoded),
                np.degrees(true),
                "true heading",
            )
        )
    save(plot_bumps(bumps, "The bump follows the integral of the turn rate"), out / "turning.png")
    return [row("largest_error_of_integration_deg", math.degrees(worst), "0: gain 1")]


def cues(out: Path) -> list[dict[str, Any]]:
    """Show a cue 40 degrees from the bump, and one at 140 degrees for 5 s and for 0.15 s."""
    bumps, rows = [], []
    for away, seconds in ((40.0, 5.0), (140.0, 5.0), (140.0, 0.15)):
        cells, activity, decoded = HeadDirectionCells(), [], []
        time = (1 + np.arange(120)) * DT_S
        shown = (time > 1.0) & (time <= 1.0 + seconds)
        for there in shown:
            cells.advance(Motion(0.0, 0.0, DT_S))
            if there:
                cells.correct(math.radians(away), cells.config.view_s, DT_S)
            decoded.append(math.degrees(cells.heading_rad))
            activity.append(cells.rates)
        what = f"Cue {away:g}° away, for {seconds:g} s"
        cue = np.where(shown, away, np.nan)
        bumps.append(Bump(what, time, np.array(activity), np.array(decoded), cue, "cue"))
        between = [0.15 * away < heading < 0.85 * away for heading in decoded]
        name = f"{away:g}_deg_for_{seconds:g}_s"
        rows.append(row(f"cue_{name}_time_between_s", sum(between) * DT_S, _CUES[away]))
        rows.append(row(f"cue_{name}_ends_at_deg", decoded[-1], f"{away if seconds > 1 else 0:g}"))
    save(plot_bumps(bumps, "A near cue moves the bump, a far cue makes it jump"), out / "cues.png")
    return rows


_CUES = {
    40.0: "above 0: it moves",
    140.0: "0: it jumps (Zugaro et al. 2003: abrupt jumps after large rotations)",
}


def drift(out: Path, minutes: float, animals: int) -> list[dict[str, Any]]:
    """Measure drift with a noisy turn rate: without cues, with a compass, with views."""
    rates = turns(60.0 * minutes, animals, seed=1)
    rng = np.random.default_rng(2)
    gyro = math.radians(GYRO_DEG_S) * rng.normal(size=rates.shape)
    compass = math.radians(COMPASS_DEG) * rng.normal(size=rates.shape)
    true = np.cumsum(rates, axis=0) * DT_S
    alone, led = HeadDirectionCells(batch=animals), HeadDirectionCells(batch=animals)
    errors: dict[str, list[np.ndarray]] = {"alone": [], "led": []}
    for sensed, heading, heard in zip(rates + gyro, true, true + compass, strict=True):
        motion = Motion(0.0, cast(Any, torch.from_numpy(sensed)), DT_S)
        alone.advance(motion)
        led.advance(motion, CompassReading(cast(Any, torch.from_numpy(heard))))
        errors["alone"].append(np.asarray(alone.heading_rad) - heading)
        errors["led"].append(np.asarray(led.heading_rad) - heading)
    few = slice(None, _WITH_VIEWS)
    animals_with_views = zip((rates + gyro).T[few], true.T[few], strict=True)
    with_views = np.stack([errors_with_views(*one) for one in animals_with_views], axis=1)
    # Unwrapped: a random walk may exceed half a turn.
    walked = np.degrees(np.unwrap(errors["alone"], axis=0))
    held = np.degrees(wrap_angles(np.array(errors["led"])))
    time = (1 + np.arange(len(rates))) * DT_S
    walk = GYRO_DEG_S * np.sqrt(time * DT_S)
    steady = filtered_sd(GYRO_DEG_S * DT_S, COMPASS_DEG, HeadDirectionConfig().compass_s)
    every = slice(None, None, 60)
    panels = [
        Drift("Without cues", time[every], walked[every], walk[every], r"$\pm\sigma\sqrt{T\,dt}$"),
        Drift(
            f"Compass, {COMPASS_DEG:g}° of noise",
            time[every],
            held[every],
            np.full_like(time[every], steady),
            "± sd of the filter",
        ),
        Drift(f"Views, {VIEW_DEG:g}° wide each", time[every], with_views[every]),
    ]
    title = f"Drift of the heading with {GYRO_DEG_S:g} °/s of noise in every turn rate"
    save(plot_drifts(panels, title), out / "drift.png")
    settled = slice(len(time) // 4, None)
    return [
        row("drift_without_cues_sd_deg", walked[-1].std(), f"{walk[-1]:.1f}: random walk"),
        row(
            "drift_without_cues_off_the_noise_deg",
            np.abs(walked - np.degrees(np.cumsum(gyro, axis=0)) * DT_S).max(),
            "0: the walk is that of the noise",
        ),
        row("error_with_compass_rms_deg", _rms(held[settled]), f"{steady:.2f}: filter"),
        row("error_with_views_rms_deg", _rms(with_views[settled]), f"within a view, {VIEW_DEG:g}"),
        row("error_with_views_largest_deg", np.abs(with_views[settled]).max(), "bounded"),
    ]


def filtered_sd(walk_deg: float, heard_deg: float, compass_s: float) -> float:
    r"""Return the standard deviation of a random walk that a compass corrects.

    .. math:: \sigma^2 = \frac{(1-g)^2 q^2 + g^2 r^2}{1 - (1-g)^2}, \qquad g = 1 - e^{-dt/\tau}

    with :math:`q` the noise of a step and :math:`r` the noise of the compass.
    """
    g = -math.expm1(-DT_S / compass_s)
    kept = (1.0 - g) ** 2
    return math.sqrt((kept * walk_deg**2 + g**2 * heard_deg**2) / (1.0 - kept))


def errors_with_views(sensed: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Run one animal with a view for every range of headings; errors in degrees, ``(t,)``."""
    cells, errors = HeadDirectionCells(), []
    ids: dict[int, int] = {}
    for rate, heading in zip(sensed, true, strict=True):
        view = math.floor(math.degrees(heading) % 360.0 / VIEW_DEG)
        new = view not in ids
        template = ids.setdefault(view, len(ids))
        decoded = cells(Motion(0.0, rate, DT_S), ViewMatch(template, 0.0, 0.0, new))
        errors.append(math.degrees(wrap_angle(decoded - heading)))
    return np.array(errors)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def persistence(out: Path, minutes: float) -> list[dict[str, Any]]:
    """Run bumps without input, on cells and between them, and one that starts from noise."""
    shares = np.linspace(0.0, 1.0, 5)
    start = shares * 2.0 * math.pi / HeadDirectionConfig().n + 0.7
    cells = HeadDirectionCells(batch=len(start) + 1)
    noise = torch.rand(HeadDirectionConfig().n, generator=torch.Generator().manual_seed(0))
    bumps = bump_at(cells.ring, torch.from_numpy(start))
    cells.set_activity(torch.cat([bumps, noise[None].to(bumps)]))
    still = Motion(0.0, cast(Any, torch.zeros(len(start) + 1, dtype=torch.float64)), DT_S)
    headings, widths = [], []
    for k in range(round(60.0 * minutes / DT_S)):
        cells.advance(still)
        if k % 100 == 0:
            headings.append(np.asarray(cells.heading_rad))
            widths.append([tuning_width(rates) for rates in cells.rates[[1, -1]]])
    decoded = np.array(headings)[:, :-1]
    moved = np.degrees(wrap_angles(decoded - decoded[0]))
    width = np.array(widths)
    time = np.arange(len(moved)) * 100 * DT_S
    save(plot_persistence(time, moved, width[:, 0]), out / "persistence.png")
    return [
        row("moved_without_input_deg", np.abs(moved).max(), "0"),
        row("width_changed_without_input_deg", np.ptp(width[:, 0]), "0"),
        row("width_of_a_bump_from_noise_deg", width[-1, 1], f"{width[-1, 0]:.2f}"),
    ]


def running(out: Path, minutes: float) -> list[dict[str, Any]]:
    """Run speed cells at changing speeds, with noise and without, and correlate."""
    n = round(60.0 * minutes / DT_S)
    rough = gaussian_filter1d(np.random.default_rng(5).normal(size=n), 0.4 / DT_S)
    speeds = (0.3 + 0.15 * rough / rough.std()).clip(0.0)
    scores, decoded, rates = {}, {}, {}
    for noise_hz in (0.0, 4.0):
        cells = SpeedCells(SpeedCellConfig(max_speed_m_s=1.0, noise_hz=noise_hz))
        steps = [(cells(Motion(speed, 0.0, DT_S)), cells.rates) for speed in speeds]
        decoded[noise_hz] = np.array([speed for speed, _ in steps])
        rates[noise_hz] = np.array([rate for _, rate in steps])
        scores[noise_hz] = speed_score(rates[noise_hz], speeds)
    ideal = SpeedCells(SpeedCellConfig(max_speed_m_s=1.0, lead_s=(0.0, 0.0)))
    steady = np.linspace(0.0, 1.25, 26)
    at_steady = []
    for speed in steady:
        ideal.advance(Motion(speed, 0.0, 0.0))
        at_steady.append(ideal.rates)
    shown = slice(None, 2000)
    figure = plot_speed_cells(
        steady,
        np.array(at_steady),
        speeds[shown],
        rates[4.0][shown, 0],
        decoded[4.0][shown],
        scores[4.0],
    )
    save(figure, out / "speed_cells.png")
    lags = np.arange(-0.1, 0.2, 0.005)
    time = np.arange(n) * DT_S
    inner = slice(20, -20)
    fits = [
        np.corrcoef(decoded[0.0][inner], np.interp(time[inner] + lag, time, speeds))[0, 1]
        for lag in lags
    ]
    return [
        row("speed_ahead_s", lags[int(np.argmax(fits))], "0.05 to 0.08 (Kropff et al. 2015)"),
        row("speed_score_without_noise", scores[0.0].mean(), "near 1: linear"),
        row("speed_score_with_4_hz_of_noise", scores[4.0].mean(), ""),
        row(
            "speed_told_error_without_noise_m_s", _rms(decoded[0.0] - speeds), "lead x acceleration"
        ),
    ]
