"""Detection of kidnapping: a sudden change of view, larger than the changes while driving."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuroslam.config import BrainConfig
from neuroslam.state.mergeable import AboutNow
from neuroslam.state.tables import Scalars
from neuroslam.types import Velocity
from neuroslam.view.search import Geometry, distances
from neuroslam.view.templates import to_bytes

_SETTLED = 30
"""Frames after which the median change is known."""

_STEP = 0.02
"""Relative step of the running median per frame."""

_ROUGH, _CALMS = 2.0, 0.8
"""Change, as a multiple of the largest recent one, below which it is a bump that goes on, and the
share of that largest one that is left after a frame."""


class Change(Scalars):
    """How the views of a drive change.

    Attributes:
        frames: How many were compared.
        usual: Running median of the change between two.
        recent: Largest change of the last frames, which fades.
        turned: By how many columns of a view the robot turned since the last one.
    """

    frames: int
    usual: float
    recent: float
    turned: float


class Comparison(NamedTuple):
    """A view beside the one before.

    Attributes:
        change: Mean difference at the best shift; 0 for the first view.
        broken: Whether driving cannot explain it.
    """

    change: float
    broken: bool


class Continuity(AboutNow):
    r"""Decides from two successive views whether the robot was kidnapped between them.

    The change :math:`d` between two frames is the mean difference of their views at the best shift.
    The robot was kidnapped if :math:`d > \max(\theta, f\,\tilde d, 2 m)`, with the match threshold
    :math:`\theta`, the factor :math:`f`, the running median :math:`\tilde d` and the largest recent
    change :math:`m \leftarrow \max(0.8\, m, d)`: a bump or a blurred turn builds up over some
    frames, a kidnapping comes out of calm. A turn beyond the range of shifts makes such a change
    too and is ignored.
    """

    before: Tensor

    def __init__(self, config: BrainConfig) -> None:
        super().__init__()
        self.factor = config.sessions.kidnapped_factor
        self.threshold = config.view.threshold
        self.shift = math.inf if config.view.panoramic else config.view.shift_match
        self.columns_per_rad = config.view.template_width / math.radians(config.odometry.fov_deg)
        self.geometry = Geometry.of(config.view)
        self.state = Change(frames=0, usual=0.3 * config.view.threshold, recent=0.0, turned=0.0)
        n_pixels = config.view.template_width * config.view.template_height
        self.register_buffer("before", torch.zeros(n_pixels, dtype=torch.uint8))

    def compare(self, view: np.ndarray) -> Comparison:
        """Return the change since the last view, and whether it is a kidnapping; store the view.

        Args:
            view: View from :meth:`~neuroslam.view.templates.LocalViewCells.encode`.
        """
        s, query = self.state, to_bytes(view.T)
        before, self.before = self.before, torch.from_numpy(query.reshape(-1))
        s.frames += 1
        if s.frames == 1:
            return Comparison(0.0, False)
        apart = distances(before.numpy(force=True)[None], query, self.geometry).min()
        change = float(apart) / (255.0 * self.geometry.n_pixels)
        broken = (
            s.frames > _SETTLED
            and change > max(self.threshold, self.factor * s.usual, _ROUGH * s.recent)
            and s.turned <= self.shift
        )
        s.recent = max(_CALMS * s.recent, change)
        if not broken:
            step = max(_STEP, 1.0 / s.frames) * max(s.usual, 0.05 * self.threshold)
            s.usual += math.copysign(step, change - s.usual)
        return Comparison(change, broken)

    def moved(self, velocity: Velocity, dt_s: float) -> None:
        """Store the turn of the robot for the next comparison."""
        self.state.turned = abs(velocity.w_rad_s) * dt_s * self.columns_per_rad
