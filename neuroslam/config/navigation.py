"""Sections of a brain's config: boundary, grid and place cells, and the memory of walls."""

from collections.abc import Mapping, Sequence
from typing import Literal, Self

from pydantic import Field, model_validator

from neuroslam.config.bounds import LARGEST_SEED, MOST_CELLS, MOST_MODULES, MOST_STEPS
from neuroslam.config.section import Section

_SPACING_RATIO = 1.3  # spacing of a grid module over that of the next smaller one
_GOLDEN = 0.6180339887498949


class BoundaryCellConfig(Section):
    """Boundary cells: a population tuned to the distance and bearing of walls."""

    n_bearings: int = Field(
        default=24,
        ge=3,
        le=MOST_CELLS,
        description="number of preferred bearings, evenly over the full turn; larger: finer "
        "bearing",
    )
    n_distances: int = Field(
        default=7,
        ge=1,
        le=MOST_CELLS,
        description="number of preferred distances, evenly up to reach_m; larger: finer distance",
    )
    reach_m: float = Field(
        default=0.3,
        gt=0,
        description="largest distance at which a wall is sensed; larger: farther walls drive the "
        "cells",
    )
    rate_per_s: float = Field(
        default=0.8,
        gt=0,
        description="growth rate of the population's activity at the wall; larger: activity rises "
        "and falls faster",
    )
    sigma_m: float = Field(
        default=0.024,
        gt=0,
        description="width of the distance tuning for a wall at distance 0; larger: broader fields",
    )
    beta_m: float = Field(
        default=0.15,
        gt=0,
        description="preferred distance at which the distance tuning is twice as wide; larger: "
        "tuning widens less with distance",
    )
    sigma_bearing_rad: float = Field(
        default=0.5, gt=0, description="width of the bearing tuning; larger: broader fields"
    )
    sheet_bearings: int = Field(
        default=72,
        ge=16,
        le=MOST_CELLS,
        description="cells of the sheet around the full turn, if wall_memory.senses is "
        "boundary_cells; larger: finer bearing, slower",
    )
    sheet_sigma_bearing_rad: float = Field(
        default=0.15,
        ge=0.08,
        le=1.0,
        description="width of the sheet's tuning to bearing; larger: walls farther apart merge",
    )
    sheet_excitation: float = Field(
        default=0.5,
        ge=0,
        description="gain of the excitation between neighbours on the sheet; larger: noise is "
        "averaged over more cells",
    )
    sheet_inhibition: float = Field(
        default=0.8,
        ge=0,
        description="gain of the inhibition by the surround on the sheet; larger: weak responses "
        "beside strong ones are suppressed",
    )
    sheet_share: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="response of a local maximum that is read as a wall, as a share of that to one "
        "clear wall; larger: fewer false walls, more missed ones",
    )


class GridCellConfig(Section):
    """Grid cells: modules of oscillators, and networks that learn hexagons from their phases."""

    spacings_m: tuple[float, ...] = Field(
        default=(0.35, 0.46, 0.60, 0.78),
        min_length=1,
        max_length=MOST_MODULES,
        description="distance of neighbouring firing fields, one for each module; ratios near 1.3 "
        "make positions distinct. If only orientations_deg is set: the first of these, each "
        "further one 1.3 times the one before",
    )
    orientations_deg: tuple[float, ...] = Field(
        default=(0.0, 15.0, -10.0, 7.0),
        max_length=MOST_MODULES,
        description="orientation of the grid axes, one for each module. If only spacings_m is set: "
        "the first of these, then 37.08 k degrees for module k (from 0), wrapped to [-30, 30)",
    )
    directions: int = Field(
        default=6,
        ge=3,
        le=MOST_CELLS,
        description="preferred directions of the oscillators of a module; only 6 gives hexagonal "
        "fields",
    )
    n_cells: int = Field(
        default=24,
        ge=1,
        le=MOST_CELLS,
        description="cells of a module; larger: positions are distinguished better, each step "
        "takes longer",
    )
    hebbian_rate: float = Field(
        default=0.1,
        ge=0,
        description="learning rate of the weights from the oscillators; larger: faster, less "
        "stable",
    )
    self_motion: Literal["measured", "cells"] = Field(
        default="measured",
        description="what moves the phases: the measured speed and heading, or those of speed and "
        "head-direction cells, as far as the brain has them",
    )
    lateral_rate: float = Field(
        default=0.0005,
        ge=0,
        description="learning rate of the inhibition between cells; larger: cells become different "
        "sooner",
    )
    lateral: Literal["learned", "kernel", "both"] = Field(
        default="learned",
        description="coupling of the cells of a module: learned inhibition; a kernel over the "
        "sheet on which they lie, that excites neighbours; or both added up",
    )
    excitation: float = Field(
        default=2.0,
        ge=0,
        description="strength of the kernel's excitation; larger: neighbours fire more alike",
    )
    excitation_cells: float = Field(
        default=1.0,
        gt=0,
        description="width of the kernel's excitation in cells; larger: reaches farther",
    )
    inhibition: float = Field(
        default=2.0,
        ge=0,
        description="strength of the kernel's inhibition; larger: cells far apart fire less alike",
    )
    inhibition_cells: float = Field(
        default=2.0,
        gt=0,
        description="width of the kernel's inhibition in cells; larger: reaches farther",
    )
    threshold_rate: float = Field(
        default=0.02,
        ge=0,
        description="learning rate of the cells' thresholds; larger: faster, less stable",
    )
    sparseness: float = Field(
        default=0.1,
        gt=0,
        description="mean response that the thresholds settle at; larger: cells respond to more "
        "inputs while they learn",
    )
    silent_fraction: float = Field(
        default=0.6,
        gt=0,
        lt=1,
        description="share of positions at which a cell is silent; larger: smaller fields",
    )
    development_steps: int = Field(
        default=1000,
        ge=0,
        le=MOST_STEPS,
        description="learning steps at random positions before the first frame; larger: cleaner "
        "hexagons, a slower start; 0: random weights",
    )
    learns_online: bool = Field(
        default=False, description="continue learning while the animal moves"
    )
    online_share: float = Field(
        default=0.01,
        gt=0,
        le=1,
        description="learning rates while the animal moves, as a share of those of development, "
        "which average over 64 independent positions; larger: learns sooner, but fields wander",
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=LARGEST_SEED,
        description="seed of the random weights before development",
    )

    @model_validator(mode="before")
    @classmethod
    def _one_list_follows_the_other(cls, values: object) -> object:
        pair = ("spacings_m", "orientations_deg")
        if not isinstance(values, Mapping) or len(values.keys() & set(pair)) != 1:
            return values
        given, other = sorted(pair, key=lambda name: name not in values)
        if not isinstance(values[given], Sequence) or isinstance(values[given], str | bytes):
            return values  # not a list: the field's own check reports it
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
    """Place cells: recruited where none is near; they compete for patterns of the grid cells."""

    threshold_m: float = Field(
        default=0.06,
        gt=0,
        description="smallest distance between two place cells; larger: fewer cells, a coarser map",
    )
    power: float = Field(
        default=90.0,
        gt=0,
        description="exponent of a cell's similarity to the grid pattern; larger: smaller place "
        "fields",
    )
    continuity_m: float = Field(
        default=0.15,
        gt=0,
        description="width of the Gaussian around the position within which cells compete; larger: "
        "cells farther away can win",
    )
    hebbian_rate: float = Field(
        default=0.05,
        ge=0,
        le=1,
        description="share by which the winner's weights move to the grid pattern in a step; "
        "larger: faster, forgets sooner; 0: no learning",
    )
    excitation: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="how strongly a place cell excites its neighbours before cells compete; "
        "larger: a wider bump; 0: the cell with the largest response wins",
    )
    excitation_m: float = Field(
        default=0.06,
        gt=0,
        description="width of the Gaussian over the distance of place cells by which they excite "
        "each other; larger: reaches farther cells",
    )
    inhibition: float = Field(
        default=0.3,
        ge=0,
        lt=1,
        description="share of the largest activity that global inhibition takes from all place "
        "cells; larger: fewer cells in the bump",
    )


