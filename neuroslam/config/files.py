"""Presets, config files and assignments, read as nested values; a config written as TOML."""

import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from neuroslam.config.brain import BrainConfig
from neuroslam.config.classic import from_classic
from neuroslam.errors import ConfigError, did_you_mean, with_new_names
from neuroslam.limits import MOST_CONFIG_BYTES, NotReadableError, parse_toml, read_bounded


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
        text = read_bounded(path, MOST_CONFIG_BYTES).decode()
    except FileNotFoundError:
        preset = path.name.removesuffix(".toml")
        hint = f"; {preset} is a preset, --preset {preset}" if preset in preset_names() else ""
        raise ConfigError(f"config {path}: no such file{hint}") from None
    except NotReadableError as error:
        raise ConfigError(f"config {path}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"config {path}: cannot be read as text ({error})") from None
    if path.suffix.lower() in (".ini", ".txt"):
        return from_classic(text, path)
    try:
        return _with_new_keys(parse_toml(text))
    except ValueError as error:
        raise ConfigError(f"config {path}: not valid TOML: {error}") from None


def merge_values(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Merge nested values key by key; those of ``over`` replace those of ``base``.

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
    value: Any
    try:
        value = parse_toml(f"value = {raw.strip()}")["value"]
    except ValueError:
        value = raw.strip()
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    return _with_new_keys(value)


def _with_new_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Call renamed keys by their present names, before other values are laid over them."""
    known = dict(values)
    for name, section in values.items():
        field = BrainConfig.model_fields.get(name)
        renamed = getattr(field.annotation, "renamed", None) if field else None
        if renamed and isinstance(section, dict):
            known[name] = with_new_names(section, renamed, name)
    return known


def build_config(values: dict[str, Any], origin: str = "config") -> BrainConfig:
    """Check nested values and make the config of a brain from them.

    Raises:
        ConfigError: One line with the key, the value, and what was expected.
    """
    try:
        return BrainConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(part for part in first["loc"] if isinstance(part, str))
        if first["type"] == "unknown_key":
            raise ConfigError(f"{origin}: {first['msg']}") from None
        message = first["msg"].removeprefix("Value error, ")
        message = message[0].lower() + message[1:]
        if first["type"] == "model_type":
            message = f"is a section; set one of its keys, as {where}.KEY"
        elif where.endswith(("crop", "region")):
            message = "expected four whole numbers x_min, x_max, y_min, y_max"
        raise ConfigError(f"{origin}: {where} = {_shown(first['input'])}: {message}") from None


def _shown(value: object) -> str:
    """Write a value for a message, cut if it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits
        return f"<{type(value).__name__}>"
    return text if len(text) <= 80 else f"{text[:77]}..."


def to_toml(config: BrainConfig) -> str:
    """Return the complete config as TOML; reading it back gives the same config.

    Example:
        >>> build_config(parse_toml(to_toml(BrainConfig()))) == BrainConfig()
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


def toml_text(value: str) -> str:
    r"""Write a string as TOML, with control characters escaped.

    Example:
        >>> print(toml_text('a"b\x7f'))
        "a\"b\u007F"
    """
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return toml_text(value)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)
