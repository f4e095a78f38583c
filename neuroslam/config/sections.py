"""Sections of a brain's config: every parameter with its unit, its bounds and what it does."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from neuroslam.errors import did_you_mean, nearest, with_new_names

Region = tuple[int, int, int, int]

_SPACING_RATIO = 1.3  # of a grid module to the next smaller one
_GOLDEN = 0.6180339887498949


class Section(BaseModel):
    """A group of parameters: frozen, unknown keys refused, no infinities.

    An unknown key or choice is told together with the known one that is most like it.

    Example:
        >>> PoseCellConfig(n_xz=20)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        pydantic_core._pydantic_core.ValidationError: 1 validation error for PoseCellConfig
        n_xz
          unknown key 'n_xz'; did you mean 'n_xy'? [type=unknown_key, ...]
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    renamed: ClassVar[Mapping[str, str]] = {}
    """Old names of keys, and their present ones."""

    @model_validator(mode="wrap")
    @classmethod
    def _say_what_was_meant(cls, values: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if cls.renamed and isinstance(values, Mapping):
            values = with_new_names(values, cls.renamed, cls.__name__)
        try:
            return handler(values)
        except ValidationError as error:
            told = error.errors(include_url=False)
            if not {each["type"] for each in told} & {"extra_forbidden", *_WITH_HINTS}:
                raise
        # Unknown keys first: what else is wrong may follow from them.
        told.sort(key=lambda each: each["type"] not in ("extra_forbidden", "unknown_key"))
        lines = [_with_hint(cls, each) for each in told]
        raise ValidationError.from_exception_data(cls.__name__, lines)


_WITH_HINTS = ("unknown_key", "literal_error")


def _with_hint(section: type[BaseModel], told: Mapping[str, Any]) -> InitErrorDetails:
    """Complete an error of pydantic by what was meant, where it is of an unknown key or choice."""
    kind, said, context = told["type"], told["msg"], told.get("ctx", {})
    if kind in ("extra_forbidden", "unknown_key"):  # the latter of an inner section
        key = ".".join(str(part) for part in told["loc"])
        _, hinted, meant = said.partition("; did you mean ")
        own = str(told["loc"][0]) in section.model_fields or len(told["loc"]) == 1
        hint = _key_meant(section, key) if own else hinted + meant  # of a population's section
        if (
            not hint
            and isinstance(told["input"], Mapping)
            and section.model_config["extra"] == "allow"
        ):
            hint = "; if it is a section of your own population, give its file with --plugin FILE"
        kind, said = "unknown_key", f"unknown key {key!r}{hint}"
    elif kind == "literal_error" and "did you mean" not in said:
        said += _choice_meant(told)
    # The text as a value: it may hold braces, which a template may not.
    error = PydanticCustomError(kind, "{said}", {**context, "said": said})
    return InitErrorDetails(type=error, loc=told["loc"], input=told["input"])


def _choice_meant(told: Mapping[str, Any]) -> str:
    """End an error about an unknown choice with the one that is most like it, if any is."""
    return did_you_mean(str(told["input"]), re.findall(r"'([^']*)'", told["ctx"]["expected"]))


def all_keys(section: type[BaseModel], path: str = "") -> list[str]:
    """Return the dotted keys of a section and of all sections within it.

    Example:
        >>> all_keys(SessionConfig)[:2]
        ['confirm', 'drift']
    """
    keys = []
    for name, field in section.model_fields.items():
        inner = field.annotation
        keys.append(f"{path}{name}")
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            keys += all_keys(inner, f"{path}{name}.")
    return keys


def _key_meant(section: type[BaseModel], key: str) -> str:
    """Guess a key: one of that name in another section, else one like it in the same, or anywhere.

    Args:
        section: Within which all keys are.
        key: Dotted, from that section on.
    """
    known = all_keys(section)
    place, _, last = key.rpartition(".")
    same = [each for each in known if each.rpartition(".")[2] == last]
    if same:
        return f"; did you mean {' or '.join(map(repr, same[:3]))}?"
    beside = {each.rpartition(".")[2]: each for each in known if each.rpartition(".")[0] == place}
    anywhere = {each.rpartition(".")[2]: each for each in reversed(known)}
    for names in (beside, anywhere):
        if (name := nearest(last, names)) is not None:
            return f"; did you mean {names[name]!r}?"
    return did_you_mean(key, known)


class OdometryConfig(Section):
    """Visual odometry: two image regions, matched with their predecessors."""

    use: Literal["auto", "visual", "given"] = Field(
        "auto", description="auto: the source's own odometry where it has one, else visual"
    )
    speed_region: Region | None = Field(
        None, description="x_min, x_max, y_min, y_max in px; none: lower half of the picture"
    )
    turn_region: Region | None = Field(
        None, description="x_min, x_max, y_min, y_max in px; none: upper half of the picture"
    )
    max_shift_px: int = Field(40, ge=1, description="largest offset tried; larger: faster turns")
    fov_deg: float = Field(90.0, gt=0, le=360, description="horizontal view of the whole picture")
    speed_scaling_m_s: float = Field(
        100.0, gt=0, description="speed per unit of profile difference; larger: longer map"
    )
    max_speed_m_s: float = Field(5.0, gt=0, description="speeds are cut here")
    min_speed_m_s: float = Field(0.02, ge=0, description="below it the robot stands still")
    first_frame: Literal["still", "zero_profile"] = Field(
        "still", description="zero_profile: compared with an all-zero profile, as OpenRatSLAM does"
    )


class ViewConfig(Section):
    """Local view cells: how a picture becomes a template and when two are the same place."""

    features: str = Field(
        "grey",
        description="what a template is made of: grey; a network of torchvision and its layer, as "
        "resnet18.layer3; module: one passed in Python",
    )
    weights: str | None = Field(None, description="file of the named network's state_dict")
    crop: Region | None = Field(None, description="x_min, x_max, y_min, y_max in px; none: all")
    template_width: int = Field(60, ge=2, description="px; larger: tells more places apart")
    template_height: int = Field(10, ge=1, description="px")
    threshold: float = Field(
        0.05, gt=0, lt=1, description="largest mean difference that is a match; larger: fewer views"
    )
    shift_match: int = Field(
        4,
        ge=0,
        description="columns a forward view may be shifted by; of a template narrower than 9 px, "
        "if it is not set, the most that leaves a column",
    )
    shift_step: int = Field(1, ge=1, description="columns between two shifts that are tried")
    panoramic: bool = Field(False, description="roll through the full turn, report the heading")
    normalisation: float = Field(0.5, ge=0, le=1, description="mean grey to scale to; 0: off")
    patch_radius: int = Field(0, ge=0, description="patch normalisation over +-k px; 0: off")
    patch_min_std: float = Field(0.0, ge=0, description="flatter patches become 0.5")
    min_contrast: float = Field(
        0.01, ge=0, lt=1, description="std of grey below which a frame shows nothing; 0: off"
    )
    mean_gate: bool = Field(
        False, description="skip templates whose mean differs by more than threshold + 0.005"
    )
    precision: Literal["uint8", "float64"] = Field(
        "uint8", description="how a template is kept: one byte a pixel, or eight"
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
                f"features {self.features} needs weights: a file that holds the network's "
                f"state_dict{did_you_mean(self.features, ('grey', 'module'))}"
            )
        if self.weights is not None and not named:
            raise ValueError(f"weights are of a named network, and features is {self.features}")
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

    n_xy: int = Field(21, ge=7, description="cells a side; it goes round, so it bounds no map")
    n_theta: int = Field(36, ge=7, description="cells in a full turn")
    cell_size_m: float = Field(0.25, gt=0, description="side of a cell; larger: coarser places")
    excite_size: int = Field(7, ge=1, description="odd width of the excitation kernel, cells")
    excite_std_xy: float = Field(1.0, gt=0, description="cells; wider: a broader packet")
    excite_std_theta: float = Field(1.0, gt=0, description="cells, of heading")
    inhibit_size: int = Field(5, ge=1, description="odd width of the inhibition kernel, cells")
    inhibit_std_xy: float = Field(2.0, gt=0, description="cells")
    inhibit_std_theta: float = Field(2.0, gt=0, description="cells, of heading")
    global_inhibition: float = Field(2e-5, ge=0, description="activity taken from every cell")
    inject_energy: float = Field(
        0.2, ge=0, description="activity a known view adds; larger: quicker relocalisation"
    )
    active_decay: float = Field(
        1.0, ge=0, description="fatigue added each time the same view is seen in a row"
    )
    restore: float = Field(0.05, ge=0, description="fatigue every view loses each frame")
    inject_after: int = Field(10, ge=0, description="the newest so many views inject nothing")
    inject_while_few: bool = Field(
        False,
        description="inject always while there are fewer views than that, as OpenRatSLAM does",
    )
    inject_at_cell: bool = Field(
        False, description="inject at the cell below the bound pose, as OpenRatSLAM does"
    )
    exact_gain: bool = Field(
        True, description="make up for the pull of settling; off: the packet lags, as OpenRatSLAM's"
    )
    create_threshold_cells: float = Field(
        2.0, gt=0, description="farther than this from a known place is a new one"
    )
    decode_radius: int = Field(3, ge=0, description="cells around the peak that are averaged")
    precision: Literal["float32", "float64"] = Field("float32", description="of the activity")

    @model_validator(mode="after")
    def _kernels_fit(self) -> Self:
        for name in ("excite_size", "inhibit_size"):
            size = getattr(self, name)
            if size % 2 == 0:
                raise ValueError(f"{name} is {size}, must be odd: a kernel has a centre")
            if size > min(self.n_xy, self.n_theta):
                raise ValueError(f"{name} {size} is wider than the torus")
        return self


class MapConfig(Section):
    """Experience map: a graph of places, relaxed until its links agree."""

    initial_heading_deg: float = Field(90.0, description="heading of the robot at the start")
    solver: Literal["relax", "least_squares"] = Field(
        "relax", description="relax: the paper's Eq. 8; least_squares: sparse pose graph"
    )
    correction: float = Field(
        0.5, gt=0, le=0.5, description="share of its error by which a link moves each of its ends"
    )
    loops: int = Field(20, ge=0, description="relaxation loops a frame, while not at rest")
    rest_tolerance: float = Field(
        1e-6, ge=0, description="largest correction (m, rad) of a map at rest"
    )
    sigma_m: float = Field(0.1, gt=0, description="least_squares: how far a link may be off")
    sigma_rad: float = Field(0.1, gt=0, description="least_squares: and its facing")
    robust: bool = Field(
        False, description="least_squares: loops that contradict the others lose their weight"
    )


class SessionConfig(Section):
    """How sure a brain must be before it joins its map to a stored one."""

    renamed = {"carried": "kidnapped", "carried_factor": "kidnapped_factor"}

    confirm: int = Field(
        4, ge=1, description="places that must agree on how the maps lie; 1: the first view decides"
    )
    drift: float = Field(
        0.25, ge=0, le=1, description="share of the way between them by which they may disagree"
    )
    turn_tolerance_deg: float = Field(
        30.0, gt=0, le=180, description="and by which the turns between them may"
    )
    cells: Literal["turn", "shift", "none"] = Field(
        "turn",
        description="how pose-cell states of a joined map move: shifted and turned; only shifted, "
        "as the paper; not at all",
    )
    kidnapped: Literal["detect", "ignore"] = Field(
        "detect",
        description="a robot whose view changes at once was kidnapped: it goes on with a new "
        "map, which is joined to the old one when that is recognised",
    )
    kidnapped_factor: float = Field(
        3.5, gt=1, description="suddenly: the view changes by so many times what it usually does"
    )
    after_gap: Literal["stop", "new_map"] = Field(
        "stop", description="after a gap longer than max_gap_s: an error, or go on with a new map"
    )
    residual_factor: float = Field(
        2.0, ge=1, description="links may be off by so many times what they were; more: refused"
    )


class BoundaryCellConfig(Section):
    """Boundary cells: a population tuned to the distance and bearing of walls."""

    n_bearings: int = Field(24, ge=3, description="preferred bearings, evenly over the full turn")
    n_distances: int = Field(7, ge=1, description="preferred distances, evenly within reach")
    reach_m: float = Field(0.3, gt=0, description="farther walls are not felt")
    rate_per_s: float = Field(0.8, gt=0, description="growth of the activity at the wall")
    sigma_m: float = Field(0.024, gt=0, description="width of the distance tuning at distance 0")
    beta_m: float = Field(0.15, gt=0, description="at this distance it is twice as wide")
    sigma_bearing_rad: float = Field(0.5, gt=0, description="width of the bearing tuning")


class GridCellConfig(Section):
    """Grid cells: modules of oscillators, and the networks that find hexagons in their phases."""

    spacings_m: tuple[float, ...] = Field(
        (0.35, 0.46, 0.60, 0.78),
        min_length=1,
        description="distance of neighbouring fields, one for each module; ratios near 1.3 "
        "keep places apart. If only orientations_deg is set: the first of these, further ones 1.3 "
        "times the one before",
    )
    orientations_deg: tuple[float, ...] = Field(
        (0.0, 15.0, -10.0, 7.0),
        description="of the grid axes, one for each module. If only spacings_m is set: the first "
        "of these, and 37.08 k degrees of a further module k (the first is 0), within +-30",
    )
    directions: int = Field(
        6, ge=3, description="preferred directions of a module; other than 6: no hexagons"
    )
    n_cells: int = Field(24, ge=1, description="cells a module")
    hebbian_rate: float = Field(0.1, ge=0, description="learning from the phases")
    lateral_rate: float = Field(0.0005, ge=0, description="growth of the inhibition between cells")
    threshold_rate: float = Field(0.02, ge=0, description="adaptation of the thresholds")
    sparseness: float = Field(0.1, gt=0, description="mean response that thresholds lead to")
    silent_fraction: float = Field(0.6, gt=0, lt=1, description="of positions, without firing")
    development_steps: int = Field(
        1000, ge=0, description="steps of learning at random positions before the first frame"
    )
    learns_online: bool = Field(False, description="go on learning while moving")
    seed: int = Field(0, ge=0, description="of the random weights before development")

    @model_validator(mode="before")
    @classmethod
    def _one_list_follows_the_other(cls, values: object) -> object:
        pair = ("spacings_m", "orientations_deg")
        if not isinstance(values, Mapping) or len(values.keys() & set(pair)) != 1:
            return values
        given, other = sorted(pair, key=lambda name: name not in values)
        if not isinstance(values[given], Sequence) or isinstance(values[given], str | bytes):
            return values  # no list: what is wrong with it is told where it is checked
        start = cls.model_fields[other].default
        extend = _more_spacings if other == "spacings_m" else _more_orientations
        n = max(1, len(values[given]))
        return {**values, other: extend(start, n)[:n]}

    @model_validator(mode="after")
    def _modules_agree(self) -> Self:
        if len(self.spacings_m) != len(self.orientations_deg):
            raise ValueError(
                f"spacings_m has {len(self.spacings_m)} modules, orientations_deg "
                f"{len(self.orientations_deg)}; expected the same, or only one of the two"
            )
        if min(self.spacings_m) <= 0:
            raise ValueError(f"spacings_m has {min(self.spacings_m)}; expected more than 0")
        return self


def _more_spacings(spacings_m: tuple[float, ...], n: int) -> tuple[float, ...]:
    """Extend spacings by the ratio of modules, to the centimetre.

    Example:
        >>> _more_spacings((0.6, 0.78), 4)
        (0.6, 0.78, 1.01, 1.31)
    """
    while len(spacings_m) < n:
        spacings_m = (*spacings_m, round(_SPACING_RATIO * spacings_m[-1], 2))
    return spacings_m


def _more_orientations(orientations_deg: tuple[float, ...], n: int) -> tuple[float, ...]:
    """Extend orientations so that no two of few are alike, in [-30, 30) degrees.

    Hexagonal axes are the same again after 60 degrees; multiples of the golden section fill that
    range evenly, however many they are.

    Example:
        >>> _more_orientations((0.0, 15.0, -10.0, 7.0), 6)
        (0.0, 15.0, -10.0, 7.0, 28.3, 5.4)
    """
    further = range(len(orientations_deg), n)
    return orientations_deg + tuple(
        round((60.0 * _GOLDEN * k + 30.0) % 60.0 - 30.0, 1) for k in further
    )


class PlaceCellConfig(Section):
    """Place cells: recruited where none is near, and learning to compete for grid patterns."""

    threshold_m: float = Field(0.06, gt=0, description="no two place cells are nearer than this")
    power: float = Field(90.0, gt=0, description="of the response; larger: sharper fields")
    continuity_m: float = Field(
        0.15, gt=0, description="width around the position within which cells compete"
    )
    hebbian_rate: float = Field(0.05, ge=0, le=1, description="learning of the winner")


class WallMemoryConfig(Section):
    """Memory of walls, and how sure the animal is of its motion and its senses."""

    corrects: bool = Field(True, description="walls correct the position; off: they are only felt")
    spread_m: float = Field(0.25, gt=0, description="a stretch of wall is one memory up to here")
    spread_deg: float = Field(12.0, gt=0, lt=90, description="and within these bearings")
    period_s: float = Field(
        0.25, ge=0, description="time between looks at a wall that tell something new"
    )
    sigma_m: float = Field(0.02, gt=0, description="error of a wall's distance")
    sigma_deg: float = Field(5.0, gt=0, description="error of its bearing")
    speed_scale: float = Field(0.02, ge=0, description="constant error of the speed, a share of it")
    speed_factor: float = Field(
        0.1, ge=0, description="error of the speed that lasts 50 ms, a share of it"
    )
    speed_add_m_s: float = Field(0.01, ge=0, description="and besides")
    heading_white_deg: float = Field(3.0, ge=0, description="error of the heading that lasts 50 ms")
    heading_slow_deg: float = Field(1.0, ge=0, description="error of heading that changes slowly")
    heading_slow_s: float = Field(120.0, gt=0, description="within this time")
    gate: float = Field(5.0, gt=0, description="standard deviations; farther off is another wall")
    view_sigma_m: float = Field(
        0.3, gt=0, description="how far from where a view was learnt it may be recognised"
    )
    lost_after_s: float = Field(
        4.0, gt=0, description="walls contradict the memory for so long: the animal is lost"
    )
