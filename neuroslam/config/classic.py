"""Reader of OpenRatSLAM's config files, and its names for our parameters."""

import configparser
import math
from pathlib import Path
from typing import Any

from neuroslam.config.brain import BrainConfig
from neuroslam.errors import ConfigError, did_you_mean

# OpenRatSLAM's name -> (section, our name), for the parameters that carry over one to one.
CLASSIC_NAMES: dict[str, tuple[str, str]] = {
    "template_x_size": ("view", "template_width"),
    "template_y_size": ("view", "template_height"),
    "vt_shift_match": ("view", "shift_match"),
    "vt_step_match": ("view", "shift_step"),
    "vt_normalisation": ("view", "normalisation"),
    "vt_patch_normalise": ("view", "patch_radius"),
    "vt_min_patch_normalisation_std": ("view", "patch_min_std"),
    "vt_panoramic": ("view", "panoramic"),
    "vt_match_threshold": ("view", "threshold"),
    "vt_active_decay": ("pose_cells", "active_decay"),
    "pc_dim_xy": ("pose_cells", "n_xy"),
    "pc_dim_th": ("pose_cells", "n_theta"),
    "pc_w_e_dim": ("pose_cells", "excite_size"),
    "pc_w_i_dim": ("pose_cells", "inhibit_size"),
    "pc_w_e_var": ("pose_cells", "excite_std_xy"),
    "pc_w_i_var": ("pose_cells", "inhibit_std_xy"),
    "pc_global_inhib": ("pose_cells", "global_inhibition"),
    "pc_vt_inject_energy": ("pose_cells", "inject_energy"),
    "pc_vt_restore": ("pose_cells", "restore"),
    "pc_cell_x_size": ("pose_cells", "cell_size_m"),
    "exp_delta_pc_threshold": ("pose_cells", "create_threshold_cells"),
    "exp_correction": ("map", "correction"),
    "exp_loops": ("map", "loops"),
    "exp_initial_em_deg": ("map", "initial_heading_deg"),
    "camera_fov_deg": ("odometry", "fov_deg"),
    "vtrans_scaling": ("odometry", "speed_scaling_m_s"),
    "vtrans_max": ("odometry", "max_speed_m_s"),
}

_CLASSIC_REGIONS = {
    "image_crop": ("view", "crop"),
    "vtrans_image": ("odometry", "speed_region"),
    "vrot_image": ("odometry", "turn_region"),
}

# What OpenRatSLAM takes where its file has no such key.
_CLASSIC_DEFAULTS: dict[str, dict[str, float]] = {
    "ratslam": {
        "vt_shift_match": 25,
        "vt_step_match": 5,
        "vt_normalisation": 0.0,
        "vt_patch_normalise": 0,
        "vt_min_patch_normalisation_std": 0.0,
        "vt_panoramic": 0,
        "vt_match_threshold": 0.03,
        "vt_active_decay": 1.0,
        "pc_dim_xy": 21,
        "pc_dim_th": 36,
        "pc_w_e_dim": 7,
        "pc_w_i_dim": 5,
        "pc_w_e_var": 1,
        "pc_w_i_var": 2,
        "pc_global_inhib": 0.00002,
        "pc_vt_inject_energy": 0.15,
        "pc_vt_restore": 0.05,
        "pc_cell_x_size": 1.0,
        "exp_delta_pc_threshold": 2.0,
        "exp_correction": 0.5,
        "exp_loops": 10,
        "exp_initial_em_deg": 90.0,
    },
    "visual_odometry": {
        "camera_fov_deg": 50.0,
        "camera_hz": 10.0,
        "vtrans_scaling": 100.0,
        "vtrans_max": 20.0,
    },
}
_EDGES = {"x_min": 0, "x_max": -1, "y_min": 0, "y_max": -1}  # those of the image

# Keys that mean nothing without ROS: names of topics, paths of media.
_CLASSIC_IGNORED = {"topic_root", "media_path", "image_file", "enable", "odom_map", "calibrate"}


def from_classic(text: str, path: Path) -> dict[str, Any]:
    """Read the text of an OpenRatSLAM ``.ini``/``.txt`` as nested keys and values, by our names.

    Keys that a section does not have take OpenRatSLAM's own defaults, and edges of a region that
    are left out are those of the image. A file without ``[visual_odometry]`` says nothing of it.

    Args:
        text: Content of the file.
        path: Its name, for error messages.

    Raises:
        ConfigError: If it cannot be parsed, a key is unknown, or a value is not a number.
    """
    parser = configparser.ConfigParser(
        interpolation=None, inline_comment_prefixes=("#", ";"), strict=False
    )
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ConfigError(
            f"config {path}: not an OpenRatSLAM file: {str(error).splitlines()[0]}"
        ) from None
    values: dict[str, Any] = {}
    regions: dict[str, dict[str, int]] = {}
    for section in parser.sections():
        for key, default in _CLASSIC_DEFAULTS.get(section, {}).items():
            parser[section].setdefault(key, str(default))
        for key, raw in parser[section].items():
            prefix = key.removesuffix("_x_min").removesuffix("_x_max")
            prefix = prefix.removesuffix("_y_min").removesuffix("_y_max")
            if section in ("draw", "general") or key in _CLASSIC_IGNORED:
                continue
            try:
                number = float(raw)
            except (ValueError, TypeError):
                number = math.nan
            if not math.isfinite(number):
                raise ConfigError(
                    f"config {path}: {key} = {raw!r} in [{section}]; expected a number, finite"
                )
            if prefix in _CLASSIC_REGIONS:
                regions.setdefault(prefix, {})[key.removeprefix(prefix + "_")] = int(number)
            elif key == "camera_hz":
                values["frame_rate_hz"] = number
            elif key in CLASSIC_NAMES:
                where, name = CLASSIC_NAMES[key]
                values.setdefault(where, {})[name] = _as_field(where, name, number)
            else:
                raise ConfigError(
                    f"config {path}: unknown key {key!r} in [{section}]"
                    f"{did_you_mean(key, _classic_keys())}"
                )
    for prefix, edges in regions.items():
        where, name = _CLASSIC_REGIONS[prefix]
        values.setdefault(where, {})[name] = tuple((_EDGES | edges).values())
    cells = values.get("pose_cells", {})
    for kernel in ("excite", "inhibit"):  # the classic file has one width for position and heading
        if f"{kernel}_std_xy" in cells:
            cells[f"{kernel}_std_theta"] = cells[f"{kernel}_std_xy"]
    return values


def _classic_keys() -> list[str]:
    edges = ("x_min", "x_max", "y_min", "y_max")
    regions = [f"{region}_{edge}" for region in _CLASSIC_REGIONS for edge in edges]
    return [*CLASSIC_NAMES, "camera_hz", *regions, *sorted(_CLASSIC_IGNORED)]


def _as_field(section: str, name: str, number: float) -> float | int | bool:
    """Return a whole number as the type of the field: ``1.0`` as True for a switch."""
    kind: type[float] = type(getattr(getattr(BrainConfig(), section), name))
    return kind(number) if number == int(number) else number
