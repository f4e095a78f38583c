"""Parameters of the brain with units and bounds; config files and presets that set them."""

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
from neuroslam.config.navigation import (
    BoundaryCellConfig,
    GridCellConfig,
    PlaceCellConfig,
    WallMemoryConfig,
)
from neuroslam.config.section import Section
from neuroslam.config.sections import (
    MapConfig,
    OdometryConfig,
    PoseCellConfig,
    SessionConfig,
    ViewConfig,
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
