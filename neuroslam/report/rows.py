"""Metrics and parameters of a run as rows of the report's tables."""

import math
from typing import Any

from pydantic import BaseModel

from neuroslam.config import BrainConfig
from neuroslam.runs.files import TIMINGS
from neuroslam.state.registry import population_classes

_USED_BY = {
    "view": "pose",
    "pose_cells": "pose",
    "boundary_cells": "place",
    "grid_cells": "place",
    "place_cells": "place",
    "wall_memory": "place",
    "semantic": "semantic",
}
"""Section of the config -> the cells that use it; other sections are always in use."""


def metric_rows(metrics: dict[str, Any], length: str = "m") -> list[list[Any]]:
    """Return name, value and unit of the numbers in ``metrics.json``; lists are shown elsewhere.

    Args:
        metrics: The figures.
        length: Unit of lengths; ``arbitrary unit`` for one camera alone.

    Example:
        >>> metric_rows({"frames": 3, "seconds": 1.5, "skipped": [], "ate_rmse_m": 0.2})
        [['frames', 3, ''], ['seconds', 1.5, ''], ['ate rmse', 0.2, 'm']]
    """
    rows = []
    for key, value in metrics.items():
        if isinstance(value, list | dict) or (key in TIMINGS and not value):
            continue  # a merge has no timings
        name, unit = key, ""
        if key.endswith(("_m", "_s")) and "_per_" not in key:
            name, _, unit = key.rpartition("_")
            # With a free scale, errors are in the metres of the truth.
            unit = length if unit == "m" and "similarity" not in key else unit
        finite = not isinstance(value, float) or math.isfinite(value)
        rows.append([name.replace("_", " "), value if finite else str(value), unit])
    return rows


def config_rows(config: BrainConfig, base: BrainConfig | None = None) -> list[dict[str, Any]]:
    """Return every parameter by section: value, default, whether they differ, description.

    Args:
        config: The config.
        base: The config that it is compared with, as that of a preset; default: the defaults.
    """
    plain = base or BrainConfig()
    general: dict[str, Any] = {"section": "brain", "used": True, "rows": []}
    sections = [general]
    views = any(cls.needs_views for cls in population_classes(config))
    own = {kind: section for kind, section in (config.model_extra or {}).items()}
    for name, section in own.items():
        rows = _parameters(section, type(section)(), "")
        sections.append({"section": name, "used": name in config.cells, "rows": rows})
    for name, field in BrainConfig.model_fields.items():
        value, default = getattr(config, name), getattr(plain, name)
        if not isinstance(value, BaseModel):
            general["rows"].append(_parameter(name, value, default, field.description))
            continue
        used = name not in _USED_BY or _USED_BY[name] in config.cells
        used = used or (name == "view" and views)
        sections.append({"section": name, "used": used, "rows": _parameters(value, default, "")})
    return sections


def _parameters(value: BaseModel, default: BaseModel, path: str) -> list[dict[str, Any]]:
    """Return the parameters of a section and of its subsections, in their order."""
    rows = []
    for key, field in type(value).model_fields.items():
        mine, plain = getattr(value, key), getattr(default, key)
        if isinstance(mine, BaseModel):
            rows += _parameters(mine, plain, f"{path}{key}.")
        else:
            rows.append(_parameter(f"{path}{key}", mine, plain, field.description))
    return rows


def _parameter(key: str, value: object, default: object, description: str | None) -> dict[str, Any]:
    return {
        "key": key,
        "value": _written(value),
        "default": _written(default),
        "differs": value != default,
        "what": description or "",
    }


def _written(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        return ", ".join(map(_written, value))
    return str(value)
