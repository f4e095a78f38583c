"""The config of a brain: which populations it is composed of, and their parameters."""

from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails

from neuroslam.config.bounds import MOST_THREADS
from neuroslam.config.navigation import (
    BoundaryCellConfig,
    GridCellConfig,
    PlaceCellConfig,
    WallMemoryConfig,
)
from neuroslam.config.populations import known_kinds, population_class, section_class
from neuroslam.config.section import Section, verbatim_error
from neuroslam.config.sections import (
    MapConfig,
    OdometryConfig,
    PoseCellConfig,
    SessionConfig,
    ViewConfig,
)
from neuroslam.config.semantic import SemanticConfig
from neuroslam.config.sequence import SequenceConfig


class BrainConfig(Section):
    """Which populations a brain is composed of, and their parameters.

    A population without a section below has its own, named by its kind: ``[head_direction]`` in a
    file, ``config.head_direction`` in Python.

    Example:
        >>> BrainConfig(view={"threshold": 0.04}).view.threshold
        0.04
    """

    model_config = ConfigDict(extra="allow")  # sections of populations; any other key is refused

    odometry: OdometryConfig = OdometryConfig()
    view: ViewConfig = ViewConfig()
    pose_cells: PoseCellConfig = PoseCellConfig()
    map: MapConfig = MapConfig()
    sequence: SequenceConfig = SequenceConfig()
    sessions: SessionConfig = SessionConfig()
    boundary_cells: BoundaryCellConfig = BoundaryCellConfig()
    grid_cells: GridCellConfig = GridCellConfig()
    place_cells: PlaceCellConfig = PlaceCellConfig()
    wall_memory: WallMemoryConfig = WallMemoryConfig()
    semantic: SemanticConfig = SemanticConfig()
    cells: tuple[str, ...] = Field(
        default=("pose",),
        description="populations, joined by +, as pose+place; pose: views, pose cells and map "
        "(RatSLAM); place: boundary, grid and place cells (SLRB); semantic: landmarks (SSP-SLAM); "
        "head_direction; speed; pose_3d: pose cells with height (NeuroSLAM); clones: places that "
        "look the same; or one of your own",
    )
    frame_rate_hz: float = Field(
        default=20.0, gt=0, description="frame rate, where the source has no time stamps"
    )
    threads: int = Field(
        default=1,
        ge=1,
        le=MOST_THREADS,
        description="CPU threads of a run; for a single brain 1 is the fastest",
    )
    max_gap_s: float = Field(
        default=2.0,
        gt=0,
        description="largest time between two frames; sessions.after_gap says what "
        "a longer gap does",
    )

    @model_validator(mode="before")
    @classmethod
    def _with_sections(cls, values: object) -> object:
        """Check the section of each population with the population's own section class."""
        if not isinstance(values, dict):
            return values
        checked, refused, named = dict(values), [], _kinds(values.get("cells", ()))
        for key in [key for key in values if key not in cls.model_fields]:
            section = section_class(key) if key in known_kinds() else None
            if section is None and key in named and key not in known_kinds():
                continue  # cells says it better: there is no such population
            if section is None:
                refused.append(
                    InitErrorDetails(type="extra_forbidden", loc=(key,), input=values[key])
                )
            elif not isinstance(values[key], section):
                try:
                    checked[key] = section.model_validate(values[key])
                except ValidationError as error:
                    raise _inside(key, error) from None
        if refused:
            raise ValidationError.from_exception_data(cls.__name__, refused)
        for kind in named:
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
                population_class(kind)  # raises, with the known kinds
        if not value or len(set(value)) < len(value):
            raise ValueError(
                f"expected one or several of {', '.join(known)}, each once, joined by +"
            )
        return tuple(kind for kind in known if kind in value)

    def __reduce__(self) -> tuple[object, ...]:
        """Go to another process as plain values: sections may be of a plugin not yet loaded."""
        return BrainConfig.model_validate, (self.model_dump(),)

    def section(self, kind: str) -> Section:
        """Return the section of a population that has its own section.

        Example:
            >>> BrainConfig(cells="pose+speed").section("speed") == BrainConfig(cells="speed").speed
            True
        """
        section: Section = getattr(self, kind)
        return section


def _kinds(value: object) -> list[str]:
    """Split ``pose+place``; files of earlier versions have ``pose_and_place``."""
    if isinstance(value, str):
        return value.replace("_and_", "+").split("+")
    return list(value) if isinstance(value, list | tuple) else []


def _inside(section: str, error: ValidationError) -> ValidationError:
    """Prefix the errors of a section's keys with the name of the section."""
    lines = [
        InitErrorDetails(
            type=verbatim_error(line["type"], line["msg"]),
            loc=(section, *line["loc"]),
            input=line["input"],
        )
        for line in error.errors()
    ]
    return ValidationError.from_exception_data(error.title, lines)
