"""Estimate and present state of navigation cells."""

import math
from typing import NamedTuple

from torch import Tensor

from neuroslam.state.tables import Scalars
from neuroslam.types import NO_TEMPLATE


class NavigationEstimate(NamedTuple):
    """Estimate of the navigation cells after a step.

    Attributes:
        position_m: Position relative to the start, ``([batch,] 2)``.
        correction_m: Correction of it by walls in this step, ``([batch,] 2)``.
        place: Number of the winning place cell, ``([batch])``.
        recruited: Whether that cell is new.
        lost: Whether the animal is lost: walls contradict the memory, ``([batch])``.
    """

    position_m: Tensor
    correction_m: Tensor
    place: Tensor
    recruited: Tensor
    lost: Tensor


class NavigationState(Scalars):
    """Present state of navigation cells.

    Attributes:
        since_s: Time since the walls were last compared with those known at the place cell.
        someone_lost: 1 if an animal of the batch is lost.
        lost_s: Time for which animals were lost, summed over animals.
        heading_rad: Measured or integrated heading.
        compass: 1 if the last heading was measured.
        turned_rad: Rotation of the compass into the frame of the map, after a merge.
        last_view: Template of the last view.
        views_agree: Number of views in a row that agree on another position.
        off_x_m: Displacement to that position along x.
        off_y_m: And along y.
    """

    since_s: float
    someone_lost: int
    lost_s: float
    heading_rad: float
    compass: int
    turned_rad: float
    last_view: int
    views_agree: int
    off_x_m: float
    off_y_m: float

    def __init__(self, initial_heading_deg: float) -> None:
        super().__init__(
            since_s=0.0,
            someone_lost=0,
            lost_s=0.0,
            heading_rad=math.radians(initial_heading_deg),
            compass=0,
            turned_rad=0.0,
            last_view=NO_TEMPLATE,
            views_agree=0,
            off_x_m=0.0,
            off_y_m=0.0,
        )
