"""How the experiences of a map are used, and where those are that it has forgotten."""

import math
from typing import ClassVar

import numpy as np
import torch

from neuroslam.geometry import wrap_angles
from neuroslam.state.tables import GrowingTable

HALF_LIFE = 4
"""Arrivals at experiences, as a multiple of the cap, after which a visit counts half."""

LONG = 10_000
"""Experiences that count as the cap of a map without one."""

PASS = 20
"""Arrivals after which the robot comes close to an experience for another time."""

TURN_RAD = math.radians(30.0)
"""Largest difference of heading of two experiences that are close to each other."""


class Usage(GrowingTable):
    """Use of every experience; empty in a map that forgets nothing, and then no part of a state.

    Columns: ``visits``, the number of arrivals, halved every so many; ``at``, the number of the
    arrival, of all of the map, at which the robot was there last; ``near``, that at which it was
    last there or close by; ``missed``, how many times in a row it passed close by without arriving.
    """

    optional: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__(
            {"visits": ((), torch.float64)}
            | {name: ((), torch.int64) for name in ("at", "near", "missed")}
        )

    @property
    def arrivals(self) -> int:
        """Number of the last arrival."""
        return int(self.array("at").max(initial=0))

    def extend(self, n: int) -> None:
        """Append rows until there are ``n``."""
        while self.n < n:
            self.append(visits=0.0, at=0, near=self.arrivals, missed=0)

    def arrive(self, here: int, half_life: float, close: np.ndarray | None) -> None:
        """Count an arrival at an experience.

        Args:
            here: The experience.
            half_life: Arrivals after which a visit counts half.
            close: Experiences close to it, ``bool``, ``(n,)``; ``None``: not of interest.

        Example:
            >>> usage = Usage()
            >>> usage.extend(2)
            >>> for here in (0, 1, 1):
            ...     usage.arrive(here, 1.0, np.array([True, True]))
            >>> usage["visits"].tolist(), usage["at"].tolist(), usage["missed"].tolist()
            ([1.0, 1.5], [1, 3], [0, 0])
        """
        now = self.arrivals + 1
        visits, at, near, missed = (self.array(name) for name in self.columns)
        if close is not None:
            again = close & (now - near > PASS)
            missed[again] += 1
            near[close] = now
        visits[here] = visits[here] * 2.0 ** ((at[here] - now) / half_life) + 1.0
        at[here] = near[here] = now
        missed[here] = 0

    def log_use(self, half_life: float) -> np.ndarray:
        r"""Return the logarithm of the present use, up to a constant: often and lately is most.

        .. math:: \log_2 \sum_k 2^{-(t - t_k)/h} + t/h = \log_2 v + t_{\mathrm{last}}/h

        Example:
            >>> usage = Usage()
            >>> usage.extend(2)
            >>> for here in (0, 0, 1):
            ...     usage.arrive(here, 2.0, None)
            >>> usage.log_use(2.0).round(2).tolist()
            [1.77, 1.5]
        """
        visits, at = self.array("visits"), self.array("at")
        result: np.ndarray = np.log2(np.maximum(visits, 1e-12)) + at / half_life
        return result


class Forgotten(GrowingTable):
    """Where the experiences are that the map has forgotten; empty in a map that forgets nothing.

    Columns: ``session`` that made it, its ``number`` there, its ``first_frame``, the ``experience``
    that it is part of, and its ``pose`` in the frame of that one. The trajectory needs them.
    """

    optional: ClassVar[bool] = True

    def __init__(self) -> None:
        names = ("session", "number", "first_frame", "experience")
        super().__init__(
            {name: ((), torch.int64) for name in names} | {"pose": ((3,), torch.float64)}
        )


def close_to(poses: np.ndarray, here: int, radius_m: float) -> np.ndarray:
    """Return which experiences are within a radius of one, with a similar heading.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [0.5, 0.0, 3.0], [2.0, 0.0, 0.0]])
        >>> close_to(poses, 0, 1.0).tolist()
        [True, True, False, False]
    """
    apart = poses - poses[here]
    near: np.ndarray = apart[:, 0] ** 2 + apart[:, 1] ** 2 <= radius_m * radius_m
    near &= np.abs(wrap_angles(apart[:, 2])) <= TURN_RAD
    return near
