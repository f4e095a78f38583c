"""Sections of a brain's config: odometry, views, pose cells, map and sessions."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from neuroslam.config.bounds import MOST_CELLS, MOST_COUNT, MOST_IMAGE_PX, MOST_LOOPS, MOST_PX
from neuroslam.config.section import Section
from neuroslam.errors import did_you_mean
from neuroslam.types import GreyRule

_Edge = Annotated[int, Field(ge=-1, le=MOST_IMAGE_PX)]
Region = tuple[_Edge, _Edge, _Edge, _Edge]
"""Part of an image: ``x_min, x_max, y_min, y_max`` in px, the maxima excluded; -1 as a maximum is
the edge of the image."""


def region_in(region: Region, height: int, width: int) -> Region:
    """Return a region with the edges of an image in place of maxima of -1.

    Example:
        >>> region_in((10, -1, 0, 50), height=120, width=160)
        (10, 160, 0, 50)
    """
    x_min, x_max, y_min, y_max = region
    return x_min, width if x_max == -1 else x_max, y_min, height if y_max == -1 else y_max


class OdometryConfig(Section):
    """Visual odometry: speed and turn rate from successive images."""

    use: Literal["auto", "visual", "given", "fused"] = Field(
        default="auto",
        description="source of odometry; auto: the source's own where it has one, else visual "
        "odometry; visual: always from the images; given: always the source's own; fused: both, "
        "weighted by their variances, where method is flow",
    )
    method: Literal["profiles", "flow"] = Field(
        default="profiles",
        description="how images measure motion; profiles: the column sums of two regions are "
        "shifted over those before, as in RatSLAM; flow: corners are followed, and most of them "
        "have to agree",
    )
    camera_height_m: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description="flow: height of the camera above a flat floor, in m, for speeds in metres; "
        "none: the unit of length is the height of the camera",
    )
    camera_tilt_deg: float = Field(
        default=0.0,
        ge=-60,
        le=89,
        description="flow: tilt of the camera downwards from the horizontal, in degrees; larger: "
        "the same flow of the floor is a lower speed",
    )
    climb: Literal["given", "pitch", "slope"] = Field(
        default="given",
        description="source of the speed upwards; given: the source's own; pitch: images of a "
        "camera that pitches with its vehicle on ramps; slope: images of a camera that stays level "
        "on its way up, as a drone's. method says how images are compared",
    )
    level_deg: float = Field(
        default=5.0,
        ge=0,
        lt=45,
        description="climb = pitch: pitch below which the ground counts as level, in degrees; "
        "larger: less drift of height, gentler ramps are overlooked",
    )
    level_s: float = Field(
        default=2.0,
        gt=0,
        description="climb = pitch: time in which a pitch below level_deg decays to a third; "
        "larger: errors of the pitch last longer, the foot of a ramp is measured better",
    )
    view_distance_m: float = Field(
        default=5.0,
        gt=0,
        description="climb = slope, method = profiles: distance of what the middle of the image "
        "shows, in m; larger: the same shift of rows is a higher speed upwards",
    )
    given_speed_error: float = Field(
        default=0.05,
        gt=0,
        le=1,
        description="fused: standard deviation of the source's speed as a share of it; larger: the "
        "images count more",
    )
    given_turn_error_rad_s: float = Field(
        default=0.05,
        gt=0,
        le=10,
        description="fused: standard deviation of the source's turn rate in rad/s; larger: the "
        "images count more",
    )
    gyroscope_error_rad_s: float = Field(
        default=0.01,
        gt=0,
        le=10,
        description="fused: standard deviation of a gyroscope's turn rate in rad/s, its bias "
        "included; larger: the images count more",
    )
    speed_region: Region | None = Field(
        default=None,
        description="region of the image that measures speed, x_min, x_max, y_min, y_max in px; "
        "-1 as a maximum: the edge of the image; none: the lower half",
    )
    turn_region: Region | None = Field(
        default=None,
        description="region of the image that measures the turn rate, x_min, x_max, y_min, y_max "
        "in px, -1 as a maximum: the edge of the image; none: the upper half",
    )
    max_shift_px: int = Field(
        default=40,
        ge=1,
        le=MOST_PX,
        description="largest shift between two successive images, in px; larger: faster turns are "
        "measured, each frame takes longer",
    )
    fov_deg: float = Field(
        default=90.0,
        gt=0,
        le=360,
        description="horizontal field of view of the whole image; larger: the same shift is a "
        "larger turn",
    )
    speed_scaling_m_s: float = Field(
        default=100.0,
        gt=0,
        description="speed (m/s) per unit of image difference, grey in [0, 1]; larger: higher "
        "speeds, a larger map",
    )
    max_speed_m_s: float = Field(
        default=5.0, gt=0, description="largest speed measured; higher speeds are cut to it"
    )
    min_speed_m_s: float = Field(
        default=0.02,
        ge=0,
        description="smallest speed measured; a lower speed counts as standing still",
    )
    first_frame: Literal["still", "zero_profile"] = Field(
        default="still",
        description="what the first image is compared with; still: nothing, the speed is 0; "
        "zero_profile: an all-zero profile, as in OpenRatSLAM",
    )

    @model_validator(mode="after")
    def _check_method(self) -> Self:
        if self.use == "fused" and self.method != "flow":
            raise ValueError("use = 'fused' needs method = 'flow': profiles have no variance")
        if self.climb == "pitch" and self.method != "flow":
            raise ValueError(
                "climb = 'pitch' needs method = 'flow': the speed too moves the profile of the rows"
            )
        if self.climb != "given" and self.fov_deg > 150.0:
            raise ValueError(
                f"climb = '{self.climb}' with fov_deg = {self.fov_deg:g}; expected at most 150: a "
                "panoramic image is no plane"
            )
        return self


class ViewConfig(Section):
    """Local view cells: how an image becomes a template, and when two templates match."""

    features: str = Field(
        default="grey",
        description="what a template is made of; grey: grey levels of the reduced image; "
        "resnet18.layer3 and the like: a layer of a torchvision network; module: a torch module "
        "passed in Python",
    )
    weights: str | None = Field(
        default=None, description="file with the state_dict of the network that features names"
    )
    grey: GreyRule = Field(
        default="luma",
        description="how colour becomes grey, for views and visual odometry; luma: 0.299 R + "
        "0.587 G + 0.114 B; mean: (R + G + B) / 3, as in OpenRatSLAM",
    )
    crop: Region | None = Field(
        default=None,
        description="region of the image that is used, x_min, x_max, y_min, y_max in px, -1 as a "
        "maximum: the edge of the image; none: the whole image",
    )
    template_width: int = Field(
        default=60,
        ge=2,
        le=MOST_PX,
        description="width of a template in px; larger: more detail, similar scenes are "
        "distinguished",
    )
    template_height: int = Field(
        default=10,
        ge=1,
        le=MOST_PX,
        description="height of a template in px; larger: more detail, similar scenes are "
        "distinguished",
    )
    threshold: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="largest match error (mean absolute difference, grey in [0, 1]) at which a "
        "view matches a template; larger: more matches, fewer templates, more false matches",
    )
    shift_match: int = Field(
        default=4,
        ge=0,
        le=MOST_PX,
        description="largest horizontal shift tried when comparing forward views, in template px; "
        "larger: tolerates more difference in heading. If not set and the template is narrower "
        "than 9 px: the largest that leaves a column",
    )
    shift_step: int = Field(
        default=1,
        ge=1,
        le=MOST_PX,
        description="step between the shifts tried, in template px; larger: faster, less exact",
    )
    panoramic: bool = Field(
        default=False,
        description="images cover the full turn: all horizontal rolls are compared, and the best "
        "one gives the relative heading",
    )
    normalisation: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="mean grey to which every template is scaled; 0: no scaling",
    )
    patch_radius: int = Field(
        default=0,
        ge=0,
        le=MOST_PX,
        description="half width of the window of patch normalisation, in template px; larger: "
        "evens out brightness over larger areas; 0: off",
    )
    patch_min_std: float = Field(
        default=0.0,
        ge=0,
        description="standard deviation of grey below which a patch becomes uniform (0.5); larger: "
        "more noise in flat areas is removed",
    )
    orientations: int = Field(
        default=0,
        ge=0,
        le=36,
        description="orientations of gradients that a grey template is made of instead of "
        "brightness, without either normalisation; template_height is this number times the rows "
        "of cells; more tolerant of light and of small displacements; 0: brightness",
    )
    min_contrast: float = Field(
        default=0.01,
        ge=0,
        lt=1,
        description="standard deviation of grey below which an image shows nothing to match; "
        "larger: more images are ignored; 0: none is",
    )
    mean_gate: bool = Field(
        default=False,
        description="skip templates whose mean grey differs by more than threshold + 0.005: "
        "faster, may miss a match",
    )
    precision: Literal["uint8", "float64"] = Field(
        default="uint8",
        description="number type of a stored template; uint8: one byte a pixel; float64: eight "
        "bytes, no rounding",
    )

    @model_validator(mode="before")
    @classmethod
    def _shift_follows_the_width(cls, values: object) -> object:
        if not isinstance(values, Mapping) or {"shift_match", "panoramic"} & values.keys():
            return values
        width, usual = values.get("template_width"), cls.model_fields["shift_match"].default
        if not isinstance(width, int) or width > 2 * usual or width < 2:
            return values
        return {**values, "shift_match": (width - 1) // 2}

    @model_validator(mode="after")
    def _weights_are_of_a_named_network(self) -> Self:
        named = self.features not in ("grey", "module")
        if named and self.weights is None:
            raise ValueError(
                f"features {self.features} needs weights: a file with the network's "
                f"state_dict{did_you_mean(self.features, ('grey', 'module'))}"
            )
        if self.weights is not None and not named:
            raise ValueError(
                f"weights belong to a named network, but features is {self.features}; leave "
                "weights out, or name the network"
            )
        return self

    @model_validator(mode="after")
    def _orientations_divide_the_height(self) -> Self:
        if self.orientations and self.features != "grey":
            raise ValueError(
                f"orientations {self.orientations} are those of grey templates, but features is "
                f"{self.features}; leave one of them out"
            )
        if self.orientations and self.template_height % self.orientations:
            raise ValueError(
                f"template_height {self.template_height} is not a multiple of orientations "
                f"{self.orientations}; it is that number times the rows of cells"
            )
        return self

    @model_validator(mode="after")
    def _shift_leaves_columns(self) -> Self:
        if not self.panoramic and 2 * self.shift_match >= self.template_width:
            raise ValueError(
                f"shift_match {self.shift_match} leaves no column of template_width "
                f"{self.template_width}; it must be below half of it"
            )
        return self


class PoseCellConfig(Section):
    """Pose cells: a continuous attractor on the torus ``(n_theta, n_xy, n_xy)``."""

    n_xy: int = Field(
        default=21,
        ge=7,
        le=MOST_CELLS,
        description="cells along x and along y; larger: activity repeats at larger distances, each "
        "step takes longer. The torus wraps around, so the map is not bounded",
    )
    n_theta: int = Field(
        default=36,
        ge=7,
        le=MOST_CELLS,
        description="cells over the full turn of heading; larger: finer heading, each step takes "
        "longer",
    )
    cell_size_m: float = Field(
        default=0.25,
        gt=0,
        description="side of a cell; larger: coarser position, experiences farther apart",
    )
    excite_size: int = Field(
        default=7,
        ge=1,
        le=MOST_CELLS,
        description="width of the excitation kernel in cells, odd; larger: excitation reaches "
        "farther",
    )
    excite_std_xy: float = Field(
        default=1.0,
        gt=0,
        description="standard deviation of the excitation kernel along x and y, in cells; larger: "
        "a broader activity packet",
    )
    excite_std_theta: float = Field(
        default=1.0,
        gt=0,
        description="standard deviation of the excitation kernel along heading, in cells; larger: "
        "a broader activity packet",
    )
    inhibit_size: int = Field(
        default=5,
        ge=1,
        le=MOST_CELLS,
        description="width of the inhibition kernel in cells, odd; larger: inhibition reaches "
        "farther",
    )
    inhibit_std_xy: float = Field(
        default=2.0,
        gt=0,
        description="standard deviation of the inhibition kernel along x and y, in cells; larger: "
        "competing packets are suppressed farther away",
    )
    inhibit_std_theta: float = Field(
        default=2.0,
        gt=0,
        description="standard deviation of the inhibition kernel along heading, in cells; larger: "
        "competing packets are suppressed farther away",
    )
    global_inhibition: float = Field(
        default=2e-5,
        ge=0,
        description="activity subtracted from every cell in each step; larger: weak packets vanish "
        "sooner; too large: all cells fall silent, an error",
    )
    inject_energy: float = Field(
        default=0.2,
        ge=0,
        description="activity that a matched view injects; larger: faster relocalisation, and a "
        "false match does more harm",
    )
    active_decay: float = Field(
        default=1.0,
        ge=0,
        description="fatigue added each time the same view matches again without a break; larger: "
        "a repeated view stops injecting sooner",
    )
    restore: float = Field(
        default=0.05,
        ge=0,
        description="fatigue that every view loses in each frame; larger: views recover sooner",
    )
    inject_after: int = Field(
        default=10,
        ge=0,
        le=MOST_COUNT,
        description="number of newest views that never inject; larger: the robot must be away "
        "longer before a view corrects it",
    )
    inject_while_few: bool = Field(
        default=False,
        description="inject also while there are fewer views than inject_after, as in OpenRatSLAM",
    )
    inject_at_cell: bool = Field(
        default=False,
        description="inject at the whole cell below the stored pose, as in OpenRatSLAM; off: "
        "between cells",
    )
    exact_gain: bool = Field(
        default=True,
        description="compensate the lag of the packet behind odometry that the attractor causes; "
        "off: the packet lags, as in OpenRatSLAM",
    )
    create_threshold_cells: float = Field(
        default=2.0,
        gt=0,
        description="distance on the torus, in cells, beyond which a matched view makes a new "
        "experience; larger: fewer experiences",
    )
    decode_radius: int = Field(
        default=3,
        ge=0,
        le=MOST_CELLS,
        description="cells on each side of the most active cell that are averaged to decode the "
        "pose; larger: smoother, but takes in other packets",
    )
    precision: Literal["float32", "float64"] = Field(
        default="float32", description="number type of the activity"
    )

    @model_validator(mode="after")
    def _kernels_fit(self) -> Self:
        for name in ("excite_size", "inhibit_size"):
            size = getattr(self, name)
            if size % 2 == 0:
                raise ValueError(f"{name} is {size}; expected an odd number: a kernel has a centre")
            if size > min(self.n_xy, self.n_theta):
                raise ValueError(
                    f"{name} is {size}; expected at most {min(self.n_xy, self.n_theta)}, the "
                    "smaller of n_xy and n_theta"
                )
        return self


LEAST_EXPERIENCES = 100
"""Smallest cap of a map: evidence of sequences needs some tens of experiences to compare."""


class MapConfig(Section):
    """Experience map: a graph of experiences, relaxed until its links agree."""

    initial_heading_deg: float = Field(
        default=90.0, description="heading of the robot at the start, counter-clockwise from x"
    )
    solver: Literal["relax", "least_squares", "incremental"] = Field(
        default="relax",
        description="how the map is made consistent; relax: iterative relaxation, Eq. 8 of the "
        "multisession paper; least_squares: sparse pose-graph optimisation of the whole map; "
        "incremental: of the part that moves, and of the whole map at the end of a run",
    )
    correction: float = Field(
        default=0.5,
        gt=0,
        le=0.5,
        description="share of a link's error by which each of its ends moves in a relaxation loop; "
        "larger: faster convergence",
    )
    loops: int = Field(
        default=20,
        ge=0,
        le=MOST_LOOPS,
        description="relaxation loops a frame while the map has not converged; larger: the map "
        "converges in fewer frames, each takes longer",
    )
    rest_tolerance: float = Field(
        default=1e-6,
        ge=0,
        description="largest correction (m, rad) at which the map counts as converged; larger: "
        "relaxation stops earlier",
    )
    closure: Literal["view", "sequence"] = Field(
        default="view",
        description="what closes a loop; view: a single view and the pose cells, as in RatSLAM; "
        "sequence: views of several frames along the links of the map, see [sequence]",
    )
    link_gain: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="sequence: weight of a new measurement of a link that the robot drives again; "
        "larger: forgets earlier measurements sooner; 0: the first one stays",
    )
    sigma_m: float = Field(
        default=0.1,
        gt=0,
        description="pose-graph optimisation: standard deviation of a link's position; larger: "
        "distances count less against headings",
    )
    sigma_rad: float = Field(
        default=0.1,
        gt=0,
        description="pose-graph optimisation: standard deviation of a link's heading change; "
        "larger: headings count less against distances",
    )
    robust: bool = Field(
        default=False,
        description="pose-graph optimisation: reject loop closures that contradict the other links",
    )
    max_experiences: int = Field(
        default=0,
        ge=0,
        le=MOST_COUNT,
        description="most experiences that the map keeps: the least used are forgotten, with their "
        "templates, and their links joined; 100 or more; larger: more memory and time; 0: no limit",
    )
    consolidate_passes: int = Field(
        default=0,
        ge=0,
        le=MOST_COUNT,
        description="times in a row that the robot passes close by an experience without arriving "
        "there, after which it becomes part of the one beside it, if their views are alike; "
        "larger: the map keeps more; 0: never",
    )

    @model_validator(mode="after")
    def _cap_leaves_a_map(self) -> Self:
        if 0 < self.max_experiences < LEAST_EXPERIENCES:
            raise ValueError(
                f"max_experiences {self.max_experiences} is too small for a map; expected "
                f"{LEAST_EXPERIENCES} or more, or 0 for no limit"
            )
        return self


class SessionConfig(Section):
    """Joining a running session with a stored map, kidnapping, and gaps between frames."""

    renamed: ClassVar[Mapping[str, str]] = {
        "carried": "kidnapped",
        "carried_factor": "kidnapped_factor",
    }

    confirm: int = Field(
        default=4,
        ge=1,
        le=MOST_COUNT,
        description="matched pairs of experiences that must agree on the alignment before two maps "
        "are joined; larger: safer, later; 1: the first view match decides",
    )
    drift: float = Field(
        default=0.25,
        ge=0,
        le=1,
        description="error of odometry allowed between two matched pairs, and between two visits "
        "of one place, as a share of the path between them; larger: more pairs count as agreeing, "
        "and fewer places as places that look the same",
    )
    turn_tolerance_deg: float = Field(
        default=30.0,
        gt=0,
        le=180,
        description="difference of rotation allowed between two matched pairs; larger: more pairs "
        "count as agreeing",
    )
    cells: Literal["turn", "shift", "none"] = Field(
        default="turn",
        description="how pose-cell states of a joined session move; turn: shifted and rotated; "
        "shift: shifted only, as in the paper; none: not at all",
    )
    kidnapped: Literal["detect", "ignore"] = Field(
        default="detect",
        description="when the view changes too abruptly for driving; detect: the robot was "
        "kidnapped, a new map begins and is joined with the old one after relocalisation; ignore: "
        "carry on",
    )
    kidnapped_factor: float = Field(
        default=3.5,
        gt=1,
        description="view change that counts as kidnapped, as a multiple of the usual change; "
        "larger: fewer detections",
    )
    after_gap: Literal["stop", "new_map"] = Field(
        default="stop",
        description="after a gap longer than max_gap_s; stop: an error; new_map: begin a new map",
    )
    residual_factor: float = Field(
        default=2.0,
        ge=1,
        description="factor on the expected standard deviations of odometry in the test of a "
        "merge; larger: more merges are accepted",
    )
    false_alarm: float = Field(
        default=0.001,
        gt=0,
        lt=1,
        description="share of right merges that the test of the residuals refuses; larger: more "
        "merges are refused",
    )
    coincidence: float = Field(
        default=0.01,
        gt=0,
        le=1,
        description="largest probability, in a merge of finished maps, that the matched places are "
        "others that look the same; smaller: maps must share more places, and repeat less; 1: not "
        "tested",
    )
    check_residuals: bool = Field(
        default=True,
        description="refuse a merge whose views are not distinct, whose path does not turn, or "
        "whose links do not fit; false: accept every merge, as in the paper",
    )
