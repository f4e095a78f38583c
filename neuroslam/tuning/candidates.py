"""Candidates of a tuning: whole configs that a run could use, made from presets and estimates."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from neuroslam.config import (
    BrainConfig,
    build_config,
    merge_values,
    parse_assignment,
    read_preset,
)
from neuroslam.config.sections import MapConfig, region_in
from neuroslam.tuning.auto import Estimates
from neuroslam.tuning.drive import Drive
from neuroslam.tuning.motion import FieldOfView, field_of_view, measure_shifts
from neuroslam.tuning.revisits import Revisits

_TURN_BANDS = ((0.0, 0.5), (0.25, 0.6), (0.0, 1.0))
_OTHER_FIELD_DEG = 5.0  # by which another estimate of the field of view differs
_RC_CAR_PX = (160, 120)  # of the camera that the preset was made for


def automatic(start: BrainConfig, assignments: Sequence[str] = ()) -> BrainConfig:
    """Return the preset ``auto`` with what no preset sets, without estimates."""
    return _candidate(start, read_preset("auto"), assignments)


def candidates(
    start: BrainConfig,
    given: bool,
    assignments: Sequence[str],
    estimates: Estimates,
    drive: Drive,
    field: FieldOfView | None,
) -> dict[str, BrainConfig]:
    """Return the configs to compare by name, ``auto`` first.

    Args:
        start: Config that tuning starts from; it gives what neither preset nor estimate sets.
        given: Whether it is a candidate itself.
        assignments: Settings that hold for all, like ``map.loops=5``.
        estimates: Of the first laps.
        drive: The drive, for the size of its pictures.
        field: Field of view by the revisits of the whole drive, if known.
    """
    auto = merge_values(read_preset("auto"), estimates.values)
    all_values = {"auto": auto}
    motion = estimates.values.get("odometry", {})
    if field is not None and motion:
        apart = abs(field.fov_deg - motion.get("fov_deg", BrainConfig().odometry.fov_deg))
        if apart > _OTHER_FIELD_DEG:
            turns = {"fov_deg": field.fov_deg, "turn_region": drive.to_source(field.region)}
            all_values["turns of revisits"] = merge_values(auto, {"odometry": turns})
    if estimates.other_view is not None:
        other = {name: section for name, section in auto.items() if name != "view"}
        view = merge_values(read_preset("auto")["view"], estimates.other_view)
        all_values["second band"] = other | {"view": view}
    all_values["rc_car"] = _rc_car(estimates, drive)
    found = {name: _candidate(start, v, assignments) for name, v in all_values.items()}
    return found | ({"given": start} if given else {})


def _rc_car(estimates: Estimates, drive: Drive) -> dict[str, Any]:
    """Return the preset ``rc_car``, with band, speed and field of view of another camera."""
    values = read_preset("rc_car")
    values.pop("frame_rate_hz", None)
    if drive.size == _RC_CAR_PX:
        return values
    view = {k: v for k, v in values["view"].items() if k != "crop"}
    crop = estimates.values.get("view", {}).get("crop")
    width, height = drive.size
    if crop is not None:
        x_min, x_max, y_min, y_max = region_in(crop, height, width)
        width, height = x_max - x_min, y_max - y_min
        view["crop"] = crop
    square = max(4, round(view["template_width"] * height / width))
    view["template_height"] = min(square, height)
    return values | {"view": view, "odometry": estimates.values.get("odometry", {})}


def _candidate(
    start: BrainConfig, values: dict[str, Any], assignments: Sequence[str]
) -> BrainConfig:
    """Return a config of a start, the values of a preset, and what is set by hand.

    What concerns views and odometry is that of the preset; a network's views are kept.
    """
    base = start.model_dump(exclude_none=True)
    base["odometry"] = {"use": start.odometry.use}
    values = dict(values)
    if start.view.features == "grey":
        base["view"] = {"grey": start.view.grey}
    else:
        values.pop("view", None)
    base["map"]["closure"] = MapConfig().closure
    whole = merge_values(base, values)
    for text in assignments:
        whole = merge_values(whole, parse_assignment(text))
    return build_config(whole, "tune")


def field_by_revisits(drive: Drive, keys: np.ndarray, revisits: Revisits) -> FieldOfView | None:
    """Return the field of view by the revisits, of the band where it has the least error."""
    pictures = drive.pictures
    width = pictures.shape[2]
    pairs = keys[revisits.same]
    regions = [drive.region(0, 1, top, bottom) for top, bottom in _TURN_BANDS]
    shifts = [measure_shifts(pictures, region, max(1, width // 4)) for region in regions]
    found = [one for s in shifts if (one := field_of_view(s, width, pairs)) is not None]
    return min(found, key=lambda one: round(float(one.error.min()), 2), default=None)
