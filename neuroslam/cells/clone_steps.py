r"""Belief of clone cells: the forward algorithm over the experiences of a map.

Every experience is a clone of what is seen there: many may look the same, and only the path that
led to one distinguishes it (clone-structured recognition, George et al. 2021, *Nature
Communications* 12: 2392). With the belief :math:`\alpha_k` that the robot is at experience
:math:`k`, and :math:`\alpha_0` that it is on ground that the map does not know,

.. math:: \alpha'_k = \ell_k \Bigl(\sum_j \alpha_j\, T_{jk}(d, \theta)
              + \alpha_0\, r d\, \frac{g_k}{\max(1, \sum_i g_i)} + \frac{\kappa d}{n}\Bigr),
          \qquad \alpha'_0 = \ell_0 \Bigl(\alpha_0 + \sum_j \alpha_j\, \lambda d\Bigr),

normalised to a sum of 1. The transitions :math:`T` are the links that were learnt along the path,
each with the distance and the turn that odometry measured; :func:`advance_belief` has them.
:math:`\ell` are likelihoods of the view (:func:`view_evidence`), :math:`g` says how well odometry
fits a loop closure (:func:`reach`), :math:`\kappa` is the rate of silent kidnaps.
"""

import math

import numpy as np

from neuroslam.compiled import compiled, runs_compiled

SPREAD = (0.2, 0.05)
"""Standard deviation of the length of a link: a share of it, and metres."""

TURN_SPREAD = (0.2, 0.25)
"""That of its turn: a share of it, and radians."""

LEAST_TURN = 0.05
"""Smallest likelihood of a turn: odometry may be wrong."""

LEAST = 1e-12
"""Belief that counts as none: the belief is sparse, and costs little on a large map."""

_ROOT_2 = math.sqrt(2.0)

_QUARTILE = 0.6745
"""Upper quartile of the standard normal distribution."""

_SPREADS = (0.05, 0.15)
"""Least and largest standard deviation of match errors, as shares of the usual one."""


def view_evidence(
    errors: np.ndarray,
    others: np.ndarray,
    usual: float,
    alike: float,
    gain: float,
    least: float,
    most: float,
) -> np.ndarray:
    r"""Return log likelihoods of a view at every experience, beside one of unknown ground.

    .. math:: z_k = \frac{e_k - \tilde e}{\sigma}, \qquad
              \ln \ell_k = \min\bigl(\max(-\beta (z_k + z_0),\; -c),\; C\bigr)

    with the median :math:`\tilde e` of the errors with places elsewhere, and their standard
    deviation :math:`\sigma` estimated from the quartile above it: far below it are places that
    look like this one. Where most of the map does, the usual error of the drive is taken instead.

    Args:
        errors: Match error :math:`e` with every experience, ``(n,)``.
        others: Those with places elsewhere, at least one.
        usual: Mean of such errors over the drive so far.
        alike: :math:`z_0`, deviations below the median at which a view decides nothing.
        gain: :math:`\beta`, log odds for each deviation.
        least: :math:`c`: one bad frame decides nothing.
        most: :math:`C`: nor does a good one.

    Example:
        >>> others = np.array([0.05, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3])
        >>> view_evidence(np.array([0.05, 0.3]), others, 0.2, 1.0, 0.5, 1.5, 4.0).round(3)
        array([ 2. , -1.5])
    """
    middle, upper = np.quantile(others, (0.5, 0.75))
    reference = max(float(middle), usual, 1e-9)
    spread = float(upper - middle) / _QUARTILE
    spread = min(max(spread, _SPREADS[0] * reference), _SPREADS[1] * reference)
    return np.clip(-gain * ((errors - reference) / spread + alike), -least, most)


