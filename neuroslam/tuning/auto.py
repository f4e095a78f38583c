r"""Estimates of a drive's parameters from its first laps, for the preset ``auto``.

Three estimates, none of which needs ground truth or a map:

- the band of the image whose views tell places apart, by the separation of near and far frames in
  standard deviations, :math:`d' = (\bar e_\text{far} - \bar e_\text{near}) / s_\text{far}`;
- the threshold, a share of the mean match error between far frames: half-way between two views of
  a place and views of two places, whatever light and camera;
- the field of view, from laps: a robot that comes round again with the same heading has turned
  once. A path without such laps, like a figure of eight, leaves it as it is.
"""

import math
from collections.abc import Iterator
from itertools import chain, islice
from typing import Any, NamedTuple

import cv2
import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.config.sections import Region, ViewConfig
from neuroslam.errors import BadFrame, counted
from neuroslam.sensors import Source
from neuroslam.sensors.grey import to_grey
from neuroslam.tuning.motion import measure_shifts
from neuroslam.tuning.revisits import fitting
from neuroslam.types import Frame
from neuroslam.view.preprocess import encode
from neuroslam.view.search import Geometry, distances
from neuroslam.view.templates import to_bytes

FIRST = 600
"""Frames from which views and speed are estimated."""

MOST = 6000
"""Frames after which a drive that never revisits a place is taken as it is."""

SHARE = 0.42
"""Share of the mean match error of far frames that is the threshold."""

_FEWEST = 100
_WIDTH_PX = 160
_NEAR_S = 0.1  # two frames so far apart in time show one place
_FAR_S = 5.0  # and so far apart, two places
_BANDS = ((0.0, 0.5), (0.0, 2 / 3), (1 / 6, 2 / 3), (0.0, 1.0))
_BETTER = 0.1  # by which another band must be better: bands overlap
_LAPS = 60  # revisits that determine the field of view
_LAP_TURN = (0.4, 2.5)  # measured turn of a lap, in full turns, that can be one turn
_SPREAD = 0.15  # of the turns of laps, relative, beyond which they determine nothing
_FIELDS_DEG = (35.0, 200.0)


class Estimates(NamedTuple):
    """What the first laps of a drive say about its parameters.

    Attributes:
        values: Sections and keys of a config, as a TOML file has them.
        notes: One line for each estimate, or the reason why there is none.
        other_view: Keys of the section ``view`` for the second-best band of the image, if any.
    """

    values: dict[str, dict[str, Any]]
    notes: list[str]
    other_view: dict[str, Any] | None = None


class _Reduced(NamedTuple):
    """Frames with small grey pictures, and by how much they are smaller."""

    frames: Iterator[Frame]
    factor: int
    size: tuple[int, int]


def has_pictures(source: Source) -> bool:
    """Return whether a source is a camera, or a recording that begins with a picture."""
    if source.live:
        return True
    first = next(iter(source.frames(on_bad_frame=lambda _: None)), None)
    return first is not None and first.image is not None


def estimate(source: Source, config: BrainConfig, stop: int | None = None) -> Estimates:
    """Estimate view, threshold, speed scale and field of view from the first laps of a recording.

    Args:
        source: Any source; one that is live, or has no pictures, is not read.
        config: Gives everything that is not estimated.
        stop: Frame to stop before.
    """
    if source.live:
        return Estimates({}, ["auto: the source is live, nothing is estimated from it"])
    reduced = _reduced(source, config, stop)
    first = [] if reduced is None else list(islice(reduced.frames, FIRST))
    if reduced is None or len(first) < _FEWEST:
        return Estimates(
            {},
            [
                f"auto: {counted(len(first), 'frame')} with a picture, expected {_FEWEST}: "
                "nothing is estimated"
            ],
        )
    pictures = _moving(first)
    if len(pictures) < _FEWEST // 2:
        return Estimates({}, ["auto: the pictures hardly change: nothing is estimated"])
    span_s = first[-1].time_s - first[0].time_s
    rate_hz = (len(first) - 1) / span_s
    (view, far, near), second = _best_views(pictures, config.view, rate_hz)
    scaled, other = (
        _section(one, mean, reduced.factor) for one, mean, _ in ((view, far, near), second)
    )
    crop = scaled.get("crop")
    seen = "the whole image" if crop is None else f"rows {crop[2]} to {crop[3]}"
    notes = [
        f"auto: views of {seen}, threshold {scaled['threshold']}: frames {_NEAR_S} s apart differ "
        f"by {near:.3f}, far ones by {far:.3f}"
    ]
    values: dict[str, dict[str, Any]] = {"view": scaled}
    if first[-1].velocity is not None and config.odometry.use != "visual":
        return Estimates(values, notes, other)
    small = view.model_copy(update={"threshold": scaled["threshold"]})
    motion = _speed_scale(pictures, small, config, rate_hz, reduced)
    values["odometry"] = motion
    frames = islice(chain(first, reduced.frames), MOST)
    field_deg, why = _field_of_view(frames, _small_config(config, small, motion, reduced))
    notes.append(why)
    if field_deg is not None:
        motion["fov_deg"] = field_deg
    return Estimates(values, notes, other)


