"""Section of a brain's config: clone cells, where places look the same."""

from pydantic import Field

from neuroslam.config.section import Section


class CloneConfig(Section):
    """Clone cells: a belief over experiences that follows the links of the map.

    Lengths are in links, the median length of a link of the map, so that they hold at any scale.
    """

    every_links: float = Field(
        default=0.25,
        gt=0,
        le=100,
        description="path between two updates, in links; larger: cheaper, and fewer views that "
        "say the same",
    )
    alike: float = Field(
        default=2.0,
        gt=-10,
        le=10,
        description="standard deviations below the usual match error at which a view says nothing; "
        "smaller: known places are believed sooner",
    )
    gain: float = Field(
        default=1.0,
        gt=0,
        le=10,
        description="log odds for each standard deviation of the match error; smaller: views count "
        "less",
    )
    least: float = Field(
        default=2.5,
        gt=0,
        le=100,
        description="most that one view speaks against a place, log odds; larger: a single bad "
        "frame counts more",
    )
    most: float = Field(
        default=2.0,
        gt=0,
        le=100,
        description="most that one view speaks for a place, log odds: all good matches count the "
        "same; larger: likewise",
    )
    drift: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="error of odometry as a share of the path; larger: loops close over larger "
        "errors, and places that look the same are confused from nearer",
    )
    drift_deg: float = Field(
        default=0.2,
        ge=0,
        le=90,
        description="error of its heading, degrees a link of path; larger: likewise",
    )
    spread_links: float = Field(
        default=1.5, gt=0, le=100, description="error of odometry on a short path, in links"
    )
    spread_deg: float = Field(
        default=17.0, gt=0, le=180, description="error of its heading on a short path, degrees"
    )
    close: float = Field(
        default=0.3,
        gt=0,
        le=10,
        description="rate at which unknown ground ends at a known place in reach, a link of path; "
        "larger: sooner",
    )
    leave: float = Field(
        default=0.01,
        gt=0,
        le=10,
        description="rate at which the robot leaves known ground, likewise; larger: sooner",
    )
    kidnaps: float = Field(
        default=4e-5,
        ge=0,
        le=1,
        description="rate of kidnaps that no change of view shows, likewise; larger: noticed "
        "sooner, and more are seen where there are none",
    )
    repeats: float = Field(
        default=0.1,
        gt=0,
        le=10,
        description="rate at which unknown ground begins to look like a known place that odometry "
        "does not reach, a link of path; larger: repeated rooms are not taken for the known ones",
    )
    support: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="belief that a loop closure of the tracker needs; larger: fewer",
    )
    sure: float = Field(
        default=0.95,
        gt=0,
        le=1,
        description="belief with which the population itself says where the robot is; larger: "
        "safer, later",
    )
    confirm_links: float = Field(
        default=4.0,
        ge=0,
        le=1000,
        description="path over which it has to be sure, in links; larger: safer, later",
    )
    notice: float = Field(
        default=4.0,
        ge=0,
        le=1e6,
        description="path over which new ground must look like places that it cannot be, in sizes "
        "of an experience, before the population votes; larger: it abstains longer",
    )
    notice_share: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="the same as a share of all new ground: in a world where little repeats the "
        "population abstains",
    )
    near_links: float = Field(
        default=3.0,
        gt=0,
        le=1000,
        description="distance up to which experiences of one heading are the same place, in links",
    )
    split: float = Field(
        default=1.0,
        gt=0,
        le=1000,
        description="path on unknown ground after which an experience is made although the view "
        "did not change, in sizes of an experience (pose_cells.create_threshold_cells); larger: "
        "fewer experiences along a wall that repeats",
    )