def reach(
    poses: np.ndarray,
    here: tuple[float, float, float],
    path_m: np.ndarray,
    spread_m: float,
    drift: float,
    spread_rad: float,
    drift_rad_m: float,
) -> np.ndarray:
    r"""Return how well odometry explains that the robot is back at each experience, in [0, 1].

    .. math:: g_k = \exp\Bigl(-\frac{|x - x_k|^2}{2 (\sigma_0 + q\,w_k)^2}
                   - \frac{(\theta - \theta_k)^2}{2 (\sigma_\theta + q_\theta w_k)^2}\Bigr)

    Args:
        poses: Of the experiences, ``(n, 3)``: metres and radians.
        here: Pose of the robot by odometry.
        path_m: Path :math:`w_k` driven since the robot was at each, ``(n,)``.
        spread_m: :math:`\sigma_0`.
        drift: :math:`q`, metres a metre.
        spread_rad: :math:`\sigma_\theta`.
        drift_rad_m: :math:`q_\theta`.

    Example:
        >>> poses, path = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), np.array([10.0, 5.0])
        >>> reach(poses, (0.0, 1.0, 0.0), path, 0.5, 0.05, 0.3, 0.0).round(3)
        array([0.607, 0.   ])
    """
    apart = (poses[:, 0] - here[0]) ** 2 + (poses[:, 1] - here[1]) ** 2
    turned = np.abs((poses[:, 2] - here[2] + math.pi) % (2.0 * math.pi) - math.pi)
    away = apart / (spread_m + drift * path_m) ** 2
    return np.exp(-0.5 * (away + (turned / (spread_rad + drift_rad_m * path_m)) ** 2))


