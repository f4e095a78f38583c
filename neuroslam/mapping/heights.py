r"""Heights of the experiences of a map: the fourth degree of freedom of its graph.

Gravity fixes roll and pitch, so a rise between two experiences does not depend on their headings
and positions: the graph in x, y, z and heading is the graph in the plane beside a graph of heights,
and relaxation of the two is independent. A link from :math:`s` to :math:`t` with the measured rise
:math:`h` moves both of its ends,

.. math:: z_s \leftarrow z_s + \alpha\, e,\quad z_t \leftarrow z_t - \alpha\, e,
          \qquad e = z_t - z_s - h

as RatSLAM's relaxation does in the plane (:mod:`~neuroslam.mapping.relax`).
"""

from typing import NamedTuple

import numpy as np

from neuroslam import compiled as switch
from neuroslam.compiled import compiled


class Rises(NamedTuple):
    """Rises measured between experiences; arrays of one length.

    Attributes:
        source: Experience at which the rise begins.
        target: Experience at which it ends.
        rise_m: Height of target above source.
    """

    source: np.ndarray
    target: np.ndarray
    rise_m: np.ndarray


def relax_heights(
    z_m: np.ndarray, rises: Rises, loops: int, correction: float, tolerance: float = 0.0
) -> float:
    """Relax heights in place, rise by rise in their order; the equation is at the top.

    Args:
        z_m: Heights of all experiences, ``float64 (n,)``.
        rises: What was measured.
        loops: Largest number of loops.
        correction: Share of its error by which a rise moves each of its ends, in (0, 0.5].
        tolerance: Relaxation stops after a loop in which no rise moved an end farther.

    Returns:
        The largest correction of the last loop, in metres; 0 without loops or rises.

    Example:
        >>> z = np.array([0.0, 1.0])
        >>> relax_heights(z, Rises(np.array([0]), np.array([1]), np.array([3.0])), 1, 0.5)
        1.0
        >>> z.tolist()
        [-1.0, 2.0]
    """
    step = relax_heights_step if switch.ENABLED else relax_heights_step.plain
    return float(step(z_m, *rises, loops, correction, tolerance))


@compiled
def relax_heights_step(
    z_m: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    rise_m: np.ndarray,
    loops: int,
    correction: float,
    tolerance: float,
) -> float:
    """Do as :func:`relax_heights`; the same loop is its definition, run by Python."""
    largest = 0.0
    for _ in range(loops):
        largest = 0.0
        for k in range(source.size):
            s, t = source[k], target[k]
            error = correction * (z_m[t] - z_m[s] - rise_m[k])
            z_m[s] += error
            z_m[t] -= error
            largest = max(largest, abs(error))
        if largest <= tolerance:
            break
    return largest


def contract_rises(rises: Rises, z_m: np.ndarray, root: np.ndarray) -> Rises:
    r"""Lead the rises of forgotten experiences to those that they have become part of.

    .. math:: h_{uv} = (z_s - z_u) + h_{st} - (z_t - z_v)

    which leaves its residual what it was. Rises within one experience, and a second one between
    two, are left out; ids are the old ones.

    Args:
        rises: Of the map.
        z_m: Heights of all experiences, ``(n,)``.
        root: Experience that each is part of from now on, itself if it is kept, ``(n,)``.

    Example:
        >>> chain = Rises(np.array([0, 1]), np.array([1, 2]), np.array([1.0, 2.0]))
        >>> [c.tolist() for c in contract_rises(chain, np.arange(3.0), np.array([0, 0, 2]))]
        [[0], [2], [3.0]]
    """
    own = z_m - z_m[root]
    source, target = root[rises.source], root[rises.target]
    rise = own[rises.source] + rises.rise_m - own[rises.target]
    key = (np.maximum(source, target) << 32) | np.minimum(source, target)
    moved = (source != rises.source) | (target != rises.target)
    order = np.lexsort((np.arange(len(key)), moved, key))
    first = np.zeros(len(key), dtype=bool)
    first[order] = np.append(True, np.diff(key[order]) != 0)[: len(order)]
    kept = first & (source != target)
    return Rises(source[kept], target[kept], rise[kept])
