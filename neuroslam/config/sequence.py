"""Section of a brain's config: loop closures by sequences of views."""

from pydantic import Field

from neuroslam.config.section import Section


class SequenceConfig(Section):
    """Evidence of sequences of views, used where ``map.closure`` is ``sequence``.

    Match errors are compared in standard deviations below the mean error of a frame with all
    experiences, so that no limit depends on the threshold, the light or the camera.
    """

    new_view: float = Field(
        default=0.58,
        gt=0,
        le=10,
        description="match error with the present experience, as a share of the mean error with "
        "all experiences, beyond which a view of unknown ground makes a new one; larger: "
        "experiences farther apart. With fewer than min_experiences, view.threshold decides",
    )
    memory_frames: float = Field(
        default=14.0,
        gt=1,
        le=1000,
        description="frames over which evidence is averaged, while the robot moves; larger: safer, "
        "later",
    )
    believe: float = Field(
        default=2.3,
        gt=0,
        le=100,
        description="evidence, in standard deviations, from which a loop closure is believed; "
        "larger: safer, later",
    )
    margin: float = Field(
        default=0.5,
        ge=0,
        le=100,
        description="lead of the believed experience over the best of any other part of the map, "
        "in standard deviations; larger: fewer wrong loop closures where places look the same",
    )
    confirm_frames: int = Field(
        default=15,
        ge=1,
        le=10_000,
        description="frames in a row, along the links of the map, that must agree on a loop "
        "closure; larger: safer, later",
    )
    confirm_experiences: int = Field(
        default=4,
        ge=0,
        le=1000,
        description="experiences that the robot must pass meanwhile; larger: safer, later",
    )
    alike: float = Field(
        default=0.72,
        gt=0,
        le=1,
        description="match error of a believed loop closure, as a share of the mean error with all "
        "experiences, averaged over the frames that agree; smaller: fewer wrong loop closures",
    )
    keep: float = Field(
        default=1.5,
        gt=0,
        le=100,
        description="evidence, in standard deviations, below which a frame counts against the "
        "experience that the robot is believed at; larger: known places are left sooner",
    )
    lost_frames: int = Field(
        default=15,
        ge=1,
        le=10_000,
        description="frames in a row with too little evidence after which the robot has left the "
        "known places; larger: fewer new experiences",
    )
    min_experiences: int = Field(
        default=30,
        ge=2,
        le=10_000,
        description="experiences needed to know the distribution of match errors; larger: the "
        "first loop closure is safer, later",
    )
    recent_frames: int = Field(
        default=60,
        ge=0,
        le=100_000,
        description="frames for which a new experience cannot close a loop",
    )
    doubt_frames: int = Field(
        default=20,
        ge=1,
        le=10_000,
        description="frames after an abrupt change of view in which the robot may still be where "
        "it was: bumps and blur; larger: fewer false kidnappings, noticed later",
    )
    search_frames: int = Field(
        default=60,
        ge=1,
        le=100_000,
        description="frames after that in which the robot looks for itself in its own map; then a "
        "new map begins",
    )
