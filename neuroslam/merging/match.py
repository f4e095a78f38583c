"""Matching of two finished maps: every template of each is compared with those of the other."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import counted
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import Tolerance, agreeing, n_places
from neuroslam.mapping.tables import Origins, origin_key
from neuroslam.merging.candidates import Candidates, find_candidates
from neuroslam.merging.consistency import check_consistency, weakness
from neuroslam.merging.limits import elsewhere, far_off, tolerance
from neuroslam.merging.mapped import SAME_CONFIG, Mapped, differing
from neuroslam.state.match import Match, Pairs
from neuroslam.state.sessions import session_name


class Found(NamedTuple):
    """The match of two maps, or the reason why there is none.

    Attributes:
        match: ``None`` if none was found.
        reason: How the match was found, or why there is none.
        groups: Sizes of the groups of agreeing experiences, the largest first.
    """

    match: Match | None
    reason: str
    groups: tuple[int, ...] = ()


def find_match(loaded: Mapped, partial: Mapped) -> Found:
    """Find the experiences that two maps share.

    Experiences of a session that both maps hold are the same. Otherwise every template of either
    map is compared with those of the other. A group of at least ``sessions.confirm`` experiences
    that agree on the alignment is accepted: the largest one, and those consistent with it.

    Args:
        loaded: One brain; it is not altered.
        partial: The other, whose config sets ``sessions.confirm``; it is not altered.
    """
    apart = differing(loaded, partial)
    if apart:
        return Found(None, f"the maps have different configs: {'; '.join(apart)}; {SAME_CONFIG}")
    for name, brain in (("first", loaded), ("second", partial)):
        if not brain.map.n:
            return Found(None, f"the {name} map is empty")
    shared = shared_history(loaded, partial)
    if shared is not None:
        return shared
    leader = partial.leader
    if not leader.relaxes_map:
        maps = loaded.map.poses, partial.map.poses
        return Found(*leader.match(loaded.leader, maps, partial.config))
    return _match_views(loaded, partial)


def _match_views(loaded: Mapped, partial: Mapped) -> Found:
    """Match the templates of either map with the other, and keep the pairs that agree."""
    config = partial.config
    threshold, confirm = config.view.threshold, config.sessions.confirm
    candidates = find_candidates(loaded, partial)
    pairs = candidates.pairs
    if not len(pairs.partial):
        return Found(None, _none_alike(candidates, threshold))
    limits = tolerance((loaded.map, partial.map), config)
    groups = [pairs.pick(g) for g in agreeing(pairs, partial.map.poses, loaded.map.poses, limits)]
    sizes = tuple(n_places(group) for group in groups)
    if sizes[0] < confirm:
        return Found(
            None,
            f"{counted(len(np.unique(pairs.partial)), 'experience')} matched by view, but at most "
            f"{sizes[0]} agree on the alignment; expected {confirm} (--confirm); "
            + _remedy(candidates, threshold),
            sizes,
        )
    confirmed = [group for group, size in zip(groups, sizes, strict=True) if size >= confirm]
    first = confirmed[0]
    at = int(np.argmin(first.error))
    consistent = [g for g in confirmed[1:] if _fits(first, at, g, loaded.map, partial.map, limits)]
    matched = Pairs(*(np.concatenate(columns) for columns in zip(first, *consistent, strict=True)))
    if config.sessions.check_residuals:
        result = check_consistency(loaded.map, partial.map, matched, config, robust=True)
        refused = weakness(loaded, partial, matched, result)
        if refused:
            return Found(None, refused, sizes)
        matched = matched.pick(result.inlier)
        # Beyond the threshold a view is another view: such pairs are evidence, not one experience.
        within = matched.pick(matched.error <= threshold)
        matched = within if n_places(within) >= confirm else matched
        at = int(np.argmin(matched.error))
    match = Match(
        loaded=int(matched.loaded[at]),
        partial=int(matched.partial[at]),
        turn_rad=float(matched.turn_rad[at]),
        error=float(matched.error[at]),
        runner_up=_runner_up(loaded, partial, matched, at, limits),
        others=_once(matched),
    )
    return Found(match, f"{counted(len(match.pairs.partial), 'experience')} matched by view", sizes)


def _remedy(candidates: Candidates, threshold: float) -> str:
    distinct = len(np.unique(candidates.pairs.partial))
    if 2 * distinct < candidates.alike:
        return (
            f"{candidates.alike - distinct} more match at several places: make both maps with "
            f"view.threshold below {threshold:g}"
        )
    return "drive more of the common path in both sessions"


def _none_alike(candidates: Candidates, threshold: float) -> str:
    """Return why there are no candidates, and what helps."""
    if candidates.alike:
        n = counted(candidates.alike, "experience")
        return (
            f"{n} matched by view, but no view is distinct: each matches several places of a map; "
            f"make both maps with view.threshold below {threshold:g}, or with larger templates"
        )
    nearest = (
        "" if candidates.best is None else f"; the smallest match error is {candidates.best:.4f}"
    )
    return (
        f"no view of one map matches one of the other within {threshold:g}{nearest}; if both show "
        "one place, drive more of it the same way, or try a larger --set view.threshold"
    )


def shared_history(loaded: Mapped, partial: Mapped) -> Found | None:
    """Match the experiences of a session that both maps hold; ``None`` if they share no session.

    Args:
        loaded: One brain; it is not altered.
        partial: The other; it is not altered.
    """
    mine, theirs = loaded.map.origins(), partial.map.origins()
    keys = [origin_key(o._asdict()) for o in (mine, theirs)]
    _, i, j = np.intersect1d(keys[0], keys[1], return_indices=True)
    if not len(i):
        return None
    one, other = (Origins(*(c[k] for c in o)) for o, k in ((mine, i), (theirs, j)))
    pixels = [_pixels(loaded, one.experience), _pixels(partial, other.experience)]
    aliased = (np.isin(keys[0][i], origin_key(_aliases(loaded.map)))
               | np.isin(keys[1][j], origin_key(_aliases(partial.map))))  # fmt: skip
    differ = one.first_frame != other.first_frame
    differ |= ~aliased & (pixels[0] != pixels[1]).any(axis=1)
    if differ.any():
        k = int(np.argmax(differ))
        return Found(
            None,
            f"both maps hold session {session_name(int(one.session[k]))}, but its experience "
            f"{one.number[k]} differs: two copies of the session were continued differently",
        )
    pairs = _once(
        Pairs(
            other.experience, one.experience, one.turn_rad - other.turn_rad, np.zeros(len(one[0]))
        )
    )
    current = np.abs(pairs.partial - partial.map.current)
    at = int(np.argmin(current))
    match = Match(
        int(pairs.loaded[at]), int(pairs.partial[at]), float(pairs.turn_rad[at]), others=pairs
    )
    return Found(
        match,
        f"{counted(len(pairs.partial), 'experience')} matched by a session that both maps hold",
        (len(i),),
    )


def _pixels(brain: Mapped, experiences: np.ndarray) -> np.ndarray:
    """Return the templates of experiences, one row each; equal rows for a map without templates."""
    views: np.ndarray = brain.map.experiences["template"].numpy()[experiences]
    if not brain.view.n:
        return np.zeros((len(experiences), 1))
    pixels: np.ndarray = brain.view.templates["pixels"].numpy(force=True)
    rows: np.ndarray = pixels[views].reshape(len(experiences), -1)
    return rows


def _aliases(of: ExperienceMap) -> dict[str, np.ndarray]:
    return {name: of.aliases[name].numpy() for name in ("session", "number")}


def _once(pairs: Pairs) -> Pairs:
    """Keep one pair of each partial experience, that of the smallest match error."""
    order = np.lexsort((pairs.error, pairs.partial))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pairs.partial[order]) != 0
    return pairs.pick(order[first])


def _fits(
    first: Pairs,
    at: int,
    group: Pairs,
    loaded: ExperienceMap,
    partial: ExperienceMap,
    limits: Tolerance,
) -> bool:
    """Return whether the drift of odometry between two groups can explain that both are right."""
    ends = [first.pick([at]), group.pick([int(np.argmin(group.error))])]
    both = Pairs(*(np.concatenate(columns) for columns in zip(*ends, strict=True)))
    misfit, allowed = far_off(both, loaded, partial, limits)
    return bool(misfit[1] <= allowed[1])


def _runner_up(
    loaded: Mapped, partial: Mapped, pairs: Pairs, at: int, limits: Tolerance
) -> float | None:
    """Return the smallest match error of the matched view with a template elsewhere."""
    templates = loaded.map.experiences["template"].numpy()
    far = elsewhere(loaded.map, int(pairs.loaded[at]), limits)
    rest = np.setdiff1d(templates, templates[~far])
    view = int(partial.map.experiences["template"][pairs.partial[at]])
    return min(loaded.view.differences(partial.view.stored_view(view), rest), default=None)
