"""The config of a brain, and the files and presets that set it."""

import configparser
import math
import tomllib
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError, field_validator

from neuroslam.config.sections import (
    BoundaryCellConfig,
    GridCellConfig,
    MapConfig,
    OdometryConfig,
    PlaceCellConfig,
    PoseCellConfig,
    Section,
    SessionConfig,
    ViewConfig,
    WallMemoryConfig,
)
from neuroslam.config.semantic import SemanticConfig
from neuroslam.errors import ConfigError, did_you_mean

CellKind = Literal["pose", "place", "semantic"]


class BrainConfig(Section):
    """Which cell populations a brain has, and every number in them.

    Example:
        >>> BrainConfig(view={"threshold": 0.04}).view.threshold
        0.04
    """

    odometry: OdometryConfig = OdometryConfig()
    view: ViewConfig = ViewConfig()
    pose_cells: PoseCellConfig = PoseCellConfig()
    map: MapConfig = MapConfig()
    sessions: SessionConfig = SessionConfig()
    boundary_cells: BoundaryCellConfig = BoundaryCellConfig()
    grid_cells: GridCellConfig = GridCellConfig()
    place_cells: PlaceCellConfig = PlaceCellConfig()
    wall_memory: WallMemoryConfig = WallMemoryConfig()
    semantic: SemanticConfig = SemanticConfig()
    cells: tuple[CellKind, ...] = Field(
        ("pose",),
        description="any of pose: views, pose cells and map (RatSLAM); place: boundary, grid and "
        "place cells (SLRB); semantic: landmarks and their places (SSP-SLAM); as pose+place",
    )
    frame_rate_hz: float = Field(20.0, gt=0, description="where the source has no times")
    threads: int = Field(1, ge=1, description="of a run; for one brain, one is the fastest")
    max_gap_s: float = Field(2.0, gt=0, description="a longer gap between frames is an error")

    @field_validator("cells", mode="before")
    @classmethod
    def _told_as_text(cls, value: object) -> object:
        if isinstance(value, str):  # pose_and_place: of files of earlier versions
            value = value.replace("_and_", "+").split("+")
        return value

    @field_validator("cells")
    @classmethod
    def _in_order(cls, value: tuple[CellKind, ...]) -> tuple[CellKind, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError("expected one or several of pose, place, semantic, each once")
        return tuple(kind for kind in get_args(CellKind) if kind in value)

    def has(self, kind: CellKind) -> bool:
        """Say whether such cells are among the brain's.

        Example:
            >>> BrainConfig(cells="pose+semantic").has("place")
            False
        """
        return kind in self.cells


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

# What else a classic file holds that has no meaning without ROS: where topics and media are.
_CLASSIC_IGNORED = {"topic_root", "media_path", "image_file", "enable", "odom_map", "calibrate"}


def preset_folder() -> Path:
    """Return the folder of the presets: inside an installed package, or at a checkout's top."""
    inside = Path(__file__).parents[1] / "configs"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "configs"


def preset_names() -> list[str]:
    """Return the names that ``--preset`` accepts."""
    return sorted(path.stem for path in preset_folder().glob("*.toml"))


def read_preset(name: str) -> dict[str, Any]:
    """Read a preset of :func:`preset_names` as nested keys and values.

    Raises:
        ConfigError: If there is no such preset.
    """
    if name not in preset_names():
        raise ConfigError(
            f"unknown preset {name!r}; there are {', '.join(preset_names())}"
            f"{did_you_mean(name, preset_names())}"
        )
    return read_config_file(preset_folder() / f"{name}.toml")


def read_config_file(path: Path) -> dict[str, Any]:
    """Read our TOML, or an OpenRatSLAM ``.ini``/``.txt``, as nested keys and values.

    Raises:
        ConfigError: If the file is missing or cannot be parsed.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        preset = path.name.removesuffix(".toml")
        hint = f"; {preset} is a preset, --preset {preset}" if preset in preset_names() else ""
        raise ConfigError(f"config {path}: no such file{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"config {path}: cannot be read as text ({error})") from None
    if path.suffix.lower() in (".ini", ".txt"):
        return _from_classic(text, path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"config {path}: not valid TOML: {error}") from None


def _from_classic(text: str, path: Path) -> dict[str, Any]:
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
        for key, raw in parser[section].items():
            prefix = key.removesuffix("_x_min").removesuffix("_x_max")
            prefix = prefix.removesuffix("_y_min").removesuffix("_y_max")
            if section in ("draw", "general") or key in _CLASSIC_IGNORED:
                continue
            try:
                number = float(raw)
            except ValueError:
                raise ConfigError(
                    f"config {path}: {key} = {raw!r} in [{section}]; expected a number"
                ) from None
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
        missing = [e for e in ("x_min", "x_max", "y_min", "y_max") if e not in edges]
        if missing:
            raise ConfigError(f"config {path}: {prefix}_{missing[0]} is missing")
        values.setdefault(where, {})[name] = tuple(
            edges[e] for e in ("x_min", "x_max", "y_min", "y_max")
        )
    cells = values.get("pose_cells", {})
    for kernel in ("excite", "inhibit"):  # the classic file has one width for place and direction
        if f"{kernel}_std_xy" in cells:
            cells[f"{kernel}_std_theta"] = cells[f"{kernel}_std_xy"]
    if not math.isfinite(values.get("frame_rate_hz", 1.0)):
        raise ConfigError(f"config {path}: camera_hz is not a finite number")
    return values


def _classic_keys() -> list[str]:
    edges = ("x_min", "x_max", "y_min", "y_max")
    regions = [f"{region}_{edge}" for region in _CLASSIC_REGIONS for edge in edges]
    return [*CLASSIC_NAMES, "camera_hz", *regions, *sorted(_CLASSIC_IGNORED)]


def _as_field(section: str, name: str, number: float) -> float | int | bool:
    annotation = type(getattr(getattr(BrainConfig(), section), name))
    return annotation(number) if number == int(number) else number


def merge_values(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Lay nested values over others; ``over`` wins key by key.

    Example:
        >>> merge_values({"view": {"threshold": 0.1}}, {"view": {"panoramic": True}})
        {'view': {'threshold': 0.1, 'panoramic': True}}
    """
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge_values(merged[key], value) if both else value
    return merged


def parse_assignment(text: str) -> dict[str, Any]:
    """Turn ``section.key=value`` into nested values; the value is read as TOML, else as text.

    Raises:
        ConfigError: If there is no ``=``.

    Example:
        >>> parse_assignment("view.threshold=0.04")
        {'view': {'threshold': 0.04}}
    """
    key, equals, raw = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {text!r}: expected section.key=value, e.g. view.threshold=0.04")
    try:
        value = tomllib.loads(f"value = {raw.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        value = raw.strip()
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    return value


def build_config(values: dict[str, Any], origin: str = "config") -> BrainConfig:
    """Check nested values and make the config of a brain from them.

    Raises:
        ConfigError: One line that names the key, what was got and what was expected.
    """
    try:
        return BrainConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(part for part in first["loc"] if isinstance(part, str))
        if first["type"] == "unknown_key":
            raise ConfigError(f"{origin}: {first['msg']}") from None
        said = first["msg"].removeprefix("Value error, ")
        said = said[0].lower() + said[1:]
        if first["type"] == "model_type":
            said = f"is a section; set one of its keys, as {where}.KEY"
        elif where.endswith(("crop", "region")):
            said = "expected four whole numbers x_min, x_max, y_min, y_max"
        raise ConfigError(f"{origin}: {where} = {first['input']!r}: {said}") from None


def to_toml(config: BrainConfig) -> str:
    """Write the complete config, as in force, as TOML; reading it back gives the same config.

    Example:
        >>> build_config(tomllib.loads(to_toml(BrainConfig()))) == BrainConfig()
        True
    """
    return "\n".join(_toml_table(config.model_dump(), "")) + "\n"


def _toml_table(values: dict[str, Any], path: str) -> list[str]:
    plain = {k: v for k, v in values.items() if not isinstance(v, dict) and v is not None}
    lines = [f"{name} = {_toml(value)}" for name, value in plain.items()]
    for name, value in values.items():
        if isinstance(value, dict):
            lines += ["", f"[{path}{name}]", *_toml_table(value, f"{path}{name}.")]
    return lines


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)