def _reduced(source: Source, config: BrainConfig, stop: int | None) -> _Reduced | None:
    """Return the source's frames with pictures, grey and at most ``_WIDTH_PX`` wide."""
    some = (f for f in source.frames(stop=stop, on_bad_frame=lambda _: None) if f.image is not None)
    frame = next(some, None)
    if frame is None or frame.image is None:
        return None
    height, width = frame.image.shape[:2]
    factor = max(1, width // _WIDTH_PX)
    to = (width // factor, height // factor)

    def small(one: Frame) -> Frame:
        assert one.image is not None
        grey = to_grey(one.image, config.view.grey)
        if factor > 1:
            grey = cv2.resize(grey, to, interpolation=cv2.INTER_AREA)
        return one._replace(image=grey)

    same = (f for f in chain([frame], some) if f.image.shape[:2] == (height, width))  # type: ignore[union-attr]
    return _Reduced((small(f) for f in same), factor, to)


def _moving(frames: list[Frame]) -> np.ndarray:
    """Return the pictures of a moving robot, ``(n, h, w)``."""
    pictures = np.stack([frame.image for frame in frames if frame.image is not None])
    steps = np.abs(np.diff(pictures.astype(np.int16), axis=0)).mean(axis=(1, 2))
    return pictures[1:][steps > 0.2 * np.median(steps)]


def _section(view: ViewConfig, far: float, factor: int) -> dict[str, Any]:
    """Return the keys of a view for the source's pictures; the crop only where there is one."""
    names = (
        "template_width", "template_height", "orientations", "patch_radius", "shift_match",
        "normalisation",
    )  # fmt: skip
    found = {name: getattr(view, name) for name in names} | {"threshold": _rounded(SHARE * far)}
    crop = _scaled(view.crop, factor)
    return found if crop is None else {"crop": crop, **found}


def _best_views(
    pictures: np.ndarray, config: ViewConfig, rate_hz: float
) -> list[tuple[ViewConfig, float, float]]:
    """Return the two views that separate near from far frames best, each with both mean errors."""
    height, width = pictures.shape[1:]
    near, far = max(1, round(_NEAR_S * rate_hz)), max(2, round(_FAR_S * rate_hz))
    far = min(far, len(pictures) // 3)
    found = []
    for top, bottom in _BANDS:
        rows = round(top * height), round(bottom * height)
        whole = rows == (0, height)
        region = None if whole else (0, width, *rows)
        view = config.model_copy(update={"crop": region})
        if not config.orientations:  # square pixels; cells of gradients need not be square
            lines = max(4, round(config.template_width * (rows[1] - rows[0]) / width))
            view = fitting(view.model_copy(update={"template_height": lines}), pictures.shape[1:])
        score, errors = _separation(pictures, view, near, far)
        found.append((score, view, *errors))
    best = found[-1]  # the whole image, unless another is clearly better
    for one in found:
        if one[0] > best[0] + _BETTER:
            best = one
    second = max((one for one in found if one is not best), key=lambda one: one[0])
    return [best[1:], second[1:]]


def _separation(
    pictures: np.ndarray, view: ViewConfig, near: int, far: int
) -> tuple[float, tuple[float, float]]:
    """Return :math:`d'` of a view, and the mean errors of far and near frames."""
    geometry = Geometry.of(view)
    templates = np.stack([to_bytes(encode(p, view).template.T).reshape(-1) for p in pictures])
    scale = 255.0 * geometry.n_pixels
    apart, close = [], []
    for i in range(0, len(templates), 4):
        query = templates[i].reshape(view.template_width, view.template_height)
        errors = distances(templates, query, geometry).min(axis=0) / scale
        lag = np.abs(np.arange(len(templates)) - i)
        apart.append(errors[lag >= far])
        close.append(errors[lag == near])
    others, same = np.concatenate(apart), np.concatenate(close)
    mean, spread = float(others.mean()), float(others.std()) + 1e-6
    return (mean - float(same.mean())) / spread, (mean, float(same.mean()))


def _speed_scale(
    pictures: np.ndarray, view: ViewConfig, config: BrainConfig, rate_hz: float, reduced: _Reduced
) -> dict[str, Any]:
    """Return the scale for which a view lasts as long as an experience is wide."""
    height, width = pictures.shape[1:]
    region = (0, width, height // 2, height)
    max_shift = max(1, width // 4)
    speed = measure_shifts(pictures, region, max_shift).difference[1:]
    typical = float(np.median(speed[speed > 0.2 * np.median(speed)]))
    geometry = Geometry.of(view)
    templates = np.stack([to_bytes(encode(p, view).template.T).reshape(-1) for p in pictures])
    lasts = []
    for i in range(0, len(templates) - 20, 8):
        query = templates[i].reshape(view.template_width, view.template_height)
        errors = distances(templates[i : i + 200], query, geometry).min(axis=0)
        beyond = np.flatnonzero(errors > view.threshold * 255.0 * geometry.n_pixels)
        lasts.append(int(beyond[0]) if len(beyond) else len(errors))
    duration_s = max(1.0, float(np.median(lasts))) / rate_hz
    cells = config.pose_cells
    scale = cells.create_threshold_cells * cells.cell_size_m / duration_s / max(typical, 1e-6)
    return {
        "speed_scaling_m_s": _rounded(scale),
        "max_speed_m_s": _rounded(4.0 * scale * typical),
        "min_speed_m_s": _rounded(0.05 * scale * typical),
        "max_shift_px": max_shift * reduced.factor,
    }


def _small_config(
    config: BrainConfig, view: ViewConfig, motion: dict[str, Any], reduced: _Reduced
) -> BrainConfig:
    """Return the config for the reduced pictures, with views and pose cells alone."""
    odometry = config.odometry.model_copy(
        update={
            **motion,
            "use": "visual",
            "speed_region": _scaled(config.odometry.speed_region, 1 / reduced.factor),
            "turn_region": _scaled(config.odometry.turn_region, 1 / reduced.factor),
            "max_shift_px": motion["max_shift_px"] // reduced.factor,
        }
    )
    sessions = config.sessions.model_copy(update={"kidnapped": "ignore"})
    return config.model_copy(
        update={
            "cells": ("pose",), "view": view, "odometry": odometry, "sessions": sessions,
            "max_gap_s": 1e9, "map": config.map.model_copy(update={"closure": "sequence"}),
        }
    )  # fmt: skip


def _field_of_view(frames: Iterator[Frame], config: BrainConfig) -> tuple[float | None, str]:
    """Map the first laps, and return the field of view for which each lap is one turn.

    Args:
        frames: With small grey pictures.
        config: For these.
    """
    brain = NavigationBrain(config)
    turned, last, laps = 0.0, {}, []
    for frame in frames:
        try:
            result = brain(frame)
        except BadFrame:
            continue
        turned += result.motion.w_rad_s * result.motion.dt_s
        if brain.tracker is not None and brain.tracker.tracks:
            before = last.get(result.experience)
            if before is not None and result.action == "link":
                laps.append(turned - before[0])
        if result.action in ("create", "link"):
            last[result.experience] = (turned, frame.index)
        if len(laps) >= _LAPS:
            break
    if len(laps) < _LAPS // 3:
        return None, (
            f"auto: no place was seen twice in {len(last)} experiences; the field of view stays "
            f"{config.odometry.fov_deg:g} degrees"
        )
    turns = np.abs(laps) / math.tau
    single = turns[(turns > _LAP_TURN[0]) & (turns < _LAP_TURN[1])]
    if len(single) < 0.6 * len(turns):
        return None, (
            "auto: the laps do not turn once each; the field of view stays "
            f"{config.odometry.fov_deg:g} degrees"
        )
    middle = float(np.median(single))
    spread = float(np.median(np.abs(single - middle))) / middle
    found = config.odometry.fov_deg / middle
    if spread > _SPREAD or not _FIELDS_DEG[0] < found < _FIELDS_DEG[1]:
        return None, (
            f"auto: the turns of laps differ by {100 * spread:.0f} % or give a field of view of "
            f"{found:.0f} degrees; it stays {config.odometry.fov_deg:g}"
        )
    return float(round(found)), (
        f"auto: field of view {found:.0f} degrees, of {len(single)} revisits whose laps turn once, "
        f"within {100 * spread:.0f} %"
    )


def _scaled(region: Region | None, factor: float) -> Region | None:
    if region is None:
        return None
    x_min, x_max, y_min, y_max = (e if e == -1 else round(e * factor) for e in region)
    return x_min, x_max, y_min, y_max


def _rounded(value: float) -> float:
    """Round to three digits, the accuracy of an estimate."""
    return float(f"{value:.3g}")