class WallMemoryConfig(Section):
    """Memory of walls, and the noise of motion and senses that it assumes."""

    senses: Literal["walls", "boundary_cells"] = Field(
        default="walls",
        description="what the memory and the familiarity of walls take: the walls as measured, or "
        "what is read from the sheet of boundary cells",
    )

    corrects: bool = Field(
        default=True,
        description="remembered walls correct the position; off: walls only drive the boundary "
        "cells",
    )
    spread_m: float = Field(
        default=0.25,
        gt=0,
        description="distance within which a wall segment is one memory; larger: fewer, longer "
        "segments",
    )
    spread_deg: float = Field(
        default=12.0,
        gt=0,
        lt=90,
        description="difference of bearing within which a wall segment is one memory; larger: "
        "fewer segments",
    )
    period_s: float = Field(
        default=0.25,
        ge=0,
        description="time between two corrections by walls; larger: fewer, more independent "
        "measurements",
    )
    sigma_m: float = Field(
        default=0.02,
        gt=0,
        description="standard deviation of a measured wall distance; larger: walls correct less",
    )
    sigma_deg: float = Field(
        default=5.0,
        gt=0,
        description="standard deviation of a measured wall bearing; larger: walls correct less",
    )
    speed_scale: float = Field(
        default=0.02,
        ge=0,
        description="standard deviation of the constant error of speed, as a share of it; larger: "
        "walls correct the measured speed more",
    )
    speed_factor: float = Field(
        default=0.1,
        ge=0,
        description="standard deviation of the random error of speed (it lasts 50 ms), as a share "
        "of it; larger: walls correct the position more",
    )
    speed_add_m_s: float = Field(
        default=0.01,
        ge=0,
        description="standard deviation of the random error of speed that does not depend on "
        "speed; larger: walls correct the position more",
    )
    heading_white_deg: float = Field(
        default=3.0,
        ge=0,
        description="standard deviation of the random error of heading (it lasts 50 ms); larger: "
        "walls correct the position more",
    )
    heading_slow_deg: float = Field(
        default=1.0,
        ge=0,
        description="standard deviation of the slowly changing error of heading; larger: walls "
        "correct the measured heading more",
    )
    heading_slow_s: float = Field(
        default=120.0,
        gt=0,
        description="correlation time of the slowly changing error of heading; larger: it is "
        "averaged over more walls",
    )
    gate: float = Field(
        default=5.0,
        gt=0,
        description="residual, in standard deviations, above which a measured wall is taken for "
        "another wall; larger: fewer are rejected",
    )
    view_sigma_m: float = Field(
        default=0.3,
        gt=0,
        description="standard deviation of the position at which a known view is recognised; "
        "larger: views correct less. Three times it is the farthest that a match is plausible",
    )
    lost_after_s: float = Field(
        default=4.0,
        gt=0,
        description="time for which walls must contradict the memory before the animal is lost; "
        "larger: later, fewer false alarms",
    )
