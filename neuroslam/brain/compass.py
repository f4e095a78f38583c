"""The compass of a brain without a population that corrects by compass: it turns the map."""

import math

from neuroslam.geometry import wrap_angle
from neuroslam.state.mergeable import AboutNow
from neuroslam.state.population import Correction
from neuroslam.state.tables import Scalars
from neuroslam.types import Motion

_AVERAGED_S = 2.0  # time constant of the average over compass noise


class Compass(Scalars, AboutNow):
    r"""Heading of the robot from compass and turn rate, as applied to the map.

    A complementary filter: :math:`\theta \leftarrow \theta + \omega\,\Delta t + (1 - e^{-\Delta t /
    \tau})(\theta_c - \theta)`, with :math:`\tau` = 2 s.
    """

    heading_rad: float
    known: int

    def __init__(self) -> None:
        super().__init__(heading_rad=0.0, known=0)

    def step(self, heading_rad: float | None, motion: Motion) -> Correction | None:
        """Advance by a frame; return the turn of the map towards the compass.

        Args:
            heading_rad: Measured heading; ``None``: not in this frame.
            motion: Motion since the last frame.
        """
        if heading_rad is None and not self.known:
            return None
        self.heading_rad += motion.w_rad_s * motion.dt_s
        if heading_rad is None:
            return None
        if not self.known:
            self.heading_rad, self.known = heading_rad, 1
        off = wrap_angle(heading_rad - self.heading_rad)
        turn = off * (1.0 - math.exp(-motion.dt_s / _AVERAGED_S))
        self.heading_rad += turn
        return Correction(turn_rad=turn)
