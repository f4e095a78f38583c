"""The config of a brain, and the files and presets that set it."""

import configparser
import math
import tomllib
from pathlib import Path
from typing import Any

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from neuroslam.config.populations import known_kinds, population_class, section_class
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


class BrainConfig(Section):
    """Which populations a brain is composed of, and every number in them.

    A population that is not one of the three with sections below has its own section under its
    kind: ``[head_direction]`` of a file, ``config.head_direction`` in Python.

    Example:
        >>> BrainConfig(view={"threshold": 0.04}).view.threshold
        0.04
    """

    model_config = ConfigDict(extra="allow")  # sections of populations; any other key is refused

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
    cells: tuple[str, ...] = Field(
        default=("pose",),
        description="populations; pose: views, pose cells and map (RatSLAM); place: boundary, grid "
        "and place cells (SLRB); semantic: landmarks (SSP-SLAM); head_direction; speed; or one of "
        "your own; as pose+place",
    )
    frame_rate_hz: float = Field(default=20.0, gt=0, description="where the source has no times")
    threads: int = Field(
        default=1, ge=1, description="of a run; for one brain, one is the fastest"
    )
    max_gap_s: float = Field(
        default=2.0, gt=0, description="a longer gap between frames is an error"
    )

    @model_validator(mode="before")
    @classmethod
    def _with_sections(cls, values: Any) -> Any:  # noqa: ANN401 - what a user gives
        """Check the sections of populations by the classes that those have."""
        if not isinstance(values, dict):
            return values
        checked, refused = dict(values), []
        for key in values.keys() - cls.model_fields.keys():
            section = section_class(key) if key in known_kinds() else None
            if section is None:
                refused.append(InitErrorDetails(type="extra_forbidden", loc=(key,), input=values[key]))
            elif not isinstance(values[key], section):
                try:
                    checked[key] = section.model_validate(values[key])
                except ValidationError as error:
                    raise _inside(key, error) from None
        if refused:
            raise ValidationError.from_exception_data(cls.__name__, refused)
        for kind in _kinds(values.get("cells", ())):
            if kind not in checked and kind in known_kinds() and (section := section_class(kind)):
                checked[kind] = section()
        return checked

    @field_validator("cells", mode="before")
    @classmethod
    def _from_text(cls, value: object) -> object:
        return _kinds(value) if isinstance(value, str) else value

    @field_validator("cells")
    @classmethod
    def _in_order(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        known = known_kinds()
        for kind in value:
            if kind not in known:
                population_class(kind)  # says which there are
        if not value or len(set(value)) < len(value):
            raise ValueError(
                f"expected one or several of {', '.join(known)}, each once, joined by +"
            )
        return tuple(kind for kind in known if kind in value)

    def section(self, kind: str) -> Section:
        """Return the section of a population that has its own.

        Example:
            >>> BrainConfig(cells="pose+speed").section("speed") == BrainConfig(cells="speed").speed
            True
        """
        return getattr(self, kind)


def _kinds(value: object) -> list[str]:
    """Split ``pose+place``; ``pose_and_place`` is how files of earlier versions have it."""
    if isinstance(value, str):
        return value.replace("_and_", "+").split("+")
    return list(value) if isinstance(value, list | tuple) else []


def _inside(section: str, error: ValidationError) -> ValidationError:
    """Name the section in the errors of its keys."""
    lines = [
        InitErrorDetails(
            type=PydanticCustomError(line["type"], "{text}", {"text": line["msg"]}),
            loc=(section, *line["loc"]),
            input=line["input"],
        )
        if line["type"] not in ("extra_forbidden",)
        else InitErrorDetails(
            type=line["type"], loc=(section, *line["loc"]), input=line["input"]
        )
        for line in error.errors()
    ]
    return ValidationError.from_exception_data(error.title, lines)


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
        raise ConfigError(f"config {path}: no such file") from None
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
                    f"{did_you_mean(key, [*CLASSIC_NAMES, 'camera_hz'])}"
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
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"{origin}: unknown key {where!r}{_key_meant(where)}") from None
        said = first["msg"].removeprefix("Value error, ")
        said = said[0].lower() + said[1:]
        if first["type"] == "model_type":
            said = f"is a section; set one of its keys, as {where}.KEY"
        elif where.endswith(("crop", "region")):
            said = "expected four whole numbers x_min, x_max, y_min, y_max"
        raise ConfigError(f"{origin}: {where} = {first['input']!r}: {said}") from None


def _all_keys(section: type[BaseModel] = BrainConfig, path: str = "") -> list[str]:
    keys = []
    for name, field in section.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            keys += [f"{path}{name}", *_all_keys(inner, f"{path}{name}.")]
        else:
            keys.append(f"{path}{name}")
    return keys


def _key_meant(word: str) -> str:
    known, last = _all_keys(), word.rpartition(".")[2]
    without_section = [key for key in known if key.rpartition(".")[2] == last]
    return did_you_mean(word, known) or "".join(
        f"; did you mean {key!r}?" for key in without_section[:1]
    )


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
