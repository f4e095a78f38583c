"""Every parameter of the brain: name, unit, bounds, what it does; files and presets to set them."""

from neuroslam.config.brain import BrainConfig
from neuroslam.config.classic import CLASSIC_NAMES
from neuroslam.config.files import (
    build_config,
    merge_values,
    parse_assignment,
    preset_folder,
    preset_names,
    read_config_file,
    read_preset,
    to_toml,
)
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

__all__ = [
    "CLASSIC_NAMES",
    "BoundaryCellConfig",
    "BrainConfig",
    "GridCellConfig",
    "MapConfig",
    "OdometryConfig",
    "PlaceCellConfig",
    "PoseCellConfig",
    "Section",
    "SemanticConfig",
    "SessionConfig",
    "ViewConfig",
    "WallMemoryConfig",
    "build_config",
    "merge_values",
    "parse_assignment",
    "preset_folder",
    "preset_names",
    "read_config_file",
    "read_preset",
    "to_toml",
]
