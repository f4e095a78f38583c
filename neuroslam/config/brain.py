"""The config of a brain: its cells, and every section."""

from typing import Literal, get_args

from pydantic import Field, field_validator

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