def advance_belief_of_arrays(
    belief: np.ndarray,
    since: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    length: np.ndarray,
    facing: np.ndarray,
    moved: tuple[float, float],
    usual_m: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    r"""Move the belief along the links by what odometry measured.

    A robot that has driven :math:`s` from experience :math:`j` has passed a link of length
    :math:`L` with probability :math:`\Phi((s - L) / \sigma_L)`; in a step of :math:`d` it does with

    .. math:: h_{jk} = \frac{\Phi(b_{jk}) - \Phi(a_{jk})}{1 - \Phi(a_{jk})}, \quad
              a = \frac{s - L}{\sigma_L},\; b = \frac{s + d - L}{\sigma_L},
              \qquad T_{jk} = \omega_{jk} h_{jk} / m_j

    with :math:`m_j` links there, weighted by the turn :math:`\omega_{jk} =
    \exp(-(t_j - f_{jk})^2 / 2 \sigma_f^2)`. Distance and turn since each experience are part of
    the state, as means over all paths that lead there. Where no link goes on, the belief leaves the
    map.

    Args:
        belief: :math:`\alpha`, ``(n,)``.
        since: Distance (m) and turn (rad) since each experience, ``(n, 2)``.
        source: Experience at which each link begins, ``(links,)``.
        target: Experience at which it ends.
        length: :math:`L`, metres.
        facing: Turn :math:`f` along it, radians.
        moved: Distance :math:`d` and turn of this step, metres and radians.
        usual_m: Usual length of a link, where none goes on.

    Returns:
        Belief, distances and turns after it, and the belief that has left the map.

    Example:
        >>> chain = np.array([0]), np.array([1]), np.array([1.0]), np.array([0.0])
        >>> moved, _, left = advance_belief_of_arrays(
        ...     np.array([1.0, 0.0]), np.zeros((2, 2)), *chain, (1.0, 0.0), 1.0)
        >>> moved.round(3).tolist(), left
        ([0.5, 0.5], 0.0)
    """
    n, (d, w) = len(belief), moved
    start, first = since[:, 0], since + np.array([d, w])
    some = belief > LEAST
    out, moves = np.zeros(n), some[source]
    s, t, k = source[moves], target[moves], np.flatnonzero(moves)
    count = np.bincount(s, minlength=n)
    sigma = SPREAD[0] * length[k] + SPREAD[1]
    passed = _hazard((start[s] - length[k]) / sigma, (first[s, 0] - length[k]) / sigma)
    off = (first[s, 1] - facing[k] + math.pi) % (2.0 * math.pi) - math.pi
    agrees = np.exp(-0.5 * (off / (TURN_SPREAD[0] * np.abs(facing[k]) + TURN_SPREAD[1])) ** 2)
    share = passed / count[s]
    arrives = belief[s] * share * np.maximum(agrees, LEAST_TURN)
    np.add.at(out, s, share)
    dead = some & (np.bincount(source, minlength=n) == 0)
    sigma_0 = SPREAD[0] * usual_m + SPREAD[1]
    out[dead] = _hazard((start[dead] - usual_m) / sigma_0, (first[dead, 0] - usual_m) / sigma_0)
    stays = np.where(some, belief * (1.0 - out), 0.0)
    after, sums = stays.copy(), stays[:, None] * first
    np.add.at(after, t, arrives)
    np.add.at(sums, t, arrives[:, None] * (first[s] - np.column_stack([length[k], facing[k]])))
    left = float((belief[dead] * out[dead]).sum())
    means = np.where(after[:, None] > LEAST, sums / np.maximum(after, LEAST)[:, None], 0.0)
    return np.where(after > LEAST, after, 0.0), means, left


def _hazard(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the probability that a normal number above ``a`` is below ``b``."""
    erf = np.vectorize(math.erf, otypes=[np.float64])
    before, until = 0.5 * (1.0 + erf(a / _ROOT_2)), 0.5 * (1.0 + erf(b / _ROOT_2))
    rest = np.maximum(1.0 - before, 1e-9)
    return np.clip((until - before + (rest <= 1e-9)) / rest, 0.0, 1.0)


@compiled
def advance_belief_step(
    belief: np.ndarray,
    since: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    length: np.ndarray,
    facing: np.ndarray,
    moved: tuple[float, float],
    usual_m: float,
    spread: tuple[float, float],
    turn_spread: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, float]:
    """Do as :func:`advance_belief_of_arrays`, in three passes over the links."""
    n, left = belief.size, 0.0
    count, out, after = np.zeros(n), np.zeros(n), np.zeros(n)
    sums = np.zeros((n, 2))
    for i in range(source.size):
        count[source[i]] += 1.0
    for i in range(source.size + n):
        j = source[i] if i < source.size else i - source.size
        if belief[j] <= 1e-12 or (i >= source.size and count[j] > 0.0):
            continue
        metres = length[i] if i < source.size else usual_m
        sigma = spread[0] * metres + spread[1]
        a, b = (since[j, 0] - metres) / sigma, (since[j, 0] + moved[0] - metres) / sigma
        before, until = 0.5 * (1.0 + math.erf(a / _ROOT_2)), 0.5 * (1.0 + math.erf(b / _ROOT_2))
        rest = max(1.0 - before, 1e-9)
        passed = min(max((until - before + (1.0 if rest <= 1e-9 else 0.0)) / rest, 0.0), 1.0)
        if i >= source.size:
            out[j] = passed
            left += belief[j] * passed
            continue
        share = passed / count[j]
        out[j] += share
        turn = since[j, 1] + moved[1] - facing[i]
        off = (turn + math.pi) % (2.0 * math.pi) - math.pi
        off /= turn_spread[0] * abs(facing[i]) + turn_spread[1]
        arrives = belief[j] * share * max(math.exp(-0.5 * off * off), 0.05)
        k = target[i]
        after[k] += arrives
        sums[k, 0] += arrives * (since[j, 0] + moved[0] - metres)
        sums[k, 1] += arrives * turn
    for j in range(n):
        if belief[j] > 1e-12:
            stays = belief[j] * (1.0 - out[j])
            after[j] += stays
            sums[j, 0] += stays * (since[j, 0] + moved[0])
            sums[j, 1] += stays * (since[j, 1] + moved[1])
        if after[j] > 1e-12:
            sums[j, 0] /= after[j]
            sums[j, 1] /= after[j]
        else:
            after[j] = sums[j, 0] = sums[j, 1] = 0.0
    return after, sums, left


def advance_belief(
    belief: np.ndarray,
    since: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    length: np.ndarray,
    facing: np.ndarray,
    moved: tuple[float, float],
    usual_m: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Do as :func:`advance_belief_of_arrays`, compiled where that is possible."""
    rows = belief, since, source, target, length, facing, moved, usual_m
    if runs_compiled():
        return advance_belief_step(*rows, SPREAD, TURN_SPREAD)
    return advance_belief_of_arrays(*rows)


def entropy_bits(belief: np.ndarray, unknown: float) -> float:
    r"""Return :math:`-\sum_k \alpha_k \log_2 \alpha_k`, with unknown ground as one place more.

    Example:
        >>> entropy_bits(np.array([0.5, 0.25]), 0.25)
        1.5
    """
    some = np.append(belief[belief > LEAST], max(unknown, LEAST))
    return abs(float((some * np.log2(some)).sum()))
